"""Forward kinematics of the SO-101 for the safety gate, from the published MJCF.

About 20 µs a pose.

Points in meters in the arm's own base frame: origin under the base, x forward, z up. One thread.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.so101 import NAME
from vram_arbiter.runner.safety.limits import Kinematics, Vector3
from vram_arbiter.runner.sim.config import ARM_JOINTS
from vram_arbiter.runner.sim.scene import GRASP_SITE, arm_spec, load_mujoco
from vram_arbiter.runner.skills.kinematics import ArmModel

BODIES = {"elbow": "lower_arm", "wrist": "wrist", "gripper": "gripper"}


class So101Kinematics:
    """Joints that are left out of a pose are taken as 0."""

    gripper_lever_m = 0.077  # jaw axis to the middle of its pad, in the MJCF

    def __init__(self) -> None:
        mujoco = self._mujoco = load_mujoco()
        self._model = arm_spec(mujoco).compile()
        self._data = mujoco.MjData(self._model)
        self._q = {name: int(self._model.joint(name).qposadr[0]) for name in ARM_JOINTS}
        self._site = int(self._model.site(GRASP_SITE).id)
        self._bodies = {point: int(self._model.body(body).id) for point, body in BODIES.items()}

    def points(self, joints: Mapping[str, float]) -> Mapping[str, Vector3]:
        for name, q in self._q.items():
            self._data.qpos[q] = joints.get(name, 0.0)
        self._mujoco.mj_kinematics(self._model, self._data)
        found = {"tool": self._vector(self._data.site_xpos[self._site])}
        for point, body in self._bodies.items():
            found[point] = self._vector(self._data.xpos[body])
        return found

    @staticmethod
    def _vector(row: object) -> Vector3:
        x, y, z = (float(value) for value in row)  # type: ignore[attr-defined]
        return x, y, z


def kinematics_for(robot: RobotDescription) -> Kinematics | None:
    """Return the kinematics of a robot with a model and a tool; None without, or without MuJoCo.

    Raises ConfigError for a model that cannot be read.
    """
    if importlib.util.find_spec("mujoco") is None:
        return None
    if robot.name == NAME:
        return So101Kinematics()
    return ArmModel(robot) if robot.model and robot.ends else None
