"""Ground truth of the simulator on the runner's wire: for judges and demos, never for planners."""

from __future__ import annotations

from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.schemas.plain import JsonObject


def truth_as_wire(env: SimEnv) -> JsonObject:
    """Target, objects with their place (meters, map and base frame), what is held."""
    truth = env.ground_truth()
    return {
        "target": truth.target,
        "objects": {
            name: {
                "xyz": list(item.position_map),
                "xyz_base": list(item.position_base),
                "lift_m": item.lift_m,
                "touching_fingers": item.touching_fingers,
            }
            for name, item in truth.objects.items()
        },
        "base_pose": list(truth.base_pose),
        "held": truth.held,
        "held_above_table": {name: name == truth.held for name in truth.objects},
    }
