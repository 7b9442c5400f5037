"""Makers of skills for one robot, real or simulated: policies in sidecars, stand-ins for ROS 2."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from vram_arbiter.clients.sidecar.base import CALL_TIMEOUT_S
from vram_arbiter.clients.sidecar.openpi import OpenpiClient, Template
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.goals.catalogue import Maker, sidecar_endpoint
from vram_arbiter.runner.protocols import RobotDescription, Skill
from vram_arbiter.runner.safety.limits import Limits
from vram_arbiter.runner.skills.ros_standins import TRAJECTORY, StandIn, StandIns
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.trajectory import FollowJointTrajectory
from vram_arbiter.runner.skills.wiring import OPENPI, Rollout, wire_up
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.manifest import Kind, RSkillManifest


def client_of(rollout: Rollout, endpoint: str, timeout_s: float = CALL_TIMEOUT_S) -> PolicyClient:
    """Return the client of a policy's server. Raises ConfigError for an address that is not one."""
    if rollout.adapter == OPENPI:
        template = Template(rollout.openpi_observation)
        return OpenpiClient(endpoint, template, timeout_s=timeout_s)
    return PolicyClient(endpoint, timeout_s=timeout_s)


def makers_of(
    robot: RobotDescription,
    limits_for: Callable[[RSkillManifest], Limits],
    sent: Callable[[], Mapping[str, float]],
    given: Mapping[str, str],
    arbiter: Any,
    *,
    period_s: float,
    others: Mapping[str, StandIn],
    wait_s: float = 0.0,
    latency_steps: int | None = None,
    servers: Mapping[str, Any] = MappingProxyType({}),
) -> dict[Kind, Maker]:
    """Return the makers; `others` stand in for further interfaces, the rest as `SidecarPolicy`.
    `servers`: the arbiters of skills whose sidecars run on another machine.
    """

    def make_policy(manifest: RSkillManifest) -> Skill:
        wiring = wire_up(manifest, robot, robot.rest_pose_rad)
        return SidecarPolicy(
            manifest,
            wiring,
            client_of(wiring.rollout, sidecar_endpoint(manifest.name, given, os.environ)),
            servers.get(manifest.name, arbiter),
            period_s=period_s,
            wait_s=wait_s,
            latency_steps=latency_steps,
            speeds_rad_s=limits_for(manifest).speeds_rad_s,
            sent=sent,
        )

    follow = StandIn(
        lambda manifest: FollowJointTrajectory(
            manifest, limits_for(manifest), period_s=period_s, sent=sent
        ),
        frozenset({ControlMode.JOINT_POSITION}),
    )
    known = {TRAJECTORY: follow, **others}
    return {Kind.VLA: make_policy, Kind.ROS_ACTION: StandIns(known, robot.joint_names)}
