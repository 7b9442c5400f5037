"""Linear maps between a policy's numbers and a joint's (rad, or m of a linear one). Pure."""

from __future__ import annotations

import math
from typing import Literal

from vram_arbiter.runner.protocols import Joint
from vram_arbiter.runner.robots.units import JointUnit, Scale, scale_of_unit
from vram_arbiter.schemas.manifest.vocabulary import GripperConvention

JointUnits = Literal["degrees", "radians", "range_m100_100"] | None

SAME = Scale()

# opening (0 closed, 1 open) = scale * number + offset
_OPENING = {
    GripperConvention.NORMALIZED_OPEN_UNIT: SAME,
    GripperConvention.NORMALIZED_OPEN_SYMMETRIC: Scale(0.5, 0.5),
    GripperConvention.NORMALIZED_CLOSE_SYMMETRIC: Scale(-0.5, 0.5),
    GripperConvention.PERCENT_OPEN: Scale(0.01),
    GripperConvention.BINARY_CLOSE_ONE: Scale(-1.0, 1.0),
}


def opening(convention: GripperConvention) -> Scale:
    """Return the map to an opening of 0..1. Raises ValueError for a convention of the joint."""
    if convention not in _OPENING:
        raise ValueError(f"{convention} is not a convention of a gripper that is on or off")
    return _OPENING[convention]


def of_joint(joint: Joint, units: JointUnits, gripper: GripperConvention | None) -> Scale:
    """Return the map of one joint. A gripper's convention goes before the joints' unit.

    Raises ValueError with what stands against it.
    """
    low, span = joint.lower_rad, joint.upper_rad - joint.lower_rad
    convention = gripper if joint.gripper else None
    if convention is GripperConvention.WIDTH_METERS:
        raise ValueError(
            f"width_meters: how far {joint.name} moves per meter of width is not known"
        )
    if convention is GripperConvention.RAW_JOINT_RAD:
        return SAME
    if (convention or units == "range_m100_100") and not math.isfinite(span):
        raise ValueError(f"{convention or units}: the range of {joint.name} is not known")
    if convention is not None:
        share = _OPENING[convention]
        return Scale(share.scale * span, low + share.offset * span)
    if units == "range_m100_100":
        return scale_of_unit(JointUnit.SIGNED_PERCENT, low, joint.upper_rad)
    if units == "degrees":
        if joint.linear:
            raise ValueError(f"degrees: {joint.name} is a linear joint, its unit is m")
        return Scale(math.pi / 180.0)
    return SAME
