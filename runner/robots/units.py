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
class JointScale:
    """Conversion of one joint's numbers to and from rad.

    `sign` -1 reverses the direction; `offset_rad` is added to angles (never to percentages).
    """

    unit: JointUnit
    lower_rad: float
    upper_rad: float
    sign: int = 1
    offset_rad: float = 0.0

    def to_rad(self, value: float) -> float:
        """Convert to rad. Not clipped: a joint beyond its range is reported as such."""
        match self.unit:
            case JointUnit.DEG:
                return self.sign * math.radians(value) + self.offset_rad
            case JointUnit.RAD:
                return self.sign * value + self.offset_rad
            case JointUnit.PERCENT:
                share = value / 100.0
            case JointUnit.SIGNED_PERCENT:
                share = (value + 100.0) / 200.0
        return self.lower_rad + (share if self.sign > 0 else 1.0 - share) * (
            self.upper_rad - self.lower_rad
        )

    def from_rad(self, angle_rad: float) -> float:
        """Return the number to send for a target in rad."""
        match self.unit:
            case JointUnit.DEG:
                return math.degrees((angle_rad - self.offset_rad) * self.sign)
            case JointUnit.RAD:
                return (angle_rad - self.offset_rad) * self.sign
            case _:
                share = (angle_rad - self.lower_rad) / (self.upper_rad - self.lower_rad)
                share = share if self.sign > 0 else 1.0 - share
                return 100.0 * share if self.unit is JointUnit.PERCENT else 200.0 * share - 100.0


POSITION = ".pos"  # lerobot's features of joint positions: `elbow_flex.pos`


@dataclass(frozen=True, slots=True)
class LerobotUnits:
    """How lerobot records a robot: the type's name in its datasets, and the unit of each joint."""

    robot_type: str
    scales: Mapping[str, JointScale]

    def named(self, angles_rad: Mapping[str, float]) -> dict[str, float]:
        """Return joint angles by lerobot's names, in its units."""
        return {
            name + POSITION: self.scales[name].from_rad(angle) for name, angle in angles_rad.items()
        }
