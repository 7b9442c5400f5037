"""Makers of a deployment's skills: policies in sidecars, ROS 2 actions and services."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.runner.cli.common import sidecars_given
from vram_arbiter.runner.cli.deployment import DeploymentFile, Parts
from vram_arbiter.runner.goals.catalogue import Maker
from vram_arbiter.runner.skills.ros_standins import StandIn, StandIns
from vram_arbiter.runner.skills.teleop import INTERFACE, Teleop
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind
from vram_arbiter.schemas.runtime.extras import need

MakeMakers = Callable[[Parts, AsyncClient | None], Mapping[Kind, Maker]]
"""How skills of each kind are made for this robot, with or without an arbiter."""


def policy_makers(args: argparse.Namespace, file: DeploymentFile) -> MakeMakers:
    """Learnt policies, each in its sidecar, and what stands in for ROS 2 actions."""
    given = sidecars_given(args.sidecar)

    def make_makers(parts: Parts, arbiter: AsyncClient | None) -> Mapping[Kind, Maker]:
        from vram_arbiter.runner.skills.makers import makers_of

        joints = parts.hal.description.joint_names
        services = StandIns(service_servers(file.robot), joints, "ros_services")
        made = makers_of(
            parts.hal.description,
            lambda manifest: parts.gate.for_skill(manifest, ()).limits,
            parts.hal.sent,
            given,
            arbiter,
            period_s=1.0 / file.robot.rate_hz,
            others={**ros_servers(file.robot), **operators(parts, 1.0 / file.robot.rate_hz)},
        )
        return {**made, Kind.ROS_SERVICE: services}

    return make_makers


def ros_servers(robot: RobotEnvironment) -> dict[str, StandIn]:
    """Return the actions that ROS 2 servers execute, by interface. Raises ConfigError."""
    if not robot.ros_actions:
        return {}
    domain = _domain("ros_actions")
    from vram_arbiter.runner.ros2.served_skills import RosAction

    served = StandIn(
        lambda manifest: RosAction(manifest, domain),
        frozenset({ControlMode.JOINT_POSITION, ControlMode.BODY_TWIST}),
    )
    return dict.fromkeys(robot.ros_actions, served)


def service_servers(robot: RobotEnvironment) -> dict[str, StandIn]:
    """Return the services that ROS 2 servers execute, by interface. Raises ConfigError."""
    if not robot.ros_services:
        return {}
    domain = _domain("ros_services")
    from vram_arbiter.runner.ros2.served_skills import RosService, service_misfit

    served = StandIn(
        lambda manifest: RosService(manifest, domain), frozenset(ControlMode), service_misfit
    )
    return dict.fromkeys(robot.ros_services, served)


def _domain(setting: str) -> int:
    """Return the DDS domain. Raises ConfigError: a wrong number, or Cyclone DDS is missing."""
    need(setting, "cyclonedds", extra="ros2")
    from vram_arbiter.runner.sensors.ros2_dds import domain_of

    try:
        return domain_of()
    except ValueError as error:
        raise ConfigError(f"{setting}: {error}") from error


def operators(parts: Parts, period_s: float) -> dict[str, StandIn]:
    """Return the operator's skill, by interface; empty for a robot without a teleoperator."""
    if (teleoperator := parts.teleoperator) is None:
        return {}
    limits, sent = parts.gate.limits, parts.hal.sent
    made = StandIn(
        lambda manifest: Teleop(manifest, teleoperator, limits, period_s=period_s, sent=sent),
        frozenset({ControlMode.JOINT_POSITION}),
    )
    return {INTERFACE: made}
