"""Message types of ROS 2 by their ROS names, such as `sensor_msgs/msg/Image`: fields, hashes, CDR,
and what Cyclone DDS is told of them.

The definitions of ROS 2 Jazzy and the codec are rosbags'; the interfaces that it lacks are below.
A message is a map, as in a goal's `goal_params`: missing fields have ROS's defaults, unknown ones
are refused; `uint8` lists are bytes. Knows no network.
"""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from vram_arbiter.schemas.runtime.extras import need

type RosMessage = dict[str, Any]
"""Fields of a message; nested messages are maps too."""

ACTIONS: Final[Mapping[str, str]] = {
    "control_msgs/FollowJointTrajectory": """
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointComponentTolerance[] component_path_tolerance
control_msgs/JointTolerance[] goal_tolerance
control_msgs/JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
""",
    "nav2_msgs/NavigateToPose": """
geometry_msgs/PoseStamped pose
string behavior_tree
---
uint16 error_code
string error_msg
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
""",
    "openral_msgs/ExecuteRskill": """
string rskill_id
string revision
string prompt
string prompt_metadata_json
string goal_params_json
float64 deadline_s
---
bool success
string failure_reason
string trace_id
---
float32 progress
string state
uint32 chunk_index
uint32 chunks_total
""",
}
"""Goal, result and feedback of each, as an `.action` file has them."""
SERVICES: Final[Mapping[str, str]] = {
    "std_srvs/Empty": "---",
    "std_srvs/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/Trigger": "---\nbool success\nstring message",
}
"""Request and reply of each, as a `.srv` file has them."""
FILLER: Final = "structure_needs_at_least_one_member"
"""`uint8` that ROS 2 adds to a message without fields."""
_OF_ACTIONS: Final[Mapping[str, str]] = {
    "SendGoal_Request": "unique_identifier_msgs/UUID goal_id\n{action}_Goal goal",
    "SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
    "FeedbackMessage": "unique_identifier_msgs/UUID goal_id\n{action}_Feedback feedback",
    "GetResult_Request": "unique_identifier_msgs/UUID goal_id",
    "GetResult_Response": "int8 status\n{action}_Result result",
}
_DEFINED: Final[Mapping[str, str]] = {
    "action_msgs/srv/CancelGoal_Request": "action_msgs/GoalInfo goal_info",
    "action_msgs/srv/CancelGoal_Response": (
        "int8 return_code\naction_msgs/GoalInfo[] goals_canceling"
    ),
    "control_msgs/msg/JointTolerance": (
        "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration"
    ),
    "control_msgs/msg/JointComponentTolerance": (
        "string joint_name\nuint16 component\nfloat64 position\nfloat64 velocity\n"
        "float64 acceleration"
    ),
}
_DEFAULTS: Final = {("geometry_msgs/msg/Quaternion", "w"): 1.0}
"""Defaults other than 0 and "": rosbags does not keep them."""
_NUMBERS: Final[Mapping[str, str]] = {
    "bool": "?", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_BYTES: Final = {"char": "uint8", "octet": "uint8"}
_CALL: Final = {"guid": "uint64", "seq": "int64"}
"""What rmw_cyclonedds writes before each request and reply: the client, and its number. It is not
part of the type, nor of its hash."""
ITEMS_MAX: Final = 100_000  # of one sequence that is no bytes


class Field(NamedTuple):
    """One field. `length` None: one value, 0: any number of them, or `most` where it is not 0."""

    name: str
    base: str
    length: int | None
    most: int = 0


@functools.cache
def typestore() -> Any:
    """Return rosbags' types, ours among them. Raises ConfigError: rosbags is missing."""
    need("ROS 2", "rosbags", extra="ros2")
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    texts = dict(_DEFINED)
    for interface, text in ACTIONS.items():
        action = action_of(interface)
        parts = zip(("Goal", "Result", "Feedback"), text.split("---"), strict=True)
        texts |= {f"{action}_{part}": fields for part, fields in parts}
        texts |= {
            f"{action}_{part}": _OF_ACTIONS[part].format(action=action) for part in _OF_ACTIONS
        }
    known = get_typestore(Stores.ROS2_JAZZY)
    for kind, text in texts.items():
        (fields,) = get_types_from_msg(text, kind).values()  # named without the folder `srv`
        known.register({kind: fields})
    return known


def action_of(interface: str) -> str:
    """Return `nav2_msgs/action/NavigateToPose`, of which an action's types are named."""
    package, _, name = interface.partition("/")
    return f"{package}/action/{name}"


@functools.cache
def service_of(interface: str, definition: str = "") -> str:
    """Make the types of a service known, and return the name of which they are named,
    `std_srvs/srv/Trigger`.

    `definition`: text of its `.srv` file, for a service that SERVICES lacks. Messages that ROS 2
    lacks follow it as in a rosbag: 80 `=`, `MSG: package/Type`, fields. Raises ValueError.
    """
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import get_types_from_msg
    from rosbags.typesys.base import TypesysError

    package, _, name = interface.partition("/")
    parts = re.split(r"^---\s*$", definition or SERVICES.get(interface, ""), flags=re.MULTILINE)
    if len(parts) != 2:
        known = "a line --- between request and reply" if definition else "a definition"
        raise ValueError(f"{interface} needs {known} in the manifest's ros_integration.definition")
    filler = [(FILLER, (Nodetype.BASE, ("uint8", 0)))]
    types: dict[str, Any] = {}
    try:
        for part, text in zip(("Request", "Response"), parts, strict=True):
            own = f"{package}/msg/{name}_{part}"
            types |= get_types_from_msg(text, own)
            types[f"{package}/srv/{name}_{part}"] = types.pop(own)
        typestore().register({kind: ([], of or filler) for kind, (_, of) in types.items()})
        for part in ("Request", "Response"):
            type_hash(f"{package}/srv/{name}_{part}")  # looks at every type in it
    except TypesysError as error:
        raise ValueError(f"the definition of {interface}: {str(error)[:200]}") from error
    except KeyError as error:
        raise ValueError(f"the definition of {interface} lacks that of {error.args[0]}") from error
    return f"{package}/srv/{name}"


@functools.cache
def fields_of(kind: str) -> tuple[Field, ...]:
    """Return the fields of a message."""
    from rosbags.interfaces import Nodetype

    found = []
    for name, (node, detail) in typestore().fielddefs[kind][1]:
        count, most = None, 0
        if node is Nodetype.ARRAY:
            (_, detail), count = detail
        elif node is Nodetype.SEQUENCE:
            (_, detail), most = detail
            count = 0
        base = detail if isinstance(detail, str) else detail[0]
        found.append(Field(name, _BYTES.get(base, base), count, most))
    return tuple(found)


@functools.cache
def type_hash(kind: str) -> str:
    """Return the hash of a type, `RIHS01_…` (REP 2011)."""
    return str(typestore().hash_rihs01(kind))


# -- CDR
def write(kind: str, message: Mapping[str, Any]) -> bytes:
    """Return a message as plain CDR; of a service with `guid` and `seq`, which need no alignment of
    what follows. Raises ValueError with the field that does not fit."""
    call, fields = b"", dict(message)
    if _is_call(kind):
        call = struct.pack("<Qq", *(fields.pop(name) for name in _CALL))
    cdr = bytes(typestore().serialize_cdr(_message(kind, fields, ""), kind, little_endian=True))
    return cdr[:4] + call + cdr[4:]


def read(kind: str, cdr: bytes) -> RosMessage:
    """Read a message from plain CDR. Raises ValueError."""
    from rosbags.serde import SerdeError

    call: RosMessage = {}
    try:
        if _is_call(kind):
            guid, seq = struct.unpack_from("<Qq" if cdr[1] else ">Qq", cdr, 4)
            call, cdr = {"guid": guid, "seq": seq}, cdr[:4] + cdr[20:]
        message = typestore().deserialize_cdr(cdr, kind)
    except (SerdeError, struct.error, IndexError) as error:
        raise ValueError(f"the message cannot be read: {error}") from error
    return call | _as_map(kind, message)


def _is_call(kind: str) -> bool:
    return kind.endswith(("_Request", "_Response"))


def _as_map(kind: str, message: Any) -> RosMessage:
    return {f.name: _as_plain(f, getattr(message, f.name)) for f in fields_of(kind)}


def _as_plain(field: Field, value: Any) -> Any:
    if field.base in _NUMBERS and field.length is not None:
        return value.tobytes() if field.base == "uint8" else value.tolist()
    if field.base == "string" or field.base in _NUMBERS:
        return value
    if field.length is None:
        return _as_map(field.base, value)
    return [_as_map(field.base, item) for item in value]


def _message(kind: str, value: Any, at: str) -> Any:
    """Return rosbags' object of a message. `at` names it in errors."""
    given = {} if value is None else value
    if not isinstance(given, Mapping):
        raise ValueError(f"{at or kind}: expected a map, got {type(value).__name__}")
    fields = fields_of(kind)
    if unknown := sorted(set(given) - {field.name for field in fields}):
        raise ValueError(f"{at or kind}: unknown field {unknown[0]}")
    below = f"{at}." if at else ""
    made = {
        field.name: _value(
            field, given.get(field.name, _DEFAULTS.get((kind, field.name))), below + field.name
        )
        for field in fields
    }
    return typestore().types[kind](**made)


def _value(field: Field, value: Any, at: str) -> Any:
    import numpy as np

    base, count = field.base, field.length
    if count is None:
        return _one(base, value, at)
    items = (b"" if base == "uint8" else []) if value is None else value
    if base == "uint8" and isinstance(items, bytes):
        listed: Any = np.frombuffer(items, np.uint8)
    elif not isinstance(items, Sequence) or isinstance(items, str) or len(items) > ITEMS_MAX:
        raise ValueError(f"{at}: expected a list, got {type(items).__name__}")
    else:
        listed = [_one(base, item, f"{at}[{index}]") for index, item in enumerate(items)]
        if base in _NUMBERS:
            listed = np.array(listed, dtype=base)
    if count not in (0, len(listed)):
        raise ValueError(f"{at}: expected {count} numbers, got {len(listed)}")
    if field.most and len(listed) > field.most:
        raise ValueError(f"{at}: expected at most {field.most} items, got {len(listed)}")
    return listed


def _one(base: str, value: Any, at: str) -> Any:
    if base == "string":
        text = "" if value is None else value
        if not isinstance(text, str) or "\x00" in text:
            raise ValueError(f"{at}: expected a text, got {value!r:.40}")
        return text
    if base in _NUMBERS:
        missing = 0 if base != "bool" else False
        return _number(_NUMBERS[base], missing if value is None else value, at)
    return _message(base, value, at)


def _number(code: str, value: Any, at: str) -> float | bool:
    try:
        whole: float | bool = value if code in "fd?" else int(value)
        if isinstance(value, bool) != (code == "?") or whole != value:
            raise ValueError
        struct.pack(code, whole)
    except (struct.error, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{at}: expected a number of this field, got {value!r:.40}") from error
    return whole


# -- types of Cyclone DDS
@functools.cache
def dds_type(kind: str) -> Any:
    """Return the type of a topic of these messages; its samples stay as bytes."""
    made = _struct(kind)
    made.deserialize = staticmethod(lambda data, *_, **__: sample_of(kind, bytes(data)))
    made.serialize = lambda self, *_, **__: cdr_of(self)
    return made


@functools.cache
def _struct(kind: str) -> Any:
    """Return Cyclone's IDL type under its ROS name, `nav2_msgs::…::NavigateToPose_Goal_`."""
    from cyclonedds.idl import make_idl_struct, types

    def of(base: str, count: int | None) -> Any:
        one = {"string": str, "bool": bool}.get(base) or (
            getattr(types, base) if base in _NUMBERS else _struct(base)
        )
        if count is None:
            return one
        return types.array[one, count] if count else types.sequence[one]

    package, folder, name = kind.split("/")
    call = {name: of(base, None) for name, base in _CALL.items()} if _is_call(kind) else {}
    members = {field.name: of(field.base, field.length) for field in fields_of(kind)}
    return make_idl_struct(f"{name}_", f"{package}.{folder}.dds_.{name}_", call | members)


def sample_of(kind: str, cdr: bytes) -> Any:
    """Return a sample of a message with these bytes."""
    of = dds_type(kind)
    sample = of.__new__(of)
    sample.cdr = cdr
    return sample


def cdr_of(sample: Any) -> bytes:
    """Return the bytes of a received sample, or of one made by `sample_of`."""
    cdr: bytes = sample.cdr
    return cdr
