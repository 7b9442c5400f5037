"""Planar navigation without a GPU: where to stand to grab a point, and how to get there.

Pure geometry and a bounded P-controller; the table is the only obstacle, and the front of the base
never crosses its edge. Must not know MuJoCo or goals.
"""

from __future__ import annotations

import dataclasses
import math

from vram_arbiter.runner.sim.config import SceneConfig, wrap_angle

EDGE_CLEARANCE_M = 0.025
REACHED_M = 0.006
REACHED_RAD = 0.015
MAX_SPEED_M_S, MAX_ACCEL_M_S2, MAX_TURN_RAD_S = 0.35, 0.8, 0.8
GAIN_PER_S = 3.0


@dataclasses.dataclass(frozen=True, slots=True)
class Pose2D:
    """x, y in meters, yaw in radians, in the map frame unless a name says otherwise."""

    x_m: float
    y_m: float
    yaw_rad: float = 0.0


def to_map(base: Pose2D, x_m: float, y_m: float) -> tuple[float, float]:
    """Convert a point of the base frame to the map frame."""
    cos, sin = math.cos(base.yaw_rad), math.sin(base.yaw_rad)
    return base.x_m + cos * x_m - sin * y_m, base.y_m + sin * x_m + cos * y_m


def front_reach_m(config: SceneConfig, yaw_rad: float) -> float:
    """Return how far the base's box reaches along the map's x from its origin, at this yaw."""
    front = config.mount_in_base_m[0] + config.base_front_of_mount_m
    return front * abs(math.cos(yaw_rad)) + config.base_half_size_m[1] * abs(math.sin(yaw_rad))


def standoff_pose(target_map_m: tuple[float, float], config: SceneConfig) -> Pose2D:
    """Return the pose of the base, square to the table, that puts the target on the grasp spot.

    Kept clear of the table's edge: a target deep on the table is then out of reach, but nothing is
    hit.
    """
    spot_x, spot_y = config.grasp_spot_in_base_m
    limit = config.table_edge_x_m - EDGE_CLEARANCE_M - front_reach_m(config, 0.0)
    return Pose2D(min(target_map_m[0] - spot_x, limit), target_map_m[1] - spot_y, 0.0)


class PlanarController:
    """Velocity commands towards a goal pose; call once per control step."""

    def __init__(
        self,
        goal: Pose2D,
        config: SceneConfig,
        *,
        control_dt_s: float = 1.0 / 30.0,
    ) -> None:
        self.goal = goal
        self._config, self._dt = config, control_dt_s
        self._speed = 0.0

    def distance_m(self, pose: Pose2D) -> float:
        """Straight distance left."""
        return math.hypot(self.goal.x_m - pose.x_m, self.goal.y_m - pose.y_m)

    def reached(self, pose: Pose2D) -> bool:
        """Within 6 mm and 0.015 rad of the goal."""
        turn = wrap_angle(self.goal.yaw_rad - pose.yaw_rad)
        return self.distance_m(pose) <= REACHED_M and abs(turn) <= REACHED_RAD

    def command(self, pose: Pose2D) -> tuple[float, float, float]:
        """Return (vx, vy, wz) in the base frame, m/s and rad/s; never across the table's edge."""
        gap = self.distance_m(pose)
        wanted = min(MAX_SPEED_M_S, GAIN_PER_S * gap)
        self._speed = min(wanted, self._speed + MAX_ACCEL_M_S2 * self._dt)
        vx_map = vy_map = 0.0
        if gap > 1e-6:
            vx_map = self._speed * (self.goal.x_m - pose.x_m) / gap
            vy_map = self._speed * (self.goal.y_m - pose.y_m) / gap
        room = (
            self._config.table_edge_x_m
            - EDGE_CLEARANCE_M / 2
            - pose.x_m
            - front_reach_m(self._config, pose.yaw_rad)
        )
        vx_map = min(vx_map, max(0.0, room) * GAIN_PER_S)
        turn = GAIN_PER_S * wrap_angle(self.goal.yaw_rad - pose.yaw_rad)
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        return (
            cos * vx_map + sin * vy_map,
            -sin * vx_map + cos * vy_map,
            min(max(turn, -MAX_TURN_RAD_S), MAX_TURN_RAD_S),
        )
