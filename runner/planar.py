"""Poses on a plane: a turn about the vertical as a quaternion, and back. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from vram_arbiter.schemas.world import Pose


def planar_pose(x_m: float, y_m: float, yaw_rad: float, frame: str) -> Pose:
    """Return a pose on the ground of `frame`."""
    half = yaw_rad / 2
    quat = (0.0, 0.0, math.sin(half), math.cos(half))
    return Pose(xyz=(x_m, y_m, 0.0), quat_xyzw=quat, frame_id=frame)


def yaw_of(quat_xyzw: Sequence[float]) -> float:
    """Return the turn (rad) about the vertical; the quaternion may have any length but zero."""
    x, y, z, w = quat_xyzw
    return math.atan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)


def drive(
    ctrl: Any, actuators: Sequence[int], velocity: tuple[float, float, float], step_s: float
) -> None:
    """Move the targets of a simulated base's three actuators by one time step of its velocity.

    The velocity (vx, vy, wz) is in the base's own frame.
    """
    x, y, turn = actuators
    vx, vy, wz = velocity
    cos, sin = math.cos(ctrl[turn]), math.sin(ctrl[turn])
    ctrl[x] += step_s * (vx * cos - vy * sin)
    ctrl[y] += step_s * (vx * sin + vy * cos)
    ctrl[turn] += step_s * wz
