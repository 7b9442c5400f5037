"""Twin with physics of any robot that has a MuJoCo model.

Servo gains, torque limits, inertias and ranges are the model's: each joint of the robot has a
position actuator of its own name. Physics keeps pace with the clock: each call first simulates the
time since the last one, so the arm moves, sags and swings between calls as a real one does. After a
long pause it makes up `CATCH_UP_MAX_S` and drops the rest, so that no call takes longer than a few
milliseconds. A base has three position actuators, named as its joints, which its velocity moves; a
command that is not repeated stands for `DRIVE_S`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.planar import drive
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.sim.scene import load_mujoco
from vram_arbiter.schemas.errors import RobotFault
from vram_arbiter.schemas.world import JointState, Twist

CATCH_UP_MAX_S = 0.5
DRIVE_S = 0.2


class MujocoTwin(HalBase):
    """Starts at rest in `start_pose_rad` (other joints: the rest pose, or 0).

    `connect` calls `build` for the model.
    """

    def __init__(
        self,
        description: RobotDescription,
        build: Callable[[], Any],
        *,
        start_pose_rad: Mapping[str, float] | None = None,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(description)
        self._build = build
        self._clock = clock or SystemClock()
        self._start = {**description.rest_pose_rad, **(start_pose_rad or {})}
        self._base = description.base.joints if description.base is not None else ()
        self._model: Any = None
        self._data: Any = None
        self._mujoco: Any = None
        self._at_ns = 0  # clock time up to which physics has run
        self._velocity = (0.0, 0.0, 0.0)  # of the base in its own frame
        self._drive_until_ns = 0

    def _open(self) -> None:
        mujoco = self._mujoco = load_mujoco()
        if self._model is None:
            model = self._build()
            self._data = mujoco.MjData(model)
            names = self._names = (*self.description.joint_names, *self._base)
            self._q = [int(model.joint(name).qposadr[0]) for name in names]
            self._v = [int(model.joint(name).dofadr[0]) for name in names]
            self._u = {name: int(model.actuator(name).id) for name in names}
            for name, q in zip(names, self._q, strict=True):
                value = self._start.get(name, 0.0)
                self._data.qpos[q] = value
                self._data.ctrl[self._u[name]] = value
            mujoco.mj_forward(model, self._data)
            self._model = model
        self._at_ns = self._clock.now_ns()

    def _close(self) -> None:
        self._halt()

    def _read(self) -> JointState:
        self._advance()
        efforts = [self._data.actuator_force[self._u[name]] for name in self._names]
        return JointState(
            name=self._names,
            position=tuple(float(self._data.qpos[q]) for q in self._q),
            velocity=tuple(float(self._data.qvel[v]) for v in self._v),
            effort=tuple(map(float, efforts)) if self.description.tells_efforts else (),
            stamp_ns=self._clock.now_ns(),
        )

    def _drive(self, targets: Mapping[str, float]) -> Mapping[str, float]:
        self._advance()
        for name, value in targets.items():
            self._data.ctrl[self._u[name]] = value
        return targets

    def _roll(self, twist: Twist | None) -> None:
        self._advance()
        self._velocity = (twist[0], twist[1], twist[5]) if twist is not None else (0.0, 0.0, 0.0)
        self._drive_until_ns = self._clock.now_ns() + round(DRIVE_S * 1e9)

    def _halt(self) -> str:
        self._advance()
        self._velocity = (0.0, 0.0, 0.0)
        for name, q in zip(self._names, self._q, strict=True):
            self._data.ctrl[self._u[name]] = self._data.qpos[q]
        return "the servos hold the present pose"

    def _advance(self) -> None:
        now_ns = self._clock.now_ns()
        due_s = (now_ns - self._at_ns) / 1e9
        if due_s > CATCH_UP_MAX_S:
            self._at_ns = now_ns - int(CATCH_UP_MAX_S * 1e9)
            due_s = CATCH_UP_MAX_S
        step_s = float(self._model.opt.timestep)
        steps = int(due_s / step_s)
        if steps <= 0:
            return
        driven = 0
        if any(self._velocity):
            base = [self._u[name] for name in self._base]
            until_s = max(0.0, (self._drive_until_ns - self._at_ns) / 1e9)
            driven = min(steps, int(until_s / step_s))
            for _ in range(driven):
                drive(self._data.ctrl, base, self._velocity, step_s)
                self._mujoco.mj_step(self._model, self._data)
        if steps > driven:
            self._mujoco.mj_step(self._model, self._data, nstep=steps - driven)
        self._mujoco.mj_forward(self._model, self._data)
        self._at_ns += int(steps * step_s * 1e9)  # the rest of a step is made up by the next call
        if any(int(self._data.warning[kind].number) for kind in self._diverged()):
            raise RobotFault(
                "the twin's physics came apart", hint="start it again; this is a defect of ours"
            )

    def _diverged(self) -> tuple[int, ...]:
        kind = self._mujoco.mjtWarning
        return (int(kind.mjWARN_BADQPOS), int(kind.mjWARN_BADQVEL), int(kind.mjWARN_BADQACC))
