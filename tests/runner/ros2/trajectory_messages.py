"""Messages of `FollowJointTrajectory` as another ROS 2 implementation has them: types of Cyclone
DDS alone, fields of control_msgs as of ROS 2 Jazzy."""

from cyclonedds.idl.types import float64, int32, sequence, uint16, uint32

from tests.runner.ros2.independent import Transform_, Vector3_
from tests.runner.sensors.ros2_node import Header_, struct

PREFIX = "control_msgs.action.dds_.FollowJointTrajectory_"
Duration_ = struct("builtin_interfaces.msg.dds_.Duration_", sec=int32, nanosec=uint32)
Twist_ = struct("geometry_msgs.msg.dds_.Twist_", linear=Vector3_, angular=Vector3_)
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
    header=Header_,
    joint_names=sequence[str],
    points=sequence[Point_],
)
MultiPoint_ = struct(
    "trajectory_msgs.msg.dds_.MultiDOFJointTrajectoryPoint_",
    transforms=sequence[Transform_],
    velocities=sequence[Twist_],
    accelerations=sequence[Twist_],
    time_from_start=Duration_,
)
MultiTrajectory_ = struct(
    "trajectory_msgs.msg.dds_.MultiDOFJointTrajectory_",
    header=Header_,
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
    PREFIX + "Goal_",
    trajectory=Trajectory_,
    multi_dof_trajectory=MultiTrajectory_,
    path_tolerance=sequence[Tolerance_],
    component_path_tolerance=sequence[Component_],
    goal_tolerance=sequence[Tolerance_],
    component_goal_tolerance=sequence[Component_],
    goal_time_tolerance=Duration_,
)
Result_ = struct(PREFIX + "Result_", error_code=int32, error_string=str)
Feedback_ = struct(
    PREFIX + "Feedback_",
    header=Header_,
    joint_names=sequence[str],
    desired=Point_,
    actual=Point_,
    error=Point_,
    multi_dof_joint_names=sequence[str],
    multi_dof_desired=MultiPoint_,
    multi_dof_actual=MultiPoint_,
    multi_dof_error=MultiPoint_,
)
