"""Inverse kinematics of the arm: damped least squares on MuJoCo's Jacobian of the arm alone.

The wrist does not roll, the other four joints place the grasp point and point the fingers down as
far as they can. Must not know scenes, objects or policies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from vram_arbiter.runner.sim.config import ARM_JOINTS, SceneConfig
from vram_arbiter.runner.sim.scene import GRASP_SITE, arm_spec, load_mujoco

DAMPING = 0.02
TILT_WEIGHT_M = 0.05  # one radian of tilt is traded against this much position error
MAX_JOINT_STEP_RAD = 0.25
ITERATIONS = 60
TOLERANCE_M = 5e-4


class ArmKinematics:
    """Solves for joint angles that bring the grasp point to a place in the base frame."""

    def __init__(self, config: SceneConfig) -> None:
        import numpy as np

        mujoco = load_mujoco()
        self._mujoco, self._np = mujoco, np
        self._model = arm_spec(mujoco).compile()
        self._data = mujoco.MjData(self._model)
        self._site = int(self._model.site(GRASP_SITE).id)
        self._q = [int(self._model.joint(n).qposadr[0]) for n in ARM_JOINTS]
        self._v = [int(self._model.joint(n).dofadr[0]) for n in ARM_JOINTS[:4]]
        self._range = np.array([self._model.joint(n).range for n in ARM_JOINTS])
        self._mount = np.array(config.mount_in_base_m)

    def solve(
        self, point_base_m: Sequence[float], start: Sequence[float]
    ) -> tuple[list[float], float]:
        """Return joint angles (all six; the gripper's is `start`'s, the wrist's roll 0) and the
        remaining error in meters.
        """
        np, mujoco = self._np, self._mujoco
        goal = np.asarray(point_base_m, dtype=float) - self._mount
        joints = np.asarray(start, dtype=float).copy()
        joints[4] = 0.0
        jac_p, jac_r = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        down = np.array([0.0, 0.0, -1.0])
        error = math.inf
        for _ in range(ITERATIONS):
            self._pose(joints)
            offset = goal - self._data.site_xpos[self._site]
            error = float(np.linalg.norm(offset))
            fingers = -self._data.body("gripper").xmat.reshape(3, 3)[:, 2]
            tilt = np.cross(fingers, down)
            if error < TOLERANCE_M and float(np.linalg.norm(tilt)) < 0.01:
                break
            mujoco.mj_jacSite(self._model, self._data, jac_p, jac_r, self._site)
            jac = np.vstack([jac_p[:, self._v], TILT_WEIGHT_M * jac_r[:, self._v]])
            task = np.concatenate([offset, TILT_WEIGHT_M * tilt])
            delta = jac.T @ np.linalg.solve(jac @ jac.T + DAMPING**2 * 0.05 * np.eye(6), task)
            joints[:4] += np.clip(delta, -MAX_JOINT_STEP_RAD, MAX_JOINT_STEP_RAD)
            joints[:4] = np.clip(joints[:4], self._range[:4, 0], self._range[:4, 1])
        return [float(v) for v in joints], error

    def _pose(self, joints: Sequence[float] | Any) -> None:
        self._data.qpos[self._q] = joints
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_comPos(self._model, self._data)
