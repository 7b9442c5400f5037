"""Trajectory goals and results as another ROS 2 implementation writes and reads them: types and
codec of Cyclone DDS alone, fields of control_msgs as of ROS 2 Jazzy.
"""

import pytest

pytestmark = pytest.mark.heavy
pytest.importorskip("cyclonedds")

from cyclonedds.idl.types import float64, int32, sequence, uint16, uint32  # noqa: E402

from tests.runner.ros2.independent import Time_, struct  # noqa: E402
from vram_arbiter.runner.sensors.ros2_types import read, write  # noqa: E402

KIND = "control_msgs/action/FollowJointTrajectory_"


Duration_ = struct("builtin_interfaces.msg.dds_.Duration_", sec=int32, nanosec=uint32)
Stamped_ = struct("std_msgs.msg.dds_.Header_", stamp=Time_, frame_id=str)
Point_ = struct(
    "trajectory_msgs.msg.dds_.JointTrajectoryPoint_",
    positions=sequence[float64],
    velocities=sequence[float64],
    accelerations=sequence[float64],
    effort=sequence[float64],
    time_from_start=Duration_,
)
Trajectory_ = struct(
    "trajectory_msgs.msg.dds_.JointTrajectory_",
    header=Stamped_,
    joint_names=sequence[str],
    points=sequence[Point_],
)
MultiPoint_ = struct(
    "trajectory_msgs.msg.dds_.MultiDOFJointTrajectoryPoint_",
    transforms=sequence[float64],
    velocities=sequence[float64],
    accelerations=sequence[float64],
    time_from_start=Duration_,
)
MultiTrajectory_ = struct(
    "trajectory_msgs.msg.dds_.MultiDOFJointTrajectory_",
    header=Stamped_,
    joint_names=sequence[str],
    points=sequence[MultiPoint_],
)
Tolerance_ = struct(
    "control_msgs.msg.dds_.JointTolerance_",
    name=str,
    position=float64,
    velocity=float64,
    acceleration=float64,
)
Component_ = struct(
    "control_msgs.msg.dds_.JointComponentTolerance_",
    joint_name=str,
    component=uint16,
    position=float64,
    velocity=float64,
    acceleration=float64,
)
Goal_ = struct(
    "control_msgs.action.dds_.FollowJointTrajectory_Goal_",
    trajectory=Trajectory_,
    multi_dof_trajectory=MultiTrajectory_,
    path_tolerance=sequence[Tolerance_],
    component_path_tolerance=sequence[Component_],
    goal_tolerance=sequence[Tolerance_],
    component_goal_tolerance=sequence[Component_],
    goal_time_tolerance=Duration_,
)
Result_ = struct(
    "control_msgs.action.dds_.FollowJointTrajectory_Result_", error_code=int32, error_string=str
)


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
