"""Joint trajectories, played by this runner in place of a ROS 2 controller.

Reads goals of `control_msgs/FollowJointTrajectory`. Targets run straight from point to point, at
most one period's worth per tick: a late runner plays slower, never faster. A point out of range or
too fast is refused before anything moves. Safety is the gate's, as for every skill.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Annotated

from pydantic import BaseModel, ConfigDict, FailFast, Field

from vram_arbiter.runner.protocols import Act, Done, Goal, StepOutcome
from vram_arbiter.runner.safety.limits import Limits
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.motion import REACHED_RAD, action_of, joint_positions
from vram_arbiter.runner.skills.ros_goals import parse_goal
from vram_arbiter.schemas.errors import BadRequest, GoalRejected, PathToleranceViolated
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import WorldState

POINTS_MAX = 2000
JOINTS_MAX = 64
LONGEST_S = 600.0
ARRIVE_S = 1.5  # after the last point, when the goal does not say (`goal_time_tolerance`)
IN_THE_WAY = "something is in the way, or the trajectory is too fast for the arm"
SLACK = 1.001  # of a speed limit: times are rounded to nanoseconds

FIRST = (
    FailFast()
)  # a message of a thousand wrong items costs the event loop one error, not a thousand
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Ros(BaseModel):
    """A ROS message, as far as it is kept: what is not kept may be empty and nothing else."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Duration(_Ros):
    sec: Annotated[int, Field(ge=0, le=int(LONGEST_S))] = 0
    nanosec: Annotated[int, Field(ge=0, lt=10**9)] = 0

    @property
    def seconds(self) -> float:
        return self.sec + self.nanosec / 1e9


class IgnoredHeader(BaseModel):
    """Ignored: a trajectory begins when its goal does."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class Point(_Ros):
    """Positions in rad, in the order of `joint_names`.

    The way between points is straight: velocities and the like are refused.
    """

    positions: Annotated[tuple[Finite, ...], FIRST, Field(min_length=1, max_length=JOINTS_MAX)]
    velocities: Annotated[tuple[Finite, ...], FIRST, Field(max_length=0)] = ()
    accelerations: Annotated[tuple[Finite, ...], FIRST, Field(max_length=0)] = ()
    effort: Annotated[tuple[Finite, ...], FIRST, Field(max_length=0)] = ()
    time_from_start: Duration


class JointTrajectory(_Ros):
    header: IgnoredHeader = IgnoredHeader()
    joint_names: Annotated[tuple[str, ...], FIRST, Field(max_length=JOINTS_MAX)] = ()
    points: Annotated[tuple[Point, ...], FIRST, Field(max_length=POINTS_MAX)] = ()


class Tolerance(_Ros):
    """`position` (rad) on the way, or at the last point; 0: as if not given."""

    name: str
    position: Annotated[Finite, Field(ge=0)] = 0.0
    velocity: Annotated[Finite, Field(ge=0, le=0)] = 0.0
    acceleration: Annotated[Finite, Field(ge=0, le=0)] = 0.0


class TrajectoryParams(_Ros):
    """`FollowJointTrajectory.Goal`."""

    trajectory: JointTrajectory = JointTrajectory()
    path_tolerance: Annotated[tuple[Tolerance, ...], FIRST, Field(max_length=JOINTS_MAX)] = ()
    goal_tolerance: Annotated[tuple[Tolerance, ...], FIRST, Field(max_length=JOINTS_MAX)] = ()
    goal_time_tolerance: Duration = Duration()

    @property
    def last_s(self) -> float:
        """Seconds from the start to the last point."""
        points = self.trajectory.points
        return points[-1].time_from_start.seconds if points else 0.0

    @property
    def arrive_s(self) -> float:
        """Seconds after the last point's time for the joints to be there."""
        return self.goal_time_tolerance.seconds or ARRIVE_S


def problem_of(asked: TrajectoryParams, limits: Limits) -> str:
    """Return what this robot cannot do of a trajectory; empty: nothing.

    The way to the first point is not checked: its start is unknown yet.
    """
    names, points = asked.trajectory.joint_names, asked.trajectory.points
    if not names or not points:
        return "trajectory: give joint_names and at least one point: an empty one moves nothing"
    if len(set(names)) != len(names):
        return "trajectory.joint_names: a joint is named twice"
    known = ", ".join(limits.joints_rad)
    tolerances = (*asked.path_tolerance, *asked.goal_tolerance)
    for name in (*names, *(tolerance.name for tolerance in tolerances)):
        if name not in limits.joints_rad:
            return f"unknown joint {name}; the robot has {known}"
    for index, point in enumerate(points):
        if len(point.positions) != len(names):
            return (
                f"trajectory.points[{index}]:"
                f" {len(point.positions)} positions for {len(names)} joints"
            )
        for name, position in zip(names, point.positions, strict=True):
            low, high = limits.joints_rad[name]
            if not low <= position <= high:
                return (
                    f"trajectory.points[{index}]:"
                    f" {name} {position:g} rad is outside [{low:g}, {high:g}]"
                )
    if points[0].time_from_start.seconds <= 0:
        return (
            "trajectory.points[0]: time_from_start must be above 0: the arm begins at another pose"
        )
    for index, (here, there) in enumerate(pairwise(points), start=1):
        if wrong := too_fast(names, here.positions, there.positions, _gap_s(here, there), limits):
            return f"trajectory.points[{index}]: {wrong}"
    return ""


