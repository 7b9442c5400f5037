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

type Fields = tuple[tuple[str, str], ...]

_XYZ: Final[Fields] = (("x", "float64"), ("y", "float64"), ("z", "float64"))
_TOLERANCE: Final[Fields] = (
    ("position", "float64"),
    ("velocity", "float64"),
    ("acceleration", "float64"),
)
_CALL: Final[Fields] = (("guid", "uint64"), ("seq", "int64"))
"""What rmw_cyclonedds writes before each request and reply: the client, and its number."""

MESSAGES: Final[Mapping[str, Fields]] = {
    "builtin_interfaces/Time": (("sec", "int32"), ("nanosec", "uint32")),
    "builtin_interfaces/Duration": (("sec", "int32"), ("nanosec", "uint32")),
    "std_msgs/Header": (("stamp", "builtin_interfaces/Time"), ("frame_id", "string")),
    "unique_identifier_msgs/UUID": (("uuid", "uint8[16]"),),
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Quaternion": (*_XYZ, ("w", "float64=1")),
    "geometry_msgs/Pose": (
        ("position", "geometry_msgs/Point"),
        ("orientation", "geometry_msgs/Quaternion"),
    ),
    "geometry_msgs/PoseStamped": (("header", "std_msgs/Header"), ("pose", "geometry_msgs/Pose")),
    "geometry_msgs/Transform": (
        ("translation", "geometry_msgs/Vector3"),
        ("rotation", "geometry_msgs/Quaternion"),
    ),
    "geometry_msgs/Twist": (
        ("linear", "geometry_msgs/Vector3"),
        ("angular", "geometry_msgs/Vector3"),
    ),
    "trajectory_msgs/JointTrajectoryPoint": (
        ("positions", "float64[]"),
        ("velocities", "float64[]"),
        ("accelerations", "float64[]"),
        ("effort", "float64[]"),
        ("time_from_start", "builtin_interfaces/Duration"),
    ),
    "trajectory_msgs/JointTrajectory": (
        ("header", "std_msgs/Header"),
        ("joint_names", "string[]"),
        ("points", "trajectory_msgs/JointTrajectoryPoint[]"),
    ),
    "trajectory_msgs/MultiDOFJointTrajectoryPoint": (
        ("transforms", "geometry_msgs/Transform[]"),
        ("velocities", "geometry_msgs/Twist[]"),
        ("accelerations", "geometry_msgs/Twist[]"),
        ("time_from_start", "builtin_interfaces/Duration"),
    ),
    "trajectory_msgs/MultiDOFJointTrajectory": (
        ("header", "std_msgs/Header"),
        ("joint_names", "string[]"),
        ("points", "trajectory_msgs/MultiDOFJointTrajectoryPoint[]"),
    ),
    "control_msgs/JointTolerance": (("name", "string"), *_TOLERANCE),
    "control_msgs/JointComponentTolerance": (
        ("joint_name", "string"),
        ("component", "uint16"),
        *_TOLERANCE,
    ),
    "control_msgs/FollowJointTrajectory_Goal": (
        ("trajectory", "trajectory_msgs/JointTrajectory"),
        ("multi_dof_trajectory", "trajectory_msgs/MultiDOFJointTrajectory"),
        ("path_tolerance", "control_msgs/JointTolerance[]"),
        ("component_path_tolerance", "control_msgs/JointComponentTolerance[]"),
        ("goal_tolerance", "control_msgs/JointTolerance[]"),
        ("component_goal_tolerance", "control_msgs/JointComponentTolerance[]"),
        ("goal_time_tolerance", "builtin_interfaces/Duration"),
    ),
    "control_msgs/FollowJointTrajectory_Result": (
        ("error_code", "int32"),
        ("error_string", "string"),
    ),
    "nav2_msgs/NavigateToPose_Goal": (
        ("pose", "geometry_msgs/PoseStamped"),
        ("behavior_tree", "string"),
    ),
    "nav2_msgs/NavigateToPose_Result": (("error_code", "uint16"), ("error_msg", "string")),
    "openral_msgs/ExecuteRskill_Goal": (
        ("rskill_id", "string"),
        ("revision", "string"),
        ("prompt", "string"),
        ("prompt_metadata_json", "string"),
        ("goal_params_json", "string"),
        ("deadline_s", "float64"),
    ),
    "openral_msgs/ExecuteRskill_Result": (
        ("success", "bool"),
        ("failure_reason", "string"),
        ("trace_id", "string"),
    ),
    "openral_msgs/ExecuteRskill_Feedback": (
        ("progress", "float32"),
        ("state", "string"),
        ("chunk_index", "uint32"),
        ("chunks_total", "uint32"),
    ),
    "action_msgs/GoalInfo": (
        ("goal_id", "unique_identifier_msgs/UUID"),
        ("stamp", "builtin_interfaces/Time"),
    ),
    "action_msgs/GoalStatus": (("goal_info", "action_msgs/GoalInfo"), ("status", "int8")),
    "action_msgs/GoalStatusArray": (("status_list", "action_msgs/GoalStatus[]"),),
    "action_msgs/CancelGoal_Request": (*_CALL, ("goal_info", "action_msgs/GoalInfo")),
    "action_msgs/CancelGoal_Response": (
        *_CALL,
        ("return_code", "int8"),
        ("goals_canceling", "action_msgs/GoalInfo[]"),
    ),
}
_NUMBERS: Final[Mapping[str, str]] = {
    "bool": "?", "int8": "b", "uint8": "B", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
ACTION_PARTS: Final = ("Goal", "Result", "Feedback", "FeedbackMessage", "SendGoal", "GetResult")
ITEMS_MAX: Final = 100_000  # of one sequence


def fields_of(kind: str) -> Fields:
    """Return the fields of a message, or of a service or topic that an action consists of."""
    if kind in MESSAGES:
        return MESSAGES[kind]
    package, _, name = kind.partition("/")
    action, _, part = name.partition("_")
    action = f"{package}/{action}"
    goal_id = ("goal_id", "unique_identifier_msgs/UUID")
    return {
        "SendGoal_Request": (*_CALL, goal_id, ("goal", f"{action}_Goal")),
        "SendGoal_Response": (
            *_CALL,
            ("accepted", "bool"),
            ("stamp", "builtin_interfaces/Time"),
        ),
        "FeedbackMessage": (goal_id, ("feedback", f"{action}_Feedback")),
        "GetResult_Request": (*_CALL, goal_id),
        "GetResult_Response": (*_CALL, ("status", "int8"), ("result", f"{action}_Result")),
    }[part]


# -- CDR, by Cyclone
def write(kind: str, message: Mapping[str, Any]) -> bytes:
    """Return a message as plain CDR. Raises ValueError with the field that does not fit."""
    return written(_made(kind, message, ""))


def read(kind: str, cdr: bytes) -> dict[str, Any]:
    """Read a message from plain CDR. Raises ValueError."""
    return dataclasses.asdict(parse(_struct(kind), cdr))


def _split(kind: str) -> tuple[str, int | None, float]:
    """Return the type of an entry, its count (None: one, 0: any number), and its default."""
    kind, _, default = kind.partition("=")
    base, bracket, count = kind.rstrip("]").partition("[")
    return base, (int(count or 0) if bracket else None), float(default or 0)


def _made(kind: str, value: Any, at: str) -> Any:
    """Return Cyclone's value of an entry. `at` names it in errors."""
    base, count, default = _split(kind)
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
    if unknown := sorted(set(given) - {name for name, _ in fields}):
        raise ValueError(f"{at or base}: unknown field {unknown[0]}")
    below = f"{at}." if at else ""
    return _struct(base)(
        **{name: _made(entry, given.get(name), below + name) for name, entry in fields}
    )


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
        base, count, _ = _split(entry)
        plain = {"string": str, "bool": bool}.get(base)
        one = plain or (getattr(types, base) if base in _NUMBERS else _struct(base))
        if count is None:
            return one
        return types.array[one, count] if count else types.sequence[one]

    members = {name: of(entry) for name, entry in fields_of(kind)}
    return make_idl_struct(kind.partition("/")[2] + "_", dds_name(kind), members)


def dds_type(kind: str) -> Any:
    """Return the type of a topic of these messages; its samples stay as bytes."""
    return topic_type(_struct(kind))
