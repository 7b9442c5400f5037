"""Rotation matrices as the numbers of a policy, and back. Pure; numpy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest.vocabulary import Rotation

TINY = 1e-12
UNIT = 0.1  # a quaternion or axis whose length differs by more is no orientation


def numbers(matrix: Any, rotation: Rotation) -> tuple[float, ...]:
    """Return a rotation matrix as `rotation` writes it."""
    match rotation:
        case Rotation.ROT6D:
            return tuple(float(value) for value in matrix[:2].ravel())
        case Rotation.EULER_XYZ:
            pitch = math.atan2(-matrix[2, 0], math.hypot(matrix[0, 0], matrix[1, 0]))
            if math.hypot(matrix[0, 0], matrix[1, 0]) < 1e-9:  # gimbal lock: yaw is taken as 0
                return math.atan2(-matrix[1, 2], matrix[1, 1]), pitch, 0.0
            roll = math.atan2(matrix[2, 1], matrix[2, 2])
            return roll, pitch, math.atan2(matrix[1, 0], matrix[0, 0])
        case Rotation.AXIS_ANGLE:
            return axis_angle(matrix)
    x, y, z, w = quaternion(matrix)
    return (w, x, y, z) if rotation is Rotation.QUAT_WXYZ else (x, y, z, w)


def matrix_of(values: Sequence[float], rotation: Rotation) -> Any:
    """Return the rotation matrix of `values`. Raises ModelError for numbers that are none."""
    import numpy as np

    match rotation:
        case Rotation.ROT6D:
            first, second = np.array(values[:3]), np.array(values[3:])
            x = first / _length(first, rotation)
            y = second - x * float(x @ second)
            y = y / _length(y, rotation)
            return np.stack([x, y, np.cross(x, y)])
        case Rotation.EULER_XYZ:
            (sr, cr), (sp, cp), (sy, cy) = ((math.sin(v), math.cos(v)) for v in values)
            return np.array(
                [
                    [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                    [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                    [-sp, cp * sr, cp * cr],
                ]
            )
        case Rotation.AXIS_ANGLE:
            return turn(values)
    w, *axis = values if rotation is Rotation.QUAT_WXYZ else (values[3], *values[:3])
    norm = math.sqrt(w * w + sum(value * value for value in axis))
    if abs(norm - 1.0) > UNIT:
        raise ModelError(f"a quaternion has length 1, the policy's has {norm:.3g}")
    length = math.sqrt(sum(value * value for value in axis))
    if length < TINY:
        return np.eye(3)
    angle = 2.0 * math.atan2(length, w)
    return turn([value / length * angle for value in axis])


def turn(vector: Sequence[float]) -> Any:
    """Return the rotation matrix of axis times angle (Rodrigues)."""
    import numpy as np

    angle = math.sqrt(sum(value * value for value in vector))
    if angle < TINY:
        return np.eye(3)
    x, y, z = (value / angle for value in vector)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)


def quaternion(matrix: Any) -> tuple[float, float, float, float]:
    """Return x, y, z, w with w ≥ 0."""
    x, y, z, w = _quaternion(matrix)
    return (x, y, z, w) if w >= 0 else (-x, -y, -z, -w)


def axis_angle(matrix: Any) -> tuple[float, float, float]:
    """Return axis times angle. The sign of the axis is steady around half a turn, where a gripper
    that points down is: an angle may be up to 3π/2.
    """
    x, y, z, w = _quaternion(matrix)
    length = math.sqrt(x * x + y * y + z * z)
    if length < TINY:
        return 0.0, 0.0, 0.0
    angle = 2.0 * math.atan2(length, w) / length
    return x * angle, y * angle, z * angle


def _quaternion(matrix: Any) -> tuple[float, float, float, float]:
    """Return x, y, z, w, of which w, or else the largest, is positive."""
    import mujoco
    import numpy as np

    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(matrix).ravel())
    w, x, y, z = (float(value) for value in found)
    return x, y, z, w


def _length(vector: Any, rotation: Rotation) -> float:
    length = math.sqrt(float(vector @ vector))
    if length < UNIT:
        raise ModelError(f"the policy's {rotation} is no orientation: a row of length {length:.3g}")
    return length
