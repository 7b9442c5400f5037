"""The simulator's ground truth as the runner's wire shows it: for judges and demos, never for skills or planners."""

from __future__ import annotations

from typing import Any, Protocol


class Knowing(Protocol):
    """An environment that knows what is really there (`runner.sim.env.SimEnv`)."""

    def ground_truth(self) -> Any: ...


def truth_as_wire(env: Any) -> dict[str, Any]:
    """Target, objects with their place (metres, map and base frame), what is held. Raises TypeError for a real robot."""
    if not hasattr(env, "ground_truth"):
        raise TypeError("this environment knows no ground truth")
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
