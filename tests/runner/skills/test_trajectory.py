"""What stands in for FollowJointTrajectory: what is refused before anything moves, and that the
targets are those of the points, never faster.
"""

import asyncio
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.runner.protocols import Act, Done, Goal, Paced, StepOutcome
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.safety.limits import Limits, own_limits
from vram_arbiter.runner.skills.ros_standins import (
    NAVIGATE,
    TRAJECTORY,
    StandIn,
    StandIns,
    interface_of,
)
from vram_arbiter.runner.skills.trajectory import ARRIVE_S, FollowJointTrajectory
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import BadRequest, GoalRejected, ModelError, PathToleranceViolated
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.world import JointState, WorldState

CONFIGS = Path(__file__).parents[3] / "configs/rskills"
MOVE, DRIVE = (
    load_manifest(CONFIGS / f"so101-{name}/rskill.yaml") for name in ("move", "navigate")
)
ROBOT = so101(simulated=True)
LIMITS = own_limits(ROBOT)
PERIOD_S = 1 / 30


def trajectory(
    *points: tuple[float, ...],
    names: tuple[str, ...] = ("elbow_flex",),
    every_s: float = 1.0,
    **more: Any,
) -> dict[str, Any]:
    stamped = [
        {"positions": list(positions), "time_from_start": duration(every_s * (number + 1))}
        for number, positions in enumerate(points)
    ]
    return {"trajectory": {"joint_names": list(names), "points": stamped}, **more}


def duration(seconds: float) -> dict[str, int]:
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def world(stale: tuple[str, ...] = (), **angles: float) -> WorldState:
    names = ROBOT.joint_names
    positions = tuple(angles.get(name, 0.0) for name in names)
    return WorldState(
        stamp_ns=1,
        joint_state=JointState(name=names, position=positions, stamp_ns=1),
        diagnostics=dict.fromkeys(stale, "stale"),
    )


def started(
    params: dict[str, Any], manifest: RSkillManifest = MOVE, limits: Limits = LIMITS
) -> FollowJointTrajectory:
    skill = FollowJointTrajectory(manifest, limits, period_s=PERIOD_S)
    asyncio.run(skill.start(Goal("g", manifest.name, params=params)))
    return skill


def targets_of(skill: FollowJointTrajectory, start: float = 0.0) -> list[float]:
    """Targets of the elbow for an arm that goes where it is told, until the skill is done."""
    targets, here = [], start
    while not isinstance(outcome := skill.step(world(elbow_flex=here)), Done):
        assert isinstance(outcome, Act)
        assert outcome.action.joint_names == ("elbow_flex",), "the other joints stay"
        ((here,),) = outcome.action.joint_targets or ()
        targets.append(here)
    return targets


def test_the_way_is_straight_from_point_to_point() -> None:
    targets = targets_of(started(trajectory((0.6,), (0.3,))), start=-0.3)
    assert targets[14] == pytest.approx(0.15, abs=1e-9), "half a second: half way"
    assert targets[29] == pytest.approx(0.6, abs=1e-9)
    assert targets[44] == pytest.approx(0.45, abs=1e-9)
    assert targets[-1] == pytest.approx(0.3, abs=1e-9)
    assert len(targets) in (60, 61), "two seconds, and no longer"


def test_a_gripper_that_holds_something_is_not_let_go_when_a_trajectory_begins() -> None:
    """Regression: it began where the gripper was, which is not where it had been told to be: what
    it held fell down.
    """
    skill = FollowJointTrajectory(
        MOVE, LIMITS, period_s=PERIOD_S, sent=lambda: {"gripper": -0.1, "elbow_flex": 0.0}
    )
    params = trajectory((0.3, -0.1), (0.3, 0.6), names=("elbow_flex", "gripper"))
    asyncio.run(skill.start(Goal("g", MOVE.name, params=params)))
    grips = []
    for _ in range(60):
        outcome = skill.step(world(gripper=0.3))
        assert isinstance(outcome, Act)
        ((_, grip),) = outcome.action.joint_targets or ()
        grips.append(grip)
    assert grips[:30] == pytest.approx([-0.1] * 30), "as it was told, although it stands at 0.3"
    assert grips[-1] == pytest.approx(0.6)


