"""Frames of an arm and differential inverse kinematics, on the robot's MuJoCo model.

Poses are relative to the model's root, or to another frame. The inverse is solved by mink
(`mink.solve_ik`: a quadratic program over joint velocities within the joints' ranges); base and
grippers are frozen in it. About 0.5 ms a step. One thread. Must not know skills or manifests.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.models import frames_of, load_model
from vram_arbiter.runner.safety.limits import Vector3

ITERATIONS = 12  # two suffice for a step of a control loop
REACHED_M = 2e-4
REACHED_RAD = 1e-3
DAMPING = 1e-6
# m of position error that one rad of turn is worth, where the arm has too few joints to keep both
SOFT_TURN = 0.02


@dataclass(frozen=True, slots=True)
class Pose3:
    """Position (m) and rotation matrix, both numpy."""

    xyz: Any
    matrix: Any

    def inverse(self) -> Pose3:
        return Pose3(-self.matrix.T @ self.xyz, self.matrix.T)

    def then(self, other: Pose3) -> Pose3:
        """Return `other`, which is given in this frame, in this frame's own reference."""
        return Pose3(self.xyz + self.matrix @ other.xyz, self.matrix @ other.matrix)


@dataclass(frozen=True, slots=True)
class Reach:
    """Joint targets (rad by name), and what they fall short of the pose that was asked for."""

    joints: dict[str, float]
    short_m: float
    short_rad: float


class ArmModel:
    """The model of `robot`. Joints that are left out of a pose are taken as 0.

    Raises ConfigError for a model that cannot be read.
    """

    gripper_lever_m = 1.0  # a linear gripper's effort is the force at its pads

    def __init__(self, robot: RobotDescription) -> None:
        self._model = load_model(robot)
        import mujoco
        import numpy as np

        self._mujoco, self._np = mujoco, np
        self._data = mujoco.MjData(self._model)
        self._alias = dict(robot.frames)
        joints = {joint.name: self._model.joint(joint.name) for joint in robot.joints}
        self._q = {name: int(joint.qposadr[0]) for name, joint in joints.items()}
        self._v = {name: int(joint.dofadr[0]) for name, joint in joints.items()}
        self._arm = tuple(joint.name for joint in robot.joints if not joint.gripper)
        for joint in robot.joints:  # the deployment may have narrowed them
            number = int(joints[joint.name].id)
            self._model.jnt_limited[number] = 1
            self._model.jnt_range[number] = joint.lower_rad, joint.upper_rad
        self._range = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in robot.joints}
        self._tool = robot.ends[0].frame if robot.ends else ""
        self._solver: _Solver | None = None
        self._base = ""  # the frame below the model's root, where the model lacks it
        if robot.base is not None and self._find(robot.base.frame) is None:
            self._base, self._mount = robot.base.frame, robot.base.mount_m
        self._chain = self._bodies_of(self._tool) if self._tool and self.has(self._tool) else ()

    # -- frames
    def has(self, frame: str) -> bool:
        return frame == self._base != "" or self._find(frame) is not None

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the names of all frames, other names first."""
        base = (self._base,) if self._base else ()
        return (*self._alias, *base, *frames_of(self._model))

    def movers(self, frame: str) -> tuple[str, ...]:
        """Return the arm's joints that move a frame."""
        if frame == self._base != "":
            return ()
        body, above = self._body(frame), set()
        while body > 0:
            above.add(body)
            body = int(self._model.body_parentid[body])
        return tuple(name for name in self._arm if self._body_of(name) in above)

    def pose(self, frame: str, joints: Mapping[str, float], *, within: str = "") -> Pose3:
        """Return where `frame` is, relative to the model's root or to the frame `within`."""
        self._place(joints)
        found = self._read(frame)
        return self._read(within).inverse().then(found) if within else found

    def points(self, joints: Mapping[str, float]) -> Mapping[str, Vector3]:
        """Return the tool and the arm's links, in meters from the model's root (for the gate)."""
        self._place(joints)
        found = {"tool": _vector(self._read(self._tool).xyz)}
        for name, body in self._chain:
            found[name] = _vector(self._data.xpos[body])
        return found

    def _bodies_of(self, frame: str) -> tuple[tuple[str, int], ...]:
        """Return the links that the arm moves, from the frame's own to the first one."""
        found, body = [], self._body(frame)
        movers = {self._body_of(name) for name in self._arm}
        while body > 0:
            if body in movers:
                found.append((str(self._model.body(body).name), body))
            body = int(self._model.body_parentid[body])
        return tuple(found)

    def _body_of(self, joint: str) -> int:
        return int(self._model.jnt_bodyid[self._model.joint(joint).id])

    def _find(self, frame: str) -> tuple[str, int] | None:
        name, kinds = self._alias.get(frame, frame), self._mujoco.mjtObj
        for kind, which in (("site", kinds.mjOBJ_SITE), ("body", kinds.mjOBJ_BODY)):
            number = int(self._mujoco.mj_name2id(self._model, which, name))
            if number >= 0:
                return kind, number
        return None

    def _body(self, frame: str) -> int:
        kind, number = self._found(frame)
        return number if kind == "body" else int(self._model.site_bodyid[number])

    def _found(self, frame: str) -> tuple[str, int]:
        found = self._find(frame)
        if found is None:
            raise KeyError(frame)
        return found

    def _place(self, joints: Mapping[str, float]) -> None:
        for name, q in self._q.items():
            self._data.qpos[q] = joints.get(name, 0.0)
        self._mujoco.mj_kinematics(self._model, self._data)

    def _read(self, frame: str) -> Pose3:
        if frame == self._base != "":
            return Pose3(-self._np.array(self._mount), self._np.eye(3))
        kind, number = self._found(frame)
        data = self._data
        xyz, mat = (data.site_xpos, data.site_xmat) if kind == "site" else (data.xpos, data.xmat)
        return Pose3(xyz[number].copy(), mat[number].reshape(3, 3).copy())

    # -- inverse
    def reach(
        self, frame: str, target: Pose3, joints: Mapping[str, float], *, turning: bool = True
    ) -> Reach:
        """Return joint targets that bring `frame` to `target` (relative to the root), or as near
        as the ranges allow. Without `turning` the position comes first and the turn is kept as far
        as it can be.
        """
        if self._solver is None:
            self._solver = _Solver(self._model)
        kind, number = self._found(frame)
        named = self._model.site(number) if kind == "site" else self._model.body(number)
        movers = self.movers(frame)
        q = self._np.zeros(self._model.nq)
        for name, index in self._q.items():
            low, high = self._range[name]
            q[index] = min(max(joints.get(name, 0.0), low), high)
        free = [self._v[name] for name in movers]
        solved, short_m, short_rad = self._solver.solve(
            (str(named.name), kind), target, q, free, turning
        )
        return Reach(
            {name: float(solved[self._q[name]]) for name in movers},
            short_m,
            short_rad if turning else 0.0,
        )


