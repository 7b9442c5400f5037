"""The gate before the motors: joint limits, base speeds, finite numbers. Every action passes it, whoever made it.

A small excess (a learnt policy aims at a stop) is clamped and said; a large one is withheld. Knows joint names and limits, not
robots or skills, nor who holds which memory of a card: no eviction weakens it. `Envelope` is the simulator's gate; a robot's is
`runner.robot_gate.RobotGate`, which looks at speed, workspace and effort as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from schemas.control import ControlMode
from schemas.world import Action, WorldState

CLAMP_TOLERANCE_RAD = 0.15  # beyond this an out-of-range target is a mistake, not an aim at the stop
MAX_BASE_SPEED_M_S = 0.5
MAX_BASE_TURN_RAD_S = 1.2


@dataclass(frozen=True, slots=True)
class Envelope:
    """Lowest and highest target by joint (rad), greatest base speeds (m/s, rad/s)."""

    joint_limits: Mapping[str, tuple[float, float]]
    max_base_speed_m_s: float = MAX_BASE_SPEED_M_S
    max_base_turn_rad_s: float = MAX_BASE_TURN_RAD_S
    clamp_tolerance_rad: float = CLAMP_TOLERANCE_RAD

    def check(self, action: Action, world: WorldState) -> tuple[Action | None, tuple[str, ...]]:
        """The action to apply, clamped where the excess is within tolerance, or None; and what was wrong with it."""
        if "joint_state" in world.stale:
            return None, ("the joint state is stale",)
        match action.control_mode:
            case ControlMode.JOINT_POSITION:
                return self._joints(action)
            case ControlMode.BODY_TWIST:
                return self._twist(action)
            case mode:
                return None, (f"control mode {mode} is not supported here",)

    def _joints(self, action: Action) -> tuple[Action | None, tuple[str, ...]]:
        names = action.joint_names or tuple(self.joint_limits)
        rows, problems, withheld = [], [], False
        for row in action.joint_targets or ():
            if len(row) != len(names):
                return None, (f"{len(row)} joint targets for {len(names)} joints",)
            values = []
            for name, value in zip(names, row, strict=True):
                if name not in self.joint_limits:
                    return None, (f"there is no joint {name}",)
                if not math.isfinite(value):  # of a copy that was not validated
                    return None, (f"{name}: {value} is no number of rad",)
                low, high = self.joint_limits[name]
                excess = max(low - value, value - high, 0.0)
                if excess > 0:
                    problems.append(
                        f"{name}: {value:.3f} rad is {excess:.3f} outside [{low:.3f}, {high:.3f}]"
                    )
                    withheld |= excess > self.clamp_tolerance_rad
                values.append(min(max(value, low), high))
            rows.append(tuple(values))
        if withheld:
            return None, tuple(problems)
        if problems:
            action = action.model_copy(update={"joint_targets": tuple(rows)})
        return action, tuple(problems)

    def _twist(self, action: Action) -> tuple[Action | None, tuple[str, ...]]:
        for twist in action.body_twist or ():
            speed, turn = math.hypot(twist[0], twist[1]), abs(twist[5])
            if speed > self.max_base_speed_m_s + 1e-9 or turn > self.max_base_turn_rad_s + 1e-9:
                return None, (f"base speed {speed:.2f} m/s, {turn:.2f} rad/s is beyond the envelope",)
        return action, ()
