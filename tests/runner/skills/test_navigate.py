"""Navigate on a robot without physics: folds, drives, stands; refuses what it does not
understand.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.runner.protocols import Act, Done, Goal, StepOutcome
from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE, SceneConfig
from vram_arbiter.runner.skills.navigate import Navigate, NavigateParams
from vram_arbiter.runner.skills.ros_goals import parse_goal
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import BadRequest, GoalRejected, ModelError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.world import JointState, Pose, WorldState

Run = Callable[[Any], Any]
CONFIG = SceneConfig()
FOLDED = dict(zip(ARM_JOINTS[:-1], REST_POSE, strict=False))


@pytest.fixture
def skill(navigate_manifest: Path) -> Navigate:
    return Navigate(load_manifest(navigate_manifest), CONFIG, FOLDED, period_s=1 / 30)


def world(env: Any) -> WorldState:
    x, y, yaw = env.base_pose()
    return WorldState(
        stamp_ns=1,
        joint_state=JointState(
            name=tuple(env.joints), position=tuple(env.joints.values()), stamp_ns=1
        ),
        base_pose=Pose(
            xyz=(x, y, 0.0),
            quat_xyzw=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
            frame_id="map",
        ),
    )


def drive_until_done(skill: Navigate, env: Any) -> tuple[StepOutcome, list[ControlMode]]:
    modes = []
    for _ in range(600):
        outcome = skill.step(world(env))
        if isinstance(outcome, Done):
            return outcome, modes
        if isinstance(outcome, Act):
            modes.append(outcome.action.control_mode)
            row = outcome.action.rows[0]
            if outcome.action.control_mode is ControlMode.BODY_TWIST:
                env.step(None, (row[0], row[1], row[5]))
            else:
                env.step(env.joints | dict(zip(outcome.action.joint_names or (), row, strict=True)))
    raise AssertionError("navigate did not end")


def begun(skill: Navigate, run_async: Run, **params: Any) -> None:
    run_async(skill.start(Goal("g", "navigate", params=params)))


def test_stands_so_that_a_point_lies_on_the_grasp_spot(
    skill: Navigate, env: Any, run_async: Run
) -> None:
    env.reset(0)
    begun(skill, run_async, target_point={"x": 0.70, "y": 0.20, "z": 0.22})
    done, modes = drive_until_done(skill, env)
    assert isinstance(done, Done)
    x, y, yaw = env.base_pose()
    spot = CONFIG.grasp_spot_in_base_m
    assert (x + spot[0], y + spot[1]) == pytest.approx((0.70, 0.20), abs=0.01)
    assert yaw == pytest.approx(0.0, abs=0.02)
    assert set(modes) == {ControlMode.BODY_TWIST}
    assert done.data["error_m"] <= 0.006


def test_turns_in_place(skill: Navigate, env: Any, run_async: Run) -> None:
    env.reset(0)
    begun(skill, run_async, turn_rad=-0.6)
    drive_until_done(skill, env)
    assert env.base_pose() == pytest.approx((0.0, 0.0, -0.6), abs=0.02)


@pytest.mark.parametrize(
    ("frame", "expected"),
    [("map", (-0.2, 0.1, 0.5)), ("odom", (-0.2, 0.1, 0.5)), ("base_link", (-0.1, -0.2, 2.07))],
)
def test_drives_to_a_pose_of_a_frame(
    skill: Navigate, env: Any, run_async: Run, frame: str, expected: tuple[float, float, float]
) -> None:
    env.reset(0)
    env.base = (0.0, 0.0, math.pi / 2)
    pose = {
        "header": {"frame_id": frame},
        "pose": {
            "position": {"x": -0.2, "y": 0.1},
            "orientation": {"z": math.sin(0.25), "w": math.cos(0.25)},
        },
    }
    begun(skill, run_async, pose=pose)
    drive_until_done(skill, env)
    assert env.base_pose() == pytest.approx(expected, abs=0.03)


def test_without_parameters_nothing_drives(skill: Navigate, env: Any, run_async: Run) -> None:
    env.reset(0)
    begun(skill, run_async)
    drive_until_done(skill, env)
    assert env.base_pose() == (0.0, 0.0, 0.0)


def test_folds_the_arm_first_and_keeps_the_gripper(
    skill: Navigate, env: Any, run_async: Run
) -> None:
    env.reset(0)
    env.joints.update(shoulder_lift=0.3, gripper=0.1)
    begun(skill, run_async, turn_rad=0.3)
    _, modes = drive_until_done(skill, env)
    assert modes.index(ControlMode.BODY_TWIST) == modes.count(ControlMode.JOINT_POSITION)
    rest = dict(zip(ARM_JOINTS, REST_POSE, strict=True)) | {"gripper": 0.1}
    assert env.joints == pytest.approx(rest)


def test_a_second_goal_starts_afresh(skill: Navigate, env: Any, run_async: Run) -> None:
    env.reset(0)
    for turn in (0.4, -0.4):
        begun(skill, run_async, turn_rad=turn)
        drive_until_done(skill, env)
        run_async(skill.finish())
    assert env.base_pose()[2] == pytest.approx(0.0, abs=0.04)


def test_fails_when_the_base_comes_no_closer(skill: Navigate, env: Any, run_async: Run) -> None:
    env.reset(0)
    far = {"header": {"frame_id": "map"}, "pose": {"position": {"x": 3.0, "y": 0.0}}}
    begun(skill, run_async, pose=far)
    with pytest.raises(GoalRejected, match="from its goal"):
        drive_until_done(skill, env)
    assert env.base_pose()[0] < CONFIG.table_edge_x_m


def test_no_odometry_no_drive(skill: Navigate, env: Any, run_async: Run) -> None:
    env.reset(0)
    begun(skill, run_async, turn_rad=0.1)
    with pytest.raises(ModelError, match="base's pose"):
        skill.step(world(env).model_copy(update={"base_pose": None}))


def test_no_joint_state_no_motion(skill: Navigate, env: Any, run_async: Run) -> None:
    env.reset(0)
    begun(skill, run_async, turn_rad=0.1)
    with pytest.raises(ModelError, match="joint state is stale"):
        skill.step(world(env).model_copy(update={"diagnostics": {"joint_state": "stale"}}))


@pytest.mark.parametrize(
    ("params", "path"),
    [
        ({"turn": 1}, "turn"),
        ({"turn_rad": "left"}, "turn_rad"),
        ({"turn_rad": 100}, "turn_rad"),
        ({"target_point": {"x": 1}}, "target_point.y"),
        ({"target_point": {"x": float("nan"), "y": 0}}, "target_point.x"),
        ({"target_point": {"x": 1, "y": 0}, "turn_rad": 1}, "not both"),
        ({"pose": {"header": {"frame_id": "moon"}}}, "frame_id"),
        ({"pose": {"pose": {"orientation": {"w": 0}}}}, "zero"),
    ],
)
def test_wrong_parameters_are_named(
    navigate_manifest: Path, params: dict[str, Any], path: str
) -> None:
    with pytest.raises(BadRequest, match=path.replace(".", r"\.")):
        parse_goal(NavigateParams, load_manifest(navigate_manifest), params)