@settings(max_examples=60, deadline=None)
@given(
    points=st.lists(st.floats(-1.6, 1.6), min_size=1, max_size=6),
    start=st.floats(-1.6, 1.6),
    every_s=st.floats(0.01, 3.0),
)
def test_it_is_refused_or_played_within_the_limits(
    points: list[float], start: float, every_s: float
) -> None:
    most = LIMITS.speeds_rad_s["elbow_flex"]
    fast = any(abs(b - a) / every_s > most * 1.01 for a, b in pairwise([start, *points]))
    try:
        targets = targets_of(started(trajectory(*((p,) for p in points), every_s=every_s)), start)
    except BadRequest:
        assert any(abs(b - a) / every_s > most * 0.99 for a, b in pairwise([start, *points]))
        return
    assert not fast
    steps = [abs(b - a) for a, b in pairwise([start, *targets])]
    assert max(steps, default=0.0) <= most * PERIOD_S * 1.01
    assert targets == [] or targets[-1] == pytest.approx(points[-1], abs=1e-6)
    low, high = min(start, *points), max(start, *points)
    assert all(low - 1e-9 <= target <= high + 1e-9 for target in targets)


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({}, "an empty one moves nothing"),
        (trajectory(), "an empty one moves nothing"),
        (trajectory((0.1, 0.1), names=("elbow_flex", "elbow_flex")), "named twice"),
        (trajectory((0.1,), names=("elbow",)), "unknown joint elbow; the robot has shoulder_pan"),
        (trajectory((0.1, 0.2)), r"points\[0\]: 2 positions for 1 joints"),
        (trajectory((2.0,)), r"points\[0\]: elbow_flex 2 rad is outside"),
        (trajectory((0.0,), (1.5,), every_s=0.1),
         r"points\[1\]: elbow_flex would have to make 15.00 rad/s; at most 4.70"),
        (trajectory((0.1,), (0.2,), every_s=0.0), "time_from_start must be above 0"),
        (trajectory((math.nan,)), "finite number"),
        (trajectory((0.1,), path_tolerance=[{"name": "elbow", "position": 0.1}]),
         "unknown joint elbow"),
        (trajectory((0.1,), goal_tolerance=[{"name": "elbow", "position": 0.1}]),
         "unknown joint elbow"),
        (trajectory((0.1,)) | {"speed": 3}, "speed"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_refused_before_anything_moves(
    params: dict[str, Any], said: str
) -> None:
    with pytest.raises(BadRequest, match=said):
        started(params)


def test_points_that_do_not_come_later_are_refused() -> None:
    params = trajectory((0.1,), (0.2,))
    params["trajectory"]["points"][1]["time_from_start"] = duration(1.0)
    with pytest.raises(BadRequest, match="must grow from point to point"):
        started(params)


def test_the_way_to_the_first_point_counts_too() -> None:
    skill = started(trajectory((1.5,), every_s=0.5))
    with pytest.raises(BadRequest, match="from where the arm is"):
        skill.step(world(elbow_flex=-1.5))


def test_a_joint_that_leaves_its_path_fails_the_goal() -> None:
    """By the target that was sent last, and on the way only: at its end other tolerances hold."""
    skill = started(trajectory((0.5,), path_tolerance=[{"name": "elbow_flex", "position": 0.1}]))
    for _ in range(6):
        skill.step(world(elbow_flex=0.0))
    skill.step(world(elbow_flex=0.0))  # told to be at 6/30 of the way
    with pytest.raises(PathToleranceViolated, match=r"elbow_flex is 0\.117 rad from its path"):
        skill.step(world(elbow_flex=0.0))


def test_nothing_moves_on_a_stale_state() -> None:
    with pytest.raises(ModelError, match="stale"):
        started(trajectory((0.1,))).step(world(stale=("joint_state",)))


def stuck_at(skill: FollowJointTrajectory, angle: float, outcomes: list[StepOutcome]) -> None:
    """Step until it gives up, at most a minute."""
    for _ in range(1800):
        outcomes.append(skill.step(world(elbow_flex=angle)))


def test_an_arm_that_does_not_arrive_fails_the_goal() -> None:
    """It never reports a motion that was not made."""
    skill = started(trajectory((0.5,)))
    outcomes: list[StepOutcome] = []
    with pytest.raises(GoalRejected, match=r"elbow_flex is 0\.500 rad from the last point"):
        stuck_at(skill, 0.0, outcomes)
    assert all(isinstance(outcome, Act) for outcome in outcomes)
    assert len(outcomes) == pytest.approx((1.0 + ARRIVE_S) / PERIOD_S, abs=2)
    tight = trajectory(
        (0.5,),
        goal_tolerance=[{"name": "elbow_flex", "position": 0.01}],
        goal_time_tolerance=duration(0.1),
    )
    skill = started(tight)
    with pytest.raises(GoalRejected, match=r"0\.020 rad from"):
        stuck_at(skill, 0.48, [])


def test_a_second_goal_starts_from_nothing() -> None:
    """The defect of the field: a wrapped skill that had ended was done at once the next time,
    without motion.
    """
    skill = started(trajectory((0.5,)))
    assert targets_of(skill)[-1] == pytest.approx(0.5)
    asyncio.run(skill.finish())
    asyncio.run(skill.start(Goal("h", MOVE.name, params=trajectory((-0.5,)))))
    assert targets_of(skill, start=0.5)[-1] == pytest.approx(-0.5)


# -- which skills there is a stand-in for
def stand_ins(*known: str) -> StandIns:
    drives = {TRAJECTORY: {ControlMode.JOINT_POSITION}, NAVIGATE: {ControlMode.BODY_TWIST}}
    made = {
        name: StandIn(
            lambda manifest: FollowJointTrajectory(manifest, LIMITS, period_s=PERIOD_S),
            frozenset(drives[name]),
        )
        for name in known
    }
    return StandIns(made, ROBOT.joint_names)


def changed(manifest: RSkillManifest, **fields: Any) -> RSkillManifest:
    return RSkillManifest.model_validate(
        json.loads(manifest.model_dump_json(exclude_unset=True)) | fields
    )


def test_a_ros_action_without_a_stand_in_is_refused_with_what_there_is() -> None:
    both, arm = stand_ins(TRAJECTORY, NAVIGATE), stand_ins(TRAJECTORY)
    assert both.refuses(MOVE) == both.refuses(DRIVE) == arm.refuses(MOVE) == ""
    said = arm.refuses(DRIVE)
    assert (
        "this runner stands in for control_msgs/FollowJointTrajectory, not for"
        " nav2_msgs/NavigateToPose" in said
    )
    assert isinstance(arm(MOVE), FollowJointTrajectory)


def test_types_are_read_as_ros_writes_them_and_packages_count() -> None:
    ros = MOVE.ros_integration
    long = changed(
        MOVE,
        ros_integration=ros.model_dump()
        | {"interface_type": "control_msgs/action/FollowJointTrajectory"},
    )
    assert interface_of(long) == TRAJECTORY
    other = changed(MOVE, ros_integration=ros.model_dump() | {"package": "my_msgs"})
    assert "not for my_msgs/FollowJointTrajectory" in stand_ins(TRAJECTORY).refuses(other)


def test_what_it_drives_has_to_be_what_the_stand_in_drives() -> None:
    twist = [{"kind": "body_twist", "control_mode_semantics": {"mode": "absolute"}}]
    said = stand_ins(TRAJECTORY).refuses(changed(MOVE, actuators_required=twist))
    assert (
        said == f"it drives by body_twist; the stand-in for {TRAJECTORY} drives by joint_position"
    )
    legs = [
        {
            "kind": "joint_position",
            "control_mode_semantics": {"mode": "absolute", "joint_order": ["hip", "knee"]},
        }
    ]
    assert (
        stand_ins(TRAJECTORY)
        .refuses(changed(MOVE, actuators_required=legs))
        .startswith("it moves hip, knee; the robot has")
    )


def test_the_clock_stands_while_targets_are_withheld() -> None:
    """Regression: the targets moved on while the arm stood, until they were too far ahead for any
    speed.
    """
    skill = started(trajectory((0.6,)))
    first = skill.step(world())
    for _ in range(20):
        skill.withheld()
        assert skill.step(world()) == first
    assert isinstance(skill, Paced)
    assert targets_of(skill)[0] == pytest.approx(2 * 0.6 * PERIOD_S), "the second period"
