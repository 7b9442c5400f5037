"""The simulated robots in their scenes, and the skills that can act there.

Nothing is simulated here: the control thread does that.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.runner.goals.catalogue import Maker
from vram_arbiter.runner.protocols import MobileBase, RobotDescription
from vram_arbiter.runner.robots.body import PANDA_MOBILE as PANDA_BODY
from vram_arbiter.runner.robots.body import SIMULATED
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.robots.so101_kinematics import kinematics_for
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.config import SceneConfig
from vram_arbiter.runner.sim.env import MAX_BASE_SPEED_M_S, MAX_BASE_TURN_RAD_S, SimEnv
from vram_arbiter.runner.sim.panda import PANDA_MOBILE as PANDA
from vram_arbiter.runner.sim.scene import SO101, SimBody
from vram_arbiter.runner.skills.ros_standins import NAVIGATE, StandIn
from vram_arbiter.schemas.body import Body
from vram_arbiter.schemas.config.robot import robot_of
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.manifest import Kind
from vram_arbiter.schemas.yamltext import read_yaml

OBSERVATION_CAMERAS: Final = ("front", "wrist")  # the first is the default one


@dataclass(frozen=True, slots=True)
class World:
    """A robot of `vram-runner sim --robot`: its body for skills, and `make(scene file)`; None is
    the robot's own scene. `make` raises ConfigError for a scene that cannot be read.
    """

    body: Body
    make: Callable[[Path | None], ArmEnvironment]


def _environment(scene: SceneConfig, of: SimBody, robot: RobotDescription) -> ArmEnvironment:
    return ArmEnvironment(
        SimEnv(scene, of),  # renders only on the control thread, from its first reset on
        robot,
        kinematics=kinematics_for(robot),
        cameras=tuple(name for name in OBSERVATION_CAMERAS if name in scene.cameras),
    )


def so101_world(scene_file: Path | None) -> ArmEnvironment:
    """Return the SO-101 before its table."""
    scene = SceneConfig.load(scene_file)
    base = MobileBase(MAX_BASE_SPEED_M_S, MAX_BASE_TURN_RAD_S, mount_m=scene.mount_in_base_m)
    return _environment(scene, SO101, so101(simulated=True, base=base))


def panda_world(scene_file: Path | None) -> ArmEnvironment:
    """Return the Panda before its counter, described as its twin is
    (`configs/robots/panda-mobile-twin.yaml`).
    """
    configs = configs_folder(os.environ)
    twin = robot_of(read_yaml(configs / "robots" / "panda-mobile-twin.yaml"))
    rest = dict(zip(PANDA.joints, PANDA.rest_pose, strict=True))
    robot = replace(make_hal(twin.hal).description, rest_pose_rad=rest)
    scene = SceneConfig.load(scene_file or configs / "scenes" / "counter.yaml")
    return _environment(scene, PANDA, robot)


WORLDS: Final = {
    "so101-mobile": World(SIMULATED, so101_world),
    "panda-mobile": World(PANDA_BODY, panda_world),
}


def makers_of(
    world: ArmEnvironment,
    given: Mapping[str, str],
    arbiter: Any,
    *,
    period_s: float,
    wait_s: float,
    latency_steps: int | None = None,
    others: Mapping[str, StandIn] | None = None,
) -> dict[Kind, Maker]:
    """Return the makers of the skills that can act in this world; as `SidecarPolicy`.

    Args: `others` stand in for interfaces beside navigation.
    """
    from vram_arbiter.runner.skills import makers
    from vram_arbiter.runner.skills.navigate import Navigate

    arm = {joint.name for joint in world.robot.joints if not joint.gripper}
    rest = world.robot.rest_pose_rad
    folded = {name: angle for name, angle in rest.items() if name in arm}
    navigate = StandIn(
        lambda manifest: Navigate(manifest, world.arm.config, folded, period_s=period_s),
        frozenset({ControlMode.BODY_TWIST, ControlMode.JOINT_POSITION}),
    )
    return makers.makers_of(
        world.robot,
        world.limits_for,
        world.sent,
        given,
        arbiter,
        period_s=period_s,
        wait_s=wait_s,
        latency_steps=latency_steps,
        others={NAVIGATE: navigate, **(others or {})},
    )
