"""Forward kinematics of the SO-101 for the safety gate, from the published MJCF.

About 20 µs a pose.

Points in meters in the arm's own base frame: origin under the base, x forward, z up. One thread.
"""

from __future__ import annotations

import importlib.util

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.so101 import NAME, so101
from vram_arbiter.runner.safety.limits import Kinematics
from vram_arbiter.runner.skills.kinematics import ArmModel

BODIES = {"elbow": "lower_arm", "wrist": "wrist", "gripper": "gripper"}


class So101Kinematics(ArmModel):
    """Joints that are left out of a pose are taken as 0."""

    gripper_lever_m = 0.077  # jaw axis to the middle of its pad, in the MJCF

    def __init__(self) -> None:
        super().__init__(so101(simulated=True))
        # the links before the elbow turn on the spot
        self._chain = tuple(
            (point, int(self._model.body(body).id)) for point, body in BODIES.items()
        )


def kinematics_for(robot: RobotDescription) -> Kinematics | None:
    """Return the kinematics of a robot with a model and a tool; None without, or without MuJoCo.

    Raises ConfigError for a model that cannot be read.
    """
    if importlib.util.find_spec("mujoco") is None:
        return None
    if robot.name == NAME:
        return So101Kinematics()
    return ArmModel(robot) if robot.model and robot.ends else None
