"""Control modes: the thirteen ways in which a skill can command a robot, shared by manifests and
actions.

It knows no robot and no skill: only the names, their numbers on the wire, and what each mode
addresses.
"""

from enum import StrEnum


class ControlMode(StrEnum):
    """Action space of an actuator, a slot of an action vector, or one `Action`. The order is the
    wire number, 0 to 12."""

    JOINT_POSITION = "joint_position"
    JOINT_VELOCITY = "joint_velocity"
    JOINT_TORQUE = "joint_torque"
    JOINT_TRAJECTORY = "joint_trajectory"
    CARTESIAN_POSE = "cartesian_pose"
    CARTESIAN_DELTA = "cartesian_delta"
    CARTESIAN_TWIST = "cartesian_twist"
    BODY_TWIST = "body_twist"
    FOOT_PLACEMENT = "foot_placement"
    GRIPPER_BINARY = "gripper_binary"
    GRIPPER_POSITION = "gripper_position"
    DEX_HAND_JOINT = "dex_hand_joint"
    COMPOSITE_MODE = "composite_mode"


JOINT_MODES = frozenset(
    {ControlMode.JOINT_POSITION, ControlMode.JOINT_VELOCITY, ControlMode.JOINT_TORQUE}
)
CARTESIAN_MODES = frozenset(
    {ControlMode.CARTESIAN_POSE, ControlMode.CARTESIAN_DELTA, ControlMode.CARTESIAN_TWIST}
)
GRIPPER_MODES = frozenset({ControlMode.GRIPPER_BINARY, ControlMode.GRIPPER_POSITION})
