"""Makers of a deployment's skills: policies in sidecars, ROS 2 actions and services, the
operator's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.runner.cli.deployment import Parts, read_deployment
from vram_arbiter.runner.goals.catalogue import Maker
from vram_arbiter.runner.robots.so101 import lerobot_units_of
from vram_arbiter.runner.robots.teleoperators import Teleoperator, make_teleoperator
from vram_arbiter.runner.safety.limits import Limits
from vram_arbiter.runner.skills.ros_standins import StandIn, StandIns
from vram_arbiter.runner.skills.teleop import INTERFACE, MANIFEST, Teleop
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind
from vram_arbiter.schemas.runtime.extras import need

if TYPE_CHECKING:
    from vram_arbiter.runner.sim.arm_env import ArmEnvironment


@dataclass(frozen=True, slots=True)
class Models:
    """Where policies are: addresses of sidecars by skill where one is given, this machine's arbiter
    if there is one, and the arbiters of skills whose sidecars run on another machine."""

    given: Mapping[str, str]
    arbiter: AsyncClient | None = None
    servers: Mapping[str, AsyncClient] = field(default_factory=dict)


def policy_makers(robot: RobotEnvironment, parts: Parts, models: Models) -> dict[Kind, Maker]:
    """Return the makers of learnt policies, each in its sidecar, and of what stands in for ROS 2
    actions. Raises ConfigError."""
    from vram_arbiter.runner.skills.makers import makers_of

    period_s = 1.0 / robot.rate_hz
    made = makers_of(
        parts.hal.description,
        lambda manifest: parts.gate.for_skill(manifest, ()).limits,
        parts.hal.sent,
        models.given,
        models.arbiter,
        period_s=period_s,
        others={**ros_servers(robot), **operator_of(parts, period_s)},
        servers=models.servers,
    )
    joints = parts.hal.description.joint_names
    return {**made, Kind.ROS_SERVICE: StandIns(service_servers(robot), joints, "ros_services")}


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


def operator_of(parts: Parts, period_s: float) -> dict[str, StandIn]:
    """Return the skill of a deployment's operator, as `operators`; empty: no teleoperator."""
    if parts.teleoperator is None:
        return {}
    return operators(parts.teleoperator, parts.gate.limits, parts.hal.sent, period_s)


def simulated_operator(
    file: Path | None, world: ArmEnvironment, period_s: float
) -> dict[str, StandIn]:
    """Return the operator's skill in a simulated world, by the `teleop` of a deployment file, as
    `operators`. Raises ConfigError: the file is wrong, or its teleoperator does not fit the robot.
    """
    if file is None:
        return {}
    deployment = read_deployment(file)
    if (config := deployment.robot.teleop) is None:
        raise deployment.error(("teleop", "is missing: it names the operator's device"))
    units = lerobot_units_of(world.robot)
    try:
        teleoperator = make_teleoperator(config, world.robot, units, period_s=period_s)
    except ConfigError as error:
        raise deployment.located(error, "teleop") from error
    return operators(teleoperator, world.limits_for(MANIFEST), world.sent, period_s)


def operators(
    teleoperator: Teleoperator,
    limits: Limits,
    sent: Callable[[], Mapping[str, float]],
    period_s: float,
) -> dict[str, StandIn]:
    """Return the operator's skill, by interface. Args: as for `Teleop`."""
    made = StandIn(
        lambda manifest: Teleop(manifest, teleoperator, limits, period_s=period_s, sent=sent),
        frozenset({ControlMode.JOINT_POSITION}),
    )
    return {INTERFACE: made}
