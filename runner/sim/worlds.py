"""The simulated SO-101 on its table, and the skills that can act there.

Nothing is simulated here: the control thread does that.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from vram_arbiter.runner.goals.catalogue import Maker
from vram_arbiter.runner.protocols import MobileBase
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.robots.so101_kinematics import kinematics_for
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.config import SceneConfig
from vram_arbiter.runner.sim.env import MAX_BASE_SPEED_M_S, MAX_BASE_TURN_RAD_S, SimEnv
from vram_arbiter.runner.skills.ros_standins import NAVIGATE, StandIn
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.manifest import Kind

ROBOT: Final = "so101-mobile"
OBSERVATION_CAMERAS: Final = ("front", "wrist")  # the first is the default one


def so101_world(scene_file: Path | None) -> ArmEnvironment:
    """Return our own scene as a world. Raises ConfigError for a scene that cannot be read."""
    scene = SceneConfig.load(scene_file)
    base = MobileBase(MAX_BASE_SPEED_M_S, MAX_BASE_TURN_RAD_S, mount_m=scene.mount_in_base_m)
    robot = so101(simulated=True, base=base)
    return ArmEnvironment(
        SimEnv(scene),  # renders only on the control thread, from its first reset on
        robot,
        kinematics=kinematics_for(robot),
        cameras=tuple(name for name in OBSERVATION_CAMERAS if name in scene.cameras),
    )


def makers_of(
    world: ArmEnvironment,
    given: Mapping[str, str],
    arbiter: Any,
    *,
    period_s: float,
    wait_s: float,
    latency_steps: int | None = None,
) -> dict[Kind, Maker]:
    """Return the makers of the skills that can act in this world; as `SidecarPolicy`."""
    from vram_arbiter.runner.skills import makers
    from vram_arbiter.runner.skills.navigate import Navigate

    navigate = StandIn(
        lambda manifest: Navigate(manifest, world.arm.config, period_s=period_s),
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
        others={NAVIGATE: navigate},
    )
