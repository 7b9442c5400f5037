"""Trajectory goals and results as another ROS 2 implementation writes and reads them."""

import pytest

pytestmark = pytest.mark.heavy
pytest.importorskip("cyclonedds")

from tests.runner.ros2.trajectory_messages import (  # noqa: E402
    Component_,
    Duration_,
    Goal_,
    Result_,
    Tolerance_,
)
from vram_arbiter.runner.sensors.ros2_types import read, write  # noqa: E402

KIND = "control_msgs/action/FollowJointTrajectory_"


def test_another_codec_reads_a_goal_and_writes_one_that_is_read() -> None:
    """Names and numbers of odd lengths: what stands behind them is aligned."""
    sent = {
        "trajectory": {
            "joint_names": ["a", "elbow_flex"],
            "points": [
                {"positions": [0.5, -1.0], "time_from_start": {"sec": 1, "nanosec": 5}},
                {"positions": [0.0, 0.25], "time_from_start": {"sec": 2}},
            ],
        },
        "goal_tolerance": [{"name": "elbow_flex", "position": 0.01}],
        "goal_time_tolerance": {"sec": 2, "nanosec": 7},
    }
    cdr = write(KIND + "Goal", sent)
    goal = Goal_.deserialize(cdr)
    first, second = goal.trajectory.points
    assert goal.trajectory.joint_names == ["a", "elbow_flex"]
    assert (first.positions, first.time_from_start) == ([0.5, -1.0], Duration_(1, 5))
    assert (second.positions, second.time_from_start) == ([0.0, 0.25], Duration_(2, 0))
    assert goal.goal_tolerance == [Tolerance_("elbow_flex", 0.01, 0.0, 0.0)]
    assert goal.goal_time_tolerance == Duration_(2, 7)
    goal.component_goal_tolerance = [Component_("base", 3, 0.1, 0.2, 0.3)]
    back = read(KIND + "Goal", goal.serialize(use_version_2=False))
    assert back["trajectory"]["points"][1]["positions"] == [0.0, 0.25]
    (component,) = back["component_goal_tolerance"]
    assert (component["joint_name"], component["component"]) == ("base", 3)
    assert (component["position"], component["acceleration"]) == (0.1, 0.3)
    assert back["goal_time_tolerance"] == {"sec": 2, "nanosec": 7}


def test_another_codecs_result_is_read() -> None:
    result = Result_(-4, "shoulder_pan is 0.2 rad off")
    back = read(KIND + "Result", result.serialize(use_version_2=False))
    assert back == {"error_code": -4, "error_string": "shoulder_pan is 0.2 rad off"}
