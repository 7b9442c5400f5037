"""Map of places where the object may stand, from several looks at different poses.

A detector takes one thing for another now and then, mostly from one side only. Two looks that are
joined by the base's odometry tell them apart better than either does: scores of a place add up, and
the best place wins. Pure: no sockets, no clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from vram_arbiter.schemas.plain import JsonMap

# two looks at one thing differ by less; the arm's gripper needs more room between two things
SAME_M = 0.05
UNMOVED = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Point:
    """A place in the frame of the mobile base, meters."""

    x: float
    y: float
    z: float


@dataclass(slots=True)
class Place:
    """Place of a candidate: x, y in the odometry's frame, z over the base's floor, meters.

    `score` is the sum over all looks.
    """

    x: float
    y: float
    z: float
    score: float
    seen_from_m: float
    """Distance of the look that determines the place: the nearest, which errs least."""


@dataclass(slots=True)
class Places:
    """Add what `locate_in_view` found; ask for the best.

    Without odometry only the newest look counts: it cannot be joined to the ones before.
    """

    known: list[Place] = field(default_factory=list)
    base_pose: tuple[float, float, float] = UNMOVED
    joined: bool = False
    """Whether odometry joins the newest look to the ones before."""

    def add(self, data: JsonMap) -> None:
        """Add `data` of a locate that found something: `point_base_m`, optionally `seen` and
        `base_pose`.
        """
        pose = data.get("base_pose")
        self.joined = pose is not None
        if not self.joined:
            self.known.clear()
        self.base_pose = UNMOVED if pose is None else (pose[0], pose[1], pose[2])
        before = list(self.known)
        for thing in data.get("seen") or [{"point_base_m": data["point_base_m"], "score": 1.0}]:
            self._see(Point(*thing["point_base_m"]), thing["score"], before)

    def _see(self, point: Point, score: float, before: list[Place]) -> None:
        """Add one thing of a look. `before`: places that are not matched in this look yet."""
        x0, y0, yaw = self.base_pose
        x = x0 + math.cos(yaw) * point.x - math.sin(yaw) * point.y
        y = y0 + math.sin(yaw) * point.x + math.cos(yaw) * point.y
        seen = Place(x, y, point.z, score, math.hypot(point.x, point.y))
        same = min(before, key=lambda place: _apart_m(place, seen), default=None)
        if same is None or _apart_m(same, seen) > SAME_M:
            self.known.append(seen)
            return
        before.remove(same)
        same.score += score
        if seen.seen_from_m <= same.seen_from_m:
            same.x, same.y, same.z, same.seen_from_m = seen.x, seen.y, seen.z, seen.seen_from_m

    def best(self) -> Place | None:
        """Return the likeliest place; None before anything was seen."""
        return max(self.known, key=lambda place: place.score, default=None)

    def from_base(self, place: Place) -> Point:
        """Return its position relative to the base at the newest look."""
        x0, y0, yaw = self.base_pose
        dx, dy = place.x - x0, place.y - y0
        return Point(
            math.cos(yaw) * dx + math.sin(yaw) * dy,
            -math.sin(yaw) * dx + math.cos(yaw) * dy,
            place.z,
        )


def _apart_m(a: Place, b: Place) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)
