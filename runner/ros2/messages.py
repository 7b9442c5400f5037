"""ROS 2 messages of the actions that are asked for and served: fields, and Cyclone's types of them.

A message is a map, as in a goal's `goal_params`: missing fields have ROS's defaults, unknown ones
are refused.
"""

from __future__ import annotations

import dataclasses
import functools
import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final

from vram_arbiter.runner.sensors.ros2_dds import parse, topic_type, written

type Fields = tuple[tuple[str, str, float], ...]
"""Name, type and default number of each."""

MESSAGES: Final[Mapping[str, str]] = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "trajectory_msgs/JointTrajectoryPoint": (
        "float64[] positions, float64[] velocities, float64[] accelerations, float64[] effort, "
        "builtin_interfaces/Duration time_from_start"
    ),
    "trajectory_msgs/JointTrajectory": (
        "std_msgs/Header header, string[] joint_names, "
        "trajectory_msgs/JointTrajectoryPoint[] points"
    ),
    "trajectory_msgs/MultiDOFJointTrajectoryPoint": (
        "geometry_msgs/Transform[] transforms, geometry_msgs/Twist[] velocities, "
        "geometry_msgs/Twist[] accelerations, builtin_interfaces/Duration time_from_start"
    ),
    "trajectory_msgs/MultiDOFJointTrajectory": (
        "std_msgs/Header header, string[] joint_names, "
        "trajectory_msgs/MultiDOFJointTrajectoryPoint[] points"
    ),
    "control_msgs/JointTolerance": (
        "string name, float64 position, float64 velocity, float64 acceleration"
    ),
    "control_msgs/JointComponentTolerance": (
        "string joint_name, uint16 component, float64 position, float64 velocity, "
        "float64 acceleration"
    ),
    "control_msgs/FollowJointTrajectory_Goal": (
        "trajectory_msgs/JointTrajectory trajectory, "
        "trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory, "
        "control_msgs/JointTolerance[] path_tolerance, "
        "control_msgs/JointComponentTolerance[] component_path_tolerance, "
        "control_msgs/JointTolerance[] goal_tolerance, "
        "control_msgs/JointComponentTolerance[] component_goal_tolerance, "
        "builtin_interfaces/Duration goal_time_tolerance"
    ),
    "control_msgs/FollowJointTrajectory_Result": "int32 error_code, string error_string",
    "nav2_msgs/NavigateToPose_Goal": "geometry_msgs/PoseStamped pose, string behavior_tree",
    "nav2_msgs/NavigateToPose_Result": "uint16 error_code, string error_msg",
    "openral_msgs/ExecuteRskill_Goal": (
        "string rskill_id, string revision, string prompt, string prompt_metadata_json, "
        "string goal_params_json, float64 deadline_s"
    ),
    "openral_msgs/ExecuteRskill_Result": "bool success, string failure_reason, string trace_id",
    "openral_msgs/ExecuteRskill_Feedback": (
        "float32 progress, string state, uint32 chunk_index, uint32 chunks_total"
    ),
    "action_msgs/GoalInfo": "unique_identifier_msgs/UUID goal_id, builtin_interfaces/Time stamp",
    "action_msgs/GoalStatus": "action_msgs/GoalInfo goal_info, int8 status",
    "action_msgs/GoalStatusArray": "action_msgs/GoalStatus[] status_list",
    "action_msgs/CancelGoal_Request": "action_msgs/GoalInfo goal_info",
    "action_msgs/CancelGoal_Response": "int8 return_code, action_msgs/GoalInfo[] goals_canceling",
}
"""The fields of each message, as ROS writes them: type, name, and a default."""
_OF_ACTIONS: Final[Mapping[str, str]] = {
    "SendGoal_Request": "unique_identifier_msgs/UUID goal_id, ACTION_Goal goal",
    "SendGoal_Response": "bool accepted, builtin_interfaces/Time stamp",
    "FeedbackMessage": "unique_identifier_msgs/UUID goal_id, ACTION_Feedback feedback",
    "GetResult_Request": "unique_identifier_msgs/UUID goal_id",
    "GetResult_Response": "int8 status, ACTION_Result result",
}
_CALL: Final = "uint64 guid, int64 seq"
"""What rmw_cyclonedds writes before each request and reply: the client, and its number."""
_NUMBERS: Final[Mapping[str, str]] = {
    "bool": "?", "int8": "b", "uint8": "B", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
ACTION_PARTS: Final = ("Goal", "Result", "Feedback", "FeedbackMessage", "SendGoal", "GetResult")
ITEMS_MAX: Final = 100_000  # of one sequence


def fields_of(kind: str) -> Fields:
    """Return the fields of a message, or of a service or topic that an action consists of."""
    if kind in MESSAGES:
        text = MESSAGES[kind]
    else:
        package, _, name = kind.partition("/")
        action, _, part = name.partition("_")
        text = _OF_ACTIONS[part].replace("ACTION", f"{package}/{action}")
    if kind.endswith(("_Request", "_Response")):
        text = f"{_CALL}, {text}"
    words = [field.split() for field in text.split(", ")]
    return tuple(
        (name, base, float(default[0]) if default else 0.0) for base, name, *default in words
    )


# -- CDR, by Cyclone
def write(kind: str, message: Mapping[str, Any]) -> bytes:
    """Return a message as plain CDR. Raises ValueError with the field that does not fit."""
    return written(_made(kind, message, ""))


def read(kind: str, cdr: bytes) -> dict[str, Any]:
    """Read a message from plain CDR. Raises ValueError."""
    return dataclasses.asdict(parse(_struct(kind), cdr))


def _split(kind: str) -> tuple[str, int | None]:
    """Return the type of an entry, and its count (None: one, 0: any number)."""
    base, bracket, count = kind.rstrip("]").partition("[")
    return base, (int(count or 0) if bracket else None)


def _made(kind: str, value: Any, at: str, default: float = 0.0) -> Any:
    """Return Cyclone's value of an entry. `at` names it in errors."""
    base, count = _split(kind)
    if count is not None:
        items = [] if value is None else value
        if not isinstance(items, Sequence) or isinstance(items, str) or len(items) > ITEMS_MAX:
            raise ValueError(f"{at}: expected a list, got {type(items).__name__}")
        if count not in (0, len(items)):
            raise ValueError(f"{at}: expected {count} numbers, got {len(items)}")
        return [_made(base, item, f"{at}[{index}]") for index, item in enumerate(items)]
    if base == "string":
        text = "" if value is None else value
        if not isinstance(text, str) or "\x00" in text:
            raise ValueError(f"{at}: expected a text, got {value!r:.40}")
        return text
    if base in _NUMBERS:
        missing: float | bool = default if base != "bool" else False
        return _number(_NUMBERS[base], missing if value is None else value, at)
    given = {} if value is None else value
    if not isinstance(given, Mapping):
        raise ValueError(f"{at or base}: expected a map, got {type(value).__name__}")
    fields = fields_of(base)
    if unknown := sorted(set(given) - {name for name, _, _ in fields}):
        raise ValueError(f"{at or base}: unknown field {unknown[0]}")
    below = f"{at}." if at else ""
    made = {name: _made(of, given.get(name), below + name, one) for name, of, one in fields}
    return _struct(base)(**made)


def _number(code: str, value: Any, at: str) -> float | bool:
    try:
        whole: float | bool = value if code in "fd?" else int(value)
        if isinstance(value, bool) != (code == "?") or whole != value:
            raise ValueError
        struct.pack(code, whole)
    except (struct.error, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{at}: expected a number of this field, got {value!r:.40}") from error
    return whole


def dds_name(kind: str) -> str:
    """Return the name of the DDS type: `nav2_msgs::action::dds_::NavigateToPose_Goal_`."""
    package, _, name = kind.partition("/")
    folder = "msg"
    _, action, part = name.partition("_")
    if action and part.partition("_")[0] in ACTION_PARTS:
        folder = "action"
    elif name.startswith("CancelGoal_"):
        folder = "srv"
    return f"{package}.{folder}.dds_.{name}_"


@functools.cache
def _struct(kind: str) -> Any:
    """Return Cyclone's IDL type of a message, under its ROS name."""
    from cyclonedds.idl import make_idl_struct, types

    def of(entry: str) -> Any:
        base, count = _split(entry)
        plain = {"string": str, "bool": bool}.get(base)
        one = plain or (getattr(types, base) if base in _NUMBERS else _struct(base))
        if count is None:
            return one
        return types.array[one, count] if count else types.sequence[one]

    members = {name: of(entry) for name, entry, _ in fields_of(kind)}
    return make_idl_struct(kind.partition("/")[2] + "_", dds_name(kind), members)


def dds_type(kind: str) -> Any:
    """Return the type of a topic of these messages; its samples stay as bytes."""
    return topic_type(_struct(kind))
