"""The units that lerobot's robots speak, joint by joint, and rad. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum


class JointUnit(StrEnum):
    """Unit of a robot's number. The last two run over the joint's calibrated range."""

    DEG = "deg"
    RAD = "rad"
    PERCENT = "0..100"
    SIGNED_PERCENT = "-100..100"


@dataclass(frozen=True, slots=True)
class Scale:
    """Linear map: `number * scale + offset` is the joint's own (rad, or m of a linear one)."""

    scale: float = 1.0
    offset: float = 0.0

    def joint(self, number: float) -> float:
        """Return the joint's own value. Not clipped: a joint beyond its range is told as such."""
        return number * self.scale + self.offset

    def of(self, joint_value: float) -> float:
        """Return the number for a joint's own value."""
        return (joint_value - self.offset) / self.scale


def scale_of_unit(
    unit: JointUnit, lower_rad: float, upper_rad: float, sign: int = 1, offset_rad: float = 0.0
) -> Scale:
    """Return the map of a unit over a joint's range.

    `sign` -1 reverses the direction; `offset_rad` is added to angles (never to percentages).
    """
    if unit is JointUnit.DEG:
        return Scale(sign * math.pi / 180.0, offset_rad)
    if unit is JointUnit.RAD:
        return Scale(sign, offset_rad)
    begin, end = (lower_rad, upper_rad) if sign > 0 else (upper_rad, lower_rad)
    if unit is JointUnit.PERCENT:
        return Scale((end - begin) / 100.0, begin)
    return Scale((end - begin) / 200.0, (begin + end) / 2.0)


POSITION = ".pos"  # lerobot's features of joint positions: `elbow_flex.pos`


@dataclass(frozen=True, slots=True)
class LerobotUnits:
    """How lerobot records a robot: the type's name in its datasets, and the unit of each joint."""

    robot_type: str
    scales: Mapping[str, Scale]

    def named(self, angles_rad: Mapping[str, float]) -> dict[str, float]:
        """Return joint angles by lerobot's names, in its units."""
        return {name + POSITION: self.scales[name].of(angle) for name, angle in angles_rad.items()}