def too_fast(
    names: tuple[str, ...],
    start: tuple[float, ...],
    end: tuple[float, ...],
    gap_s: float,
    limits: Limits,
) -> str:
    """Return the joint that would have to exceed its speed; empty: none."""
    if gap_s <= 0:
        return "time_from_start must grow from point to point"
    for name, a, b in zip(names, start, end, strict=True):
        speed, most = abs(b - a) / gap_s, limits.speeds_rad_s.get(name, math.inf)
        if speed > most * SLACK:
            return f"{name} would have to make {speed:.2f} rad/s; at most {most:.2f}"
    return ""


def position_at(
    points: Sequence[Point], start: tuple[float, ...], elapsed_s: float
) -> tuple[float, ...]:
    """Return the joints' positions (rad) after so long on the straight way from `start` through the
    points; after the last one, that one."""
    before_s, before = 0.0, start
    for point in points:
        at_s = point.time_from_start.seconds
        if elapsed_s < at_s:
            share = (elapsed_s - before_s) / (at_s - before_s)
            return tuple(a + share * (b - a) for a, b in zip(before, point.positions, strict=True))
        before_s, before = at_s, point.positions
    return before


def _gap_s(here: Point, there: Point) -> float:
    return there.time_from_start.seconds - here.time_from_start.seconds


class FollowJointTrajectory(SkillBase):
    """One goal, one trajectory. Fails with `goal_rejected` when the arm does not arrive in time,
    and with `path_tolerance_violated` when a joint is too far from the target that was sent last.

    `sent` returns the targets in force (rad by joint), from which it begins; without it, and for
    joints that it does not name, it begins at the measured positions. A gripper that holds
    something never reaches its target: starting from its measured position would open it for a
    moment.
    """

    def __init__(
        self,
        manifest: RSkillManifest,
        limits: Limits,
        *,
        period_s: float,
        sent: Callable[[], Mapping[str, float]] | None = None,
    ) -> None:
        super().__init__(manifest)
        self._sent = sent
        self._limits = limits
        self._period_s = period_s
        self._asked: TrajectoryParams | None = None
        self._start_at: tuple[float, ...] | None = None
        self._ticks = 0

    async def _start(self, goal: Goal) -> None:
        self._asked, self._start_at, self._ticks = None, None, 0
        asked = parse_goal(TrajectoryParams, self.manifest, goal.params)
        if problem := problem_of(asked, self._limits):
            raise BadRequest(f"goal_params: {problem}", hint="nothing was moved")
        self._asked = asked

    def _step(self, world: WorldState) -> StepOutcome:
        if self._asked is None:
            raise BadRequest("a trajectory was stepped without a goal")
        names, points = self._asked.trajectory.joint_names, self._asked.trajectory.points
        measured = joint_positions(world, names)
        here = tuple(measured[name] for name in names)
        if self._start_at is None:
            told = {} if self._sent is None else self._sent()
            self._start_at = tuple(told.get(name, measured[name]) for name in names)
            if wrong := too_fast(
                names,
                self._start_at,
                points[0].positions,
                points[0].time_from_start.seconds,
                self._limits,
            ):
                raise BadRequest(
                    f"trajectory.points[0]: {wrong} from where the arm is", hint="nothing was moved"
                )
        sent_s = self._ticks * self._period_s
        sent = position_at(points, self._start_at, sent_s)
        self._ticks += 1
        elapsed_s = self._ticks * self._period_s
        last_s = self._asked.last_s
        self.fraction = min(0.99, elapsed_s / last_s)
        if sent_s >= last_s:  # the last point has been sent
            worst = _worst(names, here, sent, self._asked.goal_tolerance, REACHED_RAD)
            if worst is None:
                error = max(abs(a - b) for a, b in zip(here, sent, strict=True))
                return Done({"positions_rad": measured, "error_rad": round(error, 4)})
            if elapsed_s > last_s + self._asked.arrive_s:
                raise GoalRejected(
                    f"{worst[0]} is {worst[1]:.3f} rad from the last point", hint=IN_THE_WAY
                )
        elif worst := _worst(names, here, sent, self._asked.path_tolerance, math.inf):
            raise PathToleranceViolated(
                f"{worst[0]} is {worst[1]:.3f} rad from its path", hint=IN_THE_WAY
            )
        targets = position_at(points, self._start_at, elapsed_s)
        return Act(action_of(dict(zip(names, targets, strict=True)), world.stamp_ns))

    def withheld(self) -> None:
        """Let the clock stand: a target that moved on while the arm stood would be too fast."""
        self._ticks -= 1


def _worst(
    names: tuple[str, ...],
    here: tuple[float, ...],
    there: tuple[float, ...],
    tolerances: Sequence[Tolerance],
    default_rad: float,
) -> tuple[str, float] | None:
    """Return the joint that is furthest outside its tolerance, and its error (rad); None: none."""
    given = {one.name: one.position for one in tolerances if one.position > 0}
    errors = {name: abs(a - b) for name, a, b in zip(names, here, there, strict=True)}
    outside = {name: e for name, e in errors.items() if e > given.get(name, default_rad)}
    return max(outside.items(), key=lambda item: item[1], default=None)
