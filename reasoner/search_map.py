"""Map of a search: places where the object may stand, from several looks at different poses, and
places to look from that are left.

A detector takes one thing for another now and then, mostly from one side only. Two looks that are
joined by the base's odometry tell them apart better than either does: scores of a place add up, and
the best place wins. Pure: no sockets, no clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from vram_arbiter.reasoner.planner import Seen
from vram_arbiter.schemas.plain import JsonMap

# two looks at one thing differ by less; the arm's gripper needs more room between two things
SAME_M = 0.05
# a thing is another one, which the scene VLM named, unless its score by that name is so much lower
CLEARLY = 0.15
UNMOVED = (0.0, 0.0, 0.0)
# places to look from, in the frame of the search's first look: a step back widens the view, then to
# the left and to the right of it
VIEWPOINTS_M = ((-0.35, 0.0), (-0.35, 0.45), (-0.35, -0.45), (-0.2, 0.9), (-0.2, -0.9))
SAME_VIEW_M, SAME_VIEW_RAD = 0.2, 0.2

_POINT = "point_base_m"

type Pose = tuple[float, float, float]
"""x, y in meters and yaw in radians, in the odometry's frame."""


type Point = tuple[float, float, float]
"""x, y, z in the frame of the mobile base, meters."""


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
    doubted: Sequence[Place] = ()
    """Places whose thing was in the hand, and the scene VLM called it something else."""
    base_pose: Pose = UNMOVED
    joined: bool = False
    """Whether odometry joins the newest look to the ones before."""

    def add(self, data: JsonMap, others: Iterable[Place] = ()) -> bool:
        """Add `data` of a look: `point_base_m` or `seen` if it found something, and `base_pose`.

        What stands where one of the `others` was seen as well is left out, and forgotten.
        Returns: whether anything was added.
        """
        pose = data.get("base_pose")
        self.joined = pose is not None
        if not self.joined:
            self.known.clear()
        self.base_pose = UNMOVED if pose is None else (pose[0], pose[1], pose[2])
        point = [{"point_base_m": data["point_base_m"], "score": 1.0}] if _POINT in data else []
        things = data.get("seen") or point
        seen = [self._place(thing["point_base_m"], thing["score"]) for thing in things]
        if self.joined:
            others = list(others)
            seen = [place for place in seen if not _is_other(place, others)]
            self.known = [one for one in self.known if _near(one, seen) or not _near(one, others)]
        before = list(self.known)
        for place in seen:
            self._see(place, before)
        return bool(seen)

    def _place(self, point: Point, score: float) -> Place:
        ahead, left, z = point
        return Place(*_from(self.base_pose, ahead, left), z, score, math.hypot(ahead, left))

    def _see(self, seen: Place, before: list[Place]) -> None:
        """Add one place of a look. `before`: places that are not matched in this look yet."""
        same = min(before, key=lambda place: _apart_m(place, seen), default=None)
        if same is None or _apart_m(same, seen) > SAME_M:
            self.known.append(seen)
            return
        before.remove(same)
        same.score += seen.score
        if seen.seen_from_m <= same.seen_from_m:
            same.x, same.y, same.z, same.seen_from_m = seen.x, seen.y, seen.z, seen.seen_from_m

    def best(self) -> Place | None:
        """Return the likeliest place, doubted ones last; None before anything was seen."""
        return max(self.known, key=lambda one: (not self.doubts(one), one.score), default=None)

    def doubts(self, place: Place) -> bool:
        """Return whether a place is a doubted one. Without odometry none can be told."""
        return self.joined and _near(place, self.doubted)

    def from_base(self, place: Place) -> Point:
        """Return its position relative to the base at the newest look."""
        x0, y0, yaw = self.base_pose
        return (*_from((0.0, 0.0, -yaw), place.x - x0, place.y - y0), place.z)


@dataclass(slots=True)
class Search:
    """Poses that were looked from, and the next that is worth a drive.

    Without odometry there is none: a place that was seen cannot be told from another.
    """

    others: dict[str, Place] = field(default_factory=dict)
    """Things that were in the hand and are not wanted, by name, where they were put down."""
    doubted: list[Place] = field(default_factory=list)
    """Where things stood that were in the hand and that the scene VLM called something else."""
    began: bool = False
    seen: Sequence[Seen] = ()
    """What continuous detectors see now."""
    _views: list[Pose] = field(default_factory=list)
    _given: int = 0

    def camera_of(self, thing: str) -> str:
        """Return the camera whose detector sees the thing most surely now; empty: none does."""
        such = [one for one in self.seen if one.label.lower() == thing]
        best = max(such, key=lambda one: one.confidence, default=None)
        return "" if best is None else best.camera

    def looked(self, pose: Sequence[float] | None) -> None:
        self.began = True
        if pose is not None:
            self._views.append((pose[0], pose[1], pose[2]))

    def next(self) -> Pose | None:
        """Return the next pose from which nothing was looked at; None: there is none left."""
        if not self._views:
            return None
        first = self._views[0]
        while self._given < len(VIEWPOINTS_M):
            pose = (*_from(first, *VIEWPOINTS_M[self._given]), first[2])
            self._given += 1
            if not any(_same_view(pose, view) for view in self._views):
                return pose
        return None


def _from(pose: Pose, ahead: float, left: float) -> tuple[float, float]:
    """Return the place so far ahead of a pose and to the left of it."""
    x, y, yaw = pose
    return (
        x + math.cos(yaw) * ahead - math.sin(yaw) * left,
        y + math.sin(yaw) * ahead + math.cos(yaw) * left,
    )


def _near(place: Place, others: Iterable[Place]) -> bool:
    return any(_apart_m(place, other) <= SAME_M for other in others)


def _is_other(place: Place, others: Iterable[Place]) -> bool:
    return any(
        _apart_m(place, other) <= SAME_M and other.score + CLEARLY >= place.score
        for other in others
    )


def _same_view(a: Pose, b: Pose) -> bool:
    turned = math.remainder(a[2] - b[2], math.tau)
    return math.dist(a[:2], b[:2]) < SAME_VIEW_M and abs(turned) < SAME_VIEW_RAD


def _apart_m(a: Place, b: Place) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)
