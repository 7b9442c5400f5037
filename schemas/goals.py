"""The runner's wire: goals, frames and state, on one ZeroMQ ROUTER socket.

Request {"op": …, "id": n, …} → reply {"re": n, "ok": true, …} | {"re": n, "ok": false, "error":
{…}}. A goal's progress comes as pushes to its sender: {"push": "feedback", …} and exactly one
{"push": "result", …} per accepted goal. The emergency stop has a socket of its own:
`schemas.estop`.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NotRequired, TypedDict

from vram_arbiter.schemas.limits import STRICT, Limits, Name, Seconds
from vram_arbiter.schemas.plain import JsonMap, JsonObject, Message
from vram_arbiter.schemas.runtime.telemetry.traceparent import Traceparent


class _Json:
    """An object of what JSON can say."""

    def __get_pydantic_core_schema__(self, source: object, handler: Any) -> JsonObject:
        from pydantic import JsonValue

        schema: JsonObject = handler.generate_schema(dict[str, JsonValue])
        return schema


@dataclass(frozen=True, slots=True, kw_only=True)
class RunnerCall:
    """Base of all requests. `id` is given by the connection, and repeated as `re`; `traceparent` is
    that of the caller's span."""

    __pydantic_config__: ClassVar = STRICT
    id: Annotated[int, Limits(ge=0, lt=1 << 53)] = 0
    traceparent: Traceparent = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SendGoal(RunnerCall):
    """Execute a skill. One goal at a time; a second is refused with `goal_rejected`. `deadline_s` 0
    takes the manifest's."""

    op: Literal["goal"] = "goal"
    goal_id: Name
    rskill_id: Name
    session: Annotated[str, Limits(max_length=64)] = ""
    """Of the runner that the task began with (`skills`, `state`): another one refuses the goal with
    `goal_rejected`. "": any runner executes it."""
    revision: str = ""
    prompt: Annotated[str, Limits(max_length=2000)] = ""
    goal_params: Annotated[JsonMap, _Json()] = field(default_factory=dict)
    deadline_s: Seconds = 0.0
    max_ticks: Annotated[int, Limits(gt=0)] | None = (
        None  # of motion; then it has failed with `limit_exceeded`
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CancelGoal(RunnerCall):
    op: Literal["cancel"] = "cancel"
    goal_id: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class GetResult(RunnerCall):
    """The result of a goal that ended (the last 64 are kept): for a client that reconnected."""

    op: Literal["result"] = "result"
    goal_id: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class GetFrame(RunnerCall):
    """Latest frame of a camera, no older than `max_age_ms`, else `frame_stale`. "" takes the
    runner's first camera."""

    op: Literal["frame"] = "frame"
    camera: str = ""
    encoding: Literal["jpeg", "png"] = (
        "jpeg"  # models want png: jpeg's artefacts cost them accuracy
    )
    max_age_ms: Annotated[float, Limits(gt=0, le=60_000)] = 500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GetState(RunnerCall):
    op: Literal["state"] = "state"


@dataclass(frozen=True, slots=True, kw_only=True)
class GetSkills(RunnerCall):
    op: Literal["skills"] = "skills"


@dataclass(frozen=True, slots=True, kw_only=True)
class GetGroundTruth(RunnerCall):
    """Simulator only: what is really there. For judges, never for planners."""

    op: Literal["ground_truth"] = "ground_truth"


@dataclass(frozen=True, slots=True, kw_only=True)
class ResetWorld(RunnerCall):
    """Simulator only: begin the scene again, or that of another seed. Refused while a goal runs."""

    op: Literal["reset"] = "reset"
    seed: Annotated[int, Limits(ge=0, lt=1 << 31)] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkEpisode(RunnerCall):
    """The operator's verdict on the episode of a goal: the one that runs, or the last one. ""
    takes that goal. A discarded episode is removed from the dataset."""

    op: Literal["mark"] = "mark"
    verdict: Literal["success", "failure", "discard"]
    goal_id: Name | Literal[""] = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeOverGoal(RunnerCall):
    """The operator takes the robot from the skill of the goal that runs, gives it back, or ends the
    goal as done. "" takes that goal. Refused with `bad_state` where that cannot be."""

    op: Literal["take_over"] = "take_over"
    do: Literal["take", "give_back", "end"]
    goal_id: Name | Literal[""] = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PingRunner(RunnerCall):
    op: Literal["ping"] = "ping"


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutdownRunner(RunnerCall):
    op: Literal["shutdown"] = "shutdown"


RunnerRequest = (
    SendGoal
    | CancelGoal
    | GetResult
    | GetFrame
    | GetState
    | GetSkills
    | GetGroundTruth
    | ResetWorld
    | MarkEpisode
    | TakeOverGoal
    | PingRunner
    | ShutdownRunner
)


class FrameReply(TypedDict):
    camera: str
    encoding: Literal["jpeg", "png"]
    data: bytes
    width: int
    height: int
    stamp_monotonic_ns: int
    age_ms: float
    camera_model: NotRequired[Message]
    """`schemas.world.CameraModel`: K, T_base_camera, support_plane_z."""


class FeedbackPush(TypedDict):
    push: Literal["feedback"]
    goal_id: str
    progress: float  # 0..1
    state: str  # e.g. "acquiring", "running"
    tick_idx: int
    detail: str


class ResultPush(TypedDict):
    push: Literal["result"]
    goal_id: str
    status: Literal["succeeded", "failed", "canceled", "deadline"]
    success: bool
    code: str  # "" or a code of schemas.errors
    message: str
    data: JsonObject
