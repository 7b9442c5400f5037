"""Makers of a deployment's skills: policies in sidecars, and ROS 2 actions."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping

from vram_arbiter.runner.cli.common import sidecars_given
from vram_arbiter.runner.cli.deployment import DeploymentFile, Parts
from vram_arbiter.runner.goals.catalogue import Maker, sidecar_endpoint
from vram_arbiter.runner.protocols import Skill
from vram_arbiter.runner.skills.ros_standins import TRAJECTORY, StandIn, StandIns
from vram_arbiter.runner.skills.sidecar_policy import Arbiter
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.runtime.extras import need

MakeMakers = Callable[[Parts, Arbiter | None], Mapping[Kind, Maker]]
"""How skills of each kind are made for this robot, with or without an arbiter."""


def policy_makers(args: argparse.Namespace, file: DeploymentFile) -> MakeMakers:
    """Learnt policies, each in its sidecar, and what stands in for ROS 2 actions."""
    given = sidecars_given(args.sidecar)

    def make_makers(parts: Parts, arbiter: Arbiter | None) -> Mapping[Kind, Maker]:
        def make_policy(manifest: RSkillManifest) -> Skill:
            from vram_arbiter.clients.sidecar.policy import PolicyClient
            from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
            from vram_arbiter.runner.skills.wiring import wire_up

            description = parts.hal.description
            wiring = wire_up(manifest, description, description.rest_pose_rad)
            speeds = parts.gate.for_skill(manifest, ()).limits.speeds_rad_s
            return SidecarPolicy(
                manifest,
                wiring,
                PolicyClient(sidecar_endpoint(manifest.name, given, os.environ)),
                arbiter,
                period_s=1.0 / file.robot.rate_hz,
                speeds_rad_s=speeds,
                sent=parts.hal.sent,
            )

        def make_trajectory(manifest: RSkillManifest) -> Skill:
            from vram_arbiter.runner.skills.trajectory import FollowJointTrajectory

            limits = parts.gate.for_skill(manifest, ()).limits
            return FollowJointTrajectory(
                manifest, limits, period_s=1.0 / file.robot.rate_hz, sent=parts.hal.sent
            )

        follow = StandIn(make_trajectory, frozenset({ControlMode.JOINT_POSITION}))
        known = {TRAJECTORY: follow, **ros_servers(file.robot)}
        stand_ins = StandIns(known, parts.hal.description.joint_names)
        return {Kind.VLA: make_policy, Kind.ROS_ACTION: stand_ins}

    return make_makers


def ros_servers(robot: RobotEnvironment) -> dict[str, StandIn]:
    """Return the actions that ROS 2 servers execute, by interface. Raises ConfigError."""
    if not robot.ros_actions:
        return {}
    need("ros_actions", "cyclonedds", extra="ros2")
    from vram_arbiter.runner.ros2.action_skill import RosAction
    from vram_arbiter.runner.sensors.ros2_dds import domain_of

    try:
        domain = domain_of()
    except ValueError as error:
        raise ConfigError(f"ros_actions: {error}") from error
    served = StandIn(
        lambda manifest: RosAction(manifest, domain),
        frozenset({ControlMode.JOINT_POSITION, ControlMode.BODY_TWIST}),
    )
    return dict.fromkeys(robot.ros_actions, served)
