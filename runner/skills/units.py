"""Linear maps between a policy's numbers and a joint's (rad, or m of a linear one). Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from vram_arbiter.runner.protocols import Joint
from vram_arbiter.schemas.manifest.vocabulary import GripperConvention

JointUnits = Literal["degrees", "radians", "range_m100_100"] | None

# opening (0 closed, 1 open) = scale * number + offset
_OPENING = {
    GripperConvention.NORMALIZED_OPEN_UNIT: (1.0, 0.0),
    GripperConvention.NORMALIZED_OPEN_SYMMETRIC: (0.5, 0.5),
    GripperConvention.NORMALIZED_CLOSE_SYMMETRIC: (-0.5, 0.5),
    GripperConvention.PERCENT_OPEN: (0.01, 0.0),
    GripperConvention.BINARY_CLOSE_ONE: (-1.0, 1.0),
}


@dataclass(frozen=True, slots=True)
class Scale:
    """`number * scale + offset` is the joint's own."""

    scale: float = 1.0
    offset: float = 0.0

    def of(self, joint_value: float) -> float:
        """Return the policy's number for a joint's."""
        return (joint_value - self.offset) / self.scale


SAME = Scale()


def opening(convention: GripperConvention) -> Scale | None:
    """Return the map to an opening of 0..1; None for a convention that speaks of the joint."""
    found = _OPENING.get(convention)
    return None if found is None else Scale(*found)


def of_joint(joint: Joint, units: JointUnits, gripper: GripperConvention | None) -> Scale | str:
    """Return the map of one joint, or what stands against it. A gripper's convention goes before
    the joints' unit.
    """
    span = joint.upper_rad - joint.lower_rad
    if joint.gripper and gripper is not None:
        if gripper is GripperConvention.WIDTH_METERS:
            return f"width_meters: how far {joint.name} moves per meter of width is not known"
        if gripper is GripperConvention.RAW_JOINT_RAD:
            return SAME
        if not math.isfinite(span):
            return f"{gripper}: the range of {joint.name} is not known"
        scale, offset = _OPENING[gripper]
        return Scale(scale * span, joint.lower_rad + offset * span)
    if units == "range_m100_100":
        if not math.isfinite(span):
            return f"{units}: the range of {joint.name} is not known"
        return Scale(span / 200.0, joint.lower_rad + span / 2.0)
    if units == "degrees":
        if joint.linear:
            return f"degrees: {joint.name} is a linear joint, its unit is m"
        return Scale(math.pi / 180.0)
    return SAME
