"""Rotation matrices as the numbers of a policy, and back, by SciPy. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest.vocabulary import Rotation

UNIT = 0.1  # a quaternion or axis whose length differs by more is no orientation


def numbers(matrix: Any, rotation: Rotation) -> tuple[float, ...]:
    """Return a rotation matrix as `rotation` writes it."""
    if rotation is Rotation.AXIS_ANGLE:
        return axis_angle(matrix)
    if rotation is Rotation.ROT6D:
        found = matrix[:2].ravel()
    elif rotation is Rotation.EULER_XYZ:
        found = _turns().from_matrix(matrix).as_euler("xyz", suppress_warnings=True)
    else:
        wxyz = rotation is Rotation.QUAT_WXYZ
        found = _turns().from_matrix(matrix).as_quat(canonical=True, scalar_first=wxyz)
    return tuple(float(value) for value in found)


def matrix_of(values: Sequence[float], rotation: Rotation) -> Any:
    """Return the rotation matrix of `values`. Raises ModelError if they are not an orientation."""
    import numpy as np

    match rotation:
        case Rotation.ROT6D:
            first, second = np.array(values[:3]), np.array(values[3:])
            x = first / _length(first, rotation)
            y = second - x * float(x @ second)
            y = y / _length(y, rotation)
            return np.stack([x, y, np.cross(x, y)])
        case Rotation.EULER_XYZ:
            return _turns().from_euler("xyz", values).as_matrix()
        case Rotation.AXIS_ANGLE:
            return turn(values)
    norm = float(np.linalg.norm(values))
    if abs(norm - 1.0) > UNIT:
        raise ModelError(f"a quaternion has length 1, the policy's has {norm:.3g}")
    wxyz = rotation is Rotation.QUAT_WXYZ
    return _turns().from_quat(values, scalar_first=wxyz).as_matrix()


def turn(vector: Sequence[float]) -> Any:
    """Return the rotation matrix of axis times angle."""
    return _turns().from_rotvec(vector).as_matrix()


def axis_angle(matrix: Any) -> tuple[float, float, float]:
    """Return axis times angle. The sign of the axis is steady around half a turn, where a gripper
    that points down is: an angle may be up to 3π/2.
    """
    import numpy as np

    x, y, z, w = _turns().from_matrix(matrix).as_quat()
    axis = np.array([x, y, z])
    # w, or else the largest number of the axis, is positive
    if (w if abs(w) > 0.5 else axis[np.argmax(abs(axis))]) < 0:
        axis, w = -axis, -w
    length = float(np.linalg.norm(axis))
    if not length:
        return 0.0, 0.0, 0.0
    a, b, c = axis * (2.0 * float(np.arctan2(length, w)) / length)
    return float(a), float(b), float(c)


def _turns() -> Any:
    """Return SciPy's class, imported where a contract speaks of orientations."""
    from scipy.spatial.transform import Rotation as Turn

    return Turn


def _length(vector: Any, rotation: Rotation) -> float:
    length = float((vector @ vector) ** 0.5)
    if length < UNIT:
        raise ModelError(f"the policy's {rotation} is no orientation: a row of length {length:.3g}")
    return length
