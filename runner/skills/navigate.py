"""`navigate`: drive the base to a pose, square up to a point on the table, or turn in place.

Needs no GPU and takes no lease. Goal parameters as Nav2's NavigateToPose (`pose` with
`header.frame_id` map, odom or base_link), or `target_point` (x, y, z in base_link: stand so that
this point lies where the arm grasps), or `turn_rad`. The arm folds first, its gripper stays as it
is. Places in `base_link` refer to the base at the first step; the planar simulator's odometry is
its map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from vram_arbiter.runner.planar import yaw_of
from vram_arbiter.runner.protocols import Act, Done, Goal, Hold, StepOutcome
from vram_arbiter.runner.sim.config import SceneConfig, wrap_angle
from vram_arbiter.runner.sim.navigate import PlanarController, Pose2D, standoff_pose, to_map
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.motion import JointRamp, action_of, is_at, joint_positions
from vram_arbiter.runner.skills.ros_goals import parse_goal
from vram_arbiter.schemas.errors import BadRequest, GoalRejected, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import Action, Finite, WorldState

SETTLE_STEPS = (
    8  # standing still at the goal, so that the next picture is sharp and the pose is final
)
STUCK_STEPS = 120  # four seconds at 30 Hz without coming closer
CLOSER_M, CLOSER_RAD = 0.002, 0.005  # what counts as closer

Distance = Annotated[Finite, Field(ge=-100, le=100)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Position(_Part):
    x: Distance
    y: Distance
    z: Distance = 0.0


class Orientation(_Part):
    """Quaternion; only its turn about the vertical counts."""

    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0
    w: Finite = 1.0

    @model_validator(mode="after")
    def _check(self) -> Orientation:
        if math.hypot(self.x, self.y, self.z, self.w) < 1e-6:
            raise ValueError("a quaternion has length 1, this one is zero")
        return self

    @property
    def yaw_rad(self) -> float:
        return yaw_of((self.x, self.y, self.z, self.w))


class PoseHeader(BaseModel):
    """As ROS writes it; stamps and the like are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    frame_id: Literal["map", "odom", "base_link"]


class PlainPose(_Part):
    position: Position
    orientation: Orientation = Orientation()


class StampedPose(_Part):
    header: PoseHeader
    pose: PlainPose


class NavigateParams(_Part):
    """Goal parameters: `target_point` and `turn_rad` precede `pose`, which the manifest always
    sets.
    """

    pose: StampedPose | None = None
    target_point: Position | None = None
    turn_rad: Annotated[Finite, Field(ge=-2 * math.pi, le=2 * math.pi)] | None = None
    behavior_tree: str = ""

    @model_validator(mode="after")
    def _check(self) -> NavigateParams:
        if self.target_point is not None and self.turn_rad is not None:
            raise ValueError("give target_point or turn_rad, not both")
        if self.pose is None and self.target_point is None and self.turn_rad is None:
            raise ValueError("give pose, target_point or turn_rad")
        return self


def base_pose(world: WorldState) -> Pose2D:
    """Return the base's pose on the map. Raises ModelError when it is unknown or stale."""
    if world.base_pose is None or "base_pose" in world.stale:
        raise ModelError("the base's pose is not known", hint="nothing drives without odometry")
    x, y, _ = world.base_pose.xyz
    return Pose2D(x, y, yaw_of(world.base_pose.quat_xyzw))


def goal_pose(params: NavigateParams, here: Pose2D, config: SceneConfig) -> Pose2D:
    """Return the pose to stand at, on the map."""
    if params.target_point is not None:
        point = to_map(here, params.target_point.x, params.target_point.y)
        return standoff_pose(point, config)
    if params.turn_rad is not None:
        return Pose2D(here.x_m, here.y_m, here.yaw_rad + params.turn_rad)
    if params.pose is None:  # the validator refuses this
        raise BadRequest("goal_params: give pose, target_point or turn_rad")
    position, yaw = params.pose.pose.position, params.pose.pose.orientation.yaw_rad
    if params.pose.header.frame_id == "base_link":
        x, y = to_map(here, position.x, position.y)
        return Pose2D(x, y, here.yaw_rad + yaw)
    return Pose2D(position.x, position.y, yaw)


class Navigate(SkillBase):
    """Fold to `rest_pose_rad`, drive, stand still.

    The rest pose leaves out the gripper, which may hold something. Fails with `goal_rejected` when
    the base stops coming closer.
    """

    def __init__(
        self,
        manifest: RSkillManifest,
        config: SceneConfig,
        rest_pose_rad: Mapping[str, float],
        *,
        period_s: float,
    ) -> None:
        super().__init__(manifest)
        self._config = config
        self._rest = rest_pose_rad
        self._period_s = period_s
        self._params: NavigateParams | None = None
        self._reset()

    def _reset(self) -> None:
        self._fold: JointRamp | None = None
        self._folded = False
        self._controller: PlanarController | None = None
        self._start_m = 0.0
        self._settling = 0
        self._best = (math.inf, math.inf)
        self._since_closer = 0

    async def _start(self, goal: Goal) -> None:
        self._reset()
        self._params = parse_goal(NavigateParams, self.manifest, goal.params)

    def _step(self, world: WorldState) -> StepOutcome:
        if self._params is None:
            raise BadRequest("navigate was stepped without a goal")
        if not self._folded and (action := self._fold_arm(world)) is not None:
            return Act(action)
        here = base_pose(world)
        if self._controller is None:
            goal = goal_pose(self._params, here, self._config)
            self._controller = PlanarController(goal, self._config, control_dt_s=self._period_s)
            self._start_m = max(self._controller.distance_m(here), 1e-3)
        gap_m = self._controller.distance_m(here)
        turn_rad = abs(wrap_angle(self._controller.goal.yaw_rad - here.yaw_rad))
        self.fraction = min(max(1.0 - gap_m / self._start_m, 0.0), 0.99)
        if self._controller.reached(here) or self._settling:
            self._settling += 1
            if self._settling > SETTLE_STEPS:
                return Done(
                    {
                        "base_pose": [here.x_m, here.y_m, here.yaw_rad],
                        "error_m": round(gap_m, 4),
                        "error_rad": round(turn_rad, 4),
                    }
                )
            return Hold("standing still")
        self._watch(gap_m, turn_rad)
        vx, vy, wz = self._controller.command(here)
        return Act(action_of({}, world.stamp_ns, (vx, vy, 0.0, 0.0, 0.0, wz)))

    def _fold_arm(self, world: WorldState) -> Action | None:
        """Return the next step towards the folded pose, or None once the arm is there."""
        measured = joint_positions(world, tuple(self._rest))
        if self._fold is None:
            if is_at(measured, self._rest):
                self._folded = True
                return None
            self._fold = JointRamp(measured, self._rest, period_s=self._period_s)
        if self._fold.done(measured):
            self._folded = True
            return None
        return action_of(self._fold.next_target(), world.stamp_ns)

    def _watch(self, gap_m: float, turn_rad: float) -> None:
        best_m, best_rad = self._best
        if gap_m < best_m - CLOSER_M or turn_rad < best_rad - CLOSER_RAD:
            self._since_closer = 0
            self._best = (min(gap_m, best_m), min(turn_rad, best_rad))
            return
        self._since_closer += 1
        if self._since_closer > STUCK_STEPS:
            raise GoalRejected(
                f"the base stays {gap_m:.3f} m and {turn_rad:.3f} rad from its goal",
                hint="the goal lies on or behind the table",
            )
