"""First check of the gate (`runner.safety.gate`): joint targets are within the joints' ranges.

A small excess (a learned policy aims at a stop) is clamped and reported; a large one is withheld.
Must not know robots or skills.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from vram_arbiter.runner.safety.violations import Check, Violation
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.world import Action, WorldState

CLAMP_TOLERANCE_RAD = (
    0.15  # beyond this an out-of-range target is a mistake, not an aim at the stop
)


@dataclass(frozen=True, slots=True)
class JointRanges:
    """Lowest and highest target by joint (rad)."""

    joint_limits: Mapping[str, tuple[float, float]]
    clamp_tolerance_rad: float = CLAMP_TOLERANCE_RAD

    def check(
        self, action: Action, world: WorldState
    ) -> tuple[Action | None, tuple[Violation, ...]]:
        """Return the action to apply, clamped where the excess is tolerable, or None; and the
        violations.
        """
        if "joint_state" in world.stale:
            return _withheld("freshness", "the joint state is stale")
        if action.control_mode is not ControlMode.JOINT_POSITION:
            return _withheld("form", f"control mode {action.control_mode} is not supported here")
        names = action.joint_names or tuple(self.joint_limits)
        rows = []
        clamped: list[Violation] = []
        withheld: list[Violation] = []
        for row in action.joint_targets or ():
            if len(row) != len(names):
                return _withheld("form", f"{len(row)} joint targets for {len(names)} joints")
            values = []
            for name, value in zip(names, row, strict=True):
                if name not in self.joint_limits:
                    return _withheld("form", f"unknown joint {name}")
                if not math.isfinite(value):  # of a copy that was not validated
                    return _withheld("form", f"{name}: expected a number of rad, got {value}")
                low, high = self.joint_limits[name]
                excess = max(low - value, value - high, 0.0)
                if excess > 0:
                    said = (
                        f"{name}: {value:.3f} rad is {excess:.3f} outside [{low:.3f}, {high:.3f}]"
                    )
                    found = withheld if excess > self.clamp_tolerance_rad else clamped
                    found.append(Violation("joint_range", said))
                values.append(min(max(value, low), high))
            rows.append(tuple(values))
        if withheld:
            return None, (*withheld, *clamped)
        if clamped:
            action = action.model_copy(update={"joint_targets": tuple(rows)})
        return action, tuple(clamped)


def _withheld(check: Check, text: str) -> tuple[None, tuple[Violation, ...]]:
    return None, (Violation(check, text),)
