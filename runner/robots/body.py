"""Body of a robot, from its adapter, its parts and its deployment file. Opens nothing."""

from __future__ import annotations

from typing import get_args

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.schemas.body import NOT_A_ROBOT, Body, Capability
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.manifest.vocabulary import EmbodimentTag

SO101 = "so101_follower"
TWINS = ("so101_mujoco", "so101_kinematic")
LEROBOT = "lerobot:"
KNOWN = frozenset(get_args(EmbodimentTag)) - NOT_A_ROBOT - {"custom"}

PANDA_MOBILE = Body(
    embodiment_tags=("panda_mobile", "mobile_base"),
    capabilities={"has_vision": True, "has_gripper": True, "has_mobile_base": True},
)
"""The Panda on its mobile base of `vram-runner sim --robot panda-mobile`."""
SIMULATED = Body(
    embodiment_tags=(SO101, "mobile_base"),
    capabilities={"has_vision": True, "has_gripper": True, "has_mobile_base": True},
)
"""The SO-101 on a mobile base of `vram-runner sim`."""


def body_of(robot: RobotEnvironment, description: RobotDescription) -> Body:
    """Return the robot's tags and capabilities.

    The file's `embodiment_tags` replace those of the adapter; the file's `capabilities` are added
    to what its parts show.
    """
    seen: dict[str, Capability] = {
        "has_vision": bool(robot.sensors),
        "has_gripper": any(joint.gripper for joint in description.joints),
    }
    return Body.model_validate(
        {
            "embodiment_tags": robot.known_tags or _by_adapter(robot.hal.adapter),
            "capabilities": {**seen, **robot.capabilities},
        }
    )


def _by_adapter(adapter: str) -> tuple[str, ...]:
    if adapter in TWINS:
        return (SO101,)
    kind = adapter.removeprefix(LEROBOT) if adapter.startswith(LEROBOT) else ""
    return (kind,) if kind in KNOWN else ()