class _Solver:
    """mink on one model; its tasks are kept by frame."""

    def __init__(self, model: Any) -> None:
        import mink
        import numpy as np

        self._mink, self._np, self._model = mink, np, model
        self._configuration = mink.Configuration(model)
        self._limits = [mink.ConfigurationLimit(model)]
        self._tasks: dict[tuple[str, str, bool], tuple[Any, list[Any]]] = {}

    def solve(
        self, frame: tuple[str, str], target: Pose3, q: Any, free: list[int], turning: bool
    ) -> tuple[Any, float, float]:
        mink, configuration = self._mink, self._configuration
        task, frozen = self._task(frame, free, turning)
        task.set_target(
            mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(target.matrix), target.xyz)
        )
        configuration.update(q)
        short_m = short_rad = math.inf
        for _ in range(ITERATIONS):
            velocity = mink.solve_ik(
                configuration,
                [task],
                1.0,
                "daqp",
                damping=DAMPING,
                limits=self._limits,
                constraints=frozen,
            )
            configuration.integrate_inplace(velocity, 1.0)
            error = task.compute_error(configuration)
            before = short_m, short_rad
            short_m = float(self._np.linalg.norm(error[:3]))
            short_rad = float(self._np.linalg.norm(error[3:]))
            if short_m <= REACHED_M and (short_rad <= REACHED_RAD or not turning):
                break
            if short_m >= 0.99 * before[0] and short_rad >= 0.99 * before[1]:
                break  # it does not come nearer
        return configuration.q.copy(), short_m, short_rad

    def _task(self, frame: tuple[str, str], free: list[int], turning: bool) -> tuple[Any, Any]:
        key = (*frame, turning)
        if key not in self._tasks:
            mink = self._mink
            cost = 1.0 if turning else SOFT_TURN
            task = mink.FrameTask(*frame, position_cost=1.0, orientation_cost=cost)
            others = [dof for dof in range(self._model.nv) if dof not in free]
            frozen = [mink.DofFreezingTask(self._model, others)] if others else []
            self._tasks[key] = task, frozen
        return self._tasks[key]


def _vector(row: Any) -> Vector3:
    x, y, z = (float(value) for value in row)
    return x, y, z
