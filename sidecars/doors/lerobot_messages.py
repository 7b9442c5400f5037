"""What lerobot's robots send, checked, and the actions that they are sent: pickles both ways.

As of `lerobot.async_inference` 0.6.1 (`helpers.py`, `policy_server.py`), whose robots send two
classes and read one. Imports neither lerobot nor torch.
"""

import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.sidecars.doors import pickles

if TYPE_CHECKING:
    from numpy.typing import NDArray

STATE, IMAGES, TASK = "observation.state", "observation.images.", "task"
STEP_S: Final = 1 / 30
"""Between actions, lerobot's default: robots do not tell their rate. It is in the actions'
timestamps alone, which robots log; they play actions by their number."""
NUMBERS_MAX: Final = 2**53
_HELPERS: Final = "lerobot.async_inference.helpers"
_HINT: Final = "send what lerobot's robot_client sends"
_PROTOCOL: Final = 2  # the newest whose parts can be joined: later ones announce their length


@dataclass(frozen=True, slots=True)
class Instructions:
    """What a robot asks for: a skill, by its name or checkpoint.

    `state` names the robot's values in the order of the policy's state, `cameras` its pictures, by
    the policy's name of each. `actions_max`: of one answer.
    """

    skill: str
    state: tuple[str, ...]
    cameras: Mapping[str, str]
    actions_max: int


@dataclass(frozen=True, slots=True)
class Observation:
    """One control step. `timestep` is the number of the action that was played last, `values` is
    what a policy sidecar takes."""

    timestamp: float
    timestep: int
    must_go: bool
    values: dict[str, Any] = field(repr=False)


def instructions_of(data: bytes) -> Instructions:
    """Read a pickled `RemotePolicyConfig`. Its policy type and device are the sidecar's matter.

    Raises BadRequest or LimitExceeded.
    """
    fields = _fields(data, "RemotePolicyConfig")
    renamed = _checked(fields, "rename_map", dict, {})
    state: tuple[str, ...] = ()
    cameras = {}
    for name, feature in _checked(fields, "lerobot_features", dict).items():
        if not isinstance(name, str) or not isinstance(feature, dict):
            raise BadRequest(f"lerobot_features has {name!r}, no feature", hint=_HINT)
        if name == STATE:
            state = tuple(str(one) for one in _checked(feature, "names", list))
        elif name.startswith(IMAGES):
            cameras[str(renamed.get(name, name))] = name.removeprefix(IMAGES)
    if not state:
        raise BadRequest(f"lerobot_features lacks the names of {STATE}", hint=_HINT)
    return Instructions(
        _checked(fields, "pretrained_name_or_path", str),
        state,
        cameras,
        _whole(fields, "actions_per_chunk", 1),
    )


def observation_of(data: bytes, asked: Instructions) -> Observation:
    """Read a pickled `TimedObservation`, and put its values together as `asked` says.

    Raises BadRequest or LimitExceeded.
    """
    import numpy

    fields = _fields(data, "TimedObservation")
    raw = {
        name: value.numbers if isinstance(value, pickles.Array) else value
        for name, value in _checked(fields, "observation", dict).items()
    }
    if lacking := [one for one in (*asked.state, *asked.cameras.values()) if one not in raw]:
        raise BadRequest(
            f"the observation lacks {', '.join(lacking)[:200]}",
            hint=f"it has {sorted(map(str, raw))}",
        )
    try:
        state = numpy.array([float(raw[name]) for name in asked.state], numpy.float32)
    except (TypeError, ValueError):
        raise BadRequest("a value of the robot's state is not a number", hint=_HINT) from None
    timestamp = float(_checked(fields, "timestamp", (int, float)))
    if not math.isfinite(timestamp) or not numpy.isfinite(state).all():
        raise BadRequest("the observation has numbers that are not finite", hint=_HINT)
    pictures = {feature: raw[camera] for feature, camera in asked.cameras.items()}
    if wrong := [name for name, one in pictures.items() if not isinstance(one, numpy.ndarray)]:
        raise BadRequest(f"{wrong[0]} is not an array", hint="send the camera's picture")
    return Observation(
        timestamp,
        _whole(fields, "timestep", 0),
        fields.get("must_go") is True,
        {STATE: state, TASK: _checked(raw, TASK, str, ""), **pictures},
    )


def pickled_actions(observation: Observation, rows: "NDArray[Any]") -> bytes:
    """Return a pickled `list[TimedAction]`, of float32 tensors on the CPU.

    Joined from its parts, because to pickle lerobot's and torch's objects takes both packages.
    """
    named, tensor = f"c{_HELPERS}\nTimedAction\n(", "ctorch\ntensor\n("
    parts = [b"\x80\x02]("]
    for number, row in enumerate(rows):
        when = observation.timestamp + number * STEP_S
        parts += [named.encode(), _part(when), _part(observation.timestep + number)]
        parts += [tensor.encode(), _part(row.tolist()), b"tRtR"]
    return b"".join([*parts, b"e."])


def _part(value: float | Sequence[float]) -> bytes:
    """Return the pickle of a value without beginning and end."""
    return pickle.dumps(value, _PROTOCOL)[2:-1]


def _fields(data: bytes, kind: str) -> Mapping[Any, Any]:
    """Return the fields of the one object of class `kind` that a pickle holds."""
    value = pickles.read(data, {f"{_HELPERS}.{kind}": pickles.Record})
    if not isinstance(value, pickles.Record):
        raise BadRequest(f"expected a {kind}, got {type(value).__name__}", hint=_HINT)
    return value.fields


def _checked(fields: Mapping[Any, Any], name: str, kind: Any, default: Any = None) -> Any:
    value = fields.get(name, default)
    if not isinstance(value, kind):
        raise BadRequest(f"{name} is a {type(value).__name__}", hint=_HINT)
    return value


def _whole(fields: Mapping[Any, Any], name: str, least: int) -> int:
    value: int = _checked(fields, name, int)
    if not least <= value <= NUMBERS_MAX:
        raise BadRequest(f"{name} must be {least} to {NUMBERS_MAX}", hint=_HINT)
    return value
