"""The runner's wire: goals, frames and state, on one ZeroMQ ROUTER socket.

Request {"op": …, "id": n, …} → reply {"re": n, "ok": true, …} | {"re": n, "ok": false, "error":
{…}}. A goal's progress comes as pushes to its sender: {"push": "feedback", …} and exactly one
{"push": "result", …} per accepted goal. The emergency stop has a socket of its own:
`schemas.estop`.
"""

from typing import Annotated, Literal, NotRequired, TypedDict

from pydantic import BaseModel, ConfigDict, Field, JsonValue, TypeAdapter

from vram_arbiter.schemas.limits import Name, Seconds
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.telemetry.traceparent import Traceparent


class _Call(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    id: Annotated[int, Field(ge=0, lt=1 << 53)]
    traceparent: Traceparent = None


class SendGoal(_Call):
    """Execute a skill. One goal at a time; a second is refused with `goal_rejected`. `deadline_s` 0
    takes the manifest's."""

    op: Literal["goal"]
    goal_id: Name
    rskill_id: Name
    session: Annotated[str, Field(max_length=64)] = ""
    """Of the runner that the task began with (`skills`, `state`): another one refuses the goal with
    `goal_rejected`. "": any runner executes it."""
    revision: str = ""
    prompt: Annotated[str, Field(max_length=2000)] = ""
    goal_params: dict[str, JsonValue] = Field(default_factory=dict)
    deadline_s: Seconds = 0.0
    max_ticks: Annotated[int, Field(gt=0)] | None = (
        None  # of motion; then it has failed with `limit_exceeded`
    )


class CancelGoal(_Call):
    op: Literal["cancel"]
    goal_id: Name


class GetResult(_Call):
    """The result of a goal that ended (the last 64 are kept): for a client that reconnected."""

    op: Literal["result"]
    goal_id: Name


class GetFrame(_Call):
    """Latest frame of a camera, no older than `max_age_ms`, else `frame_stale`. "" takes the
    runner's first camera."""

    op: Literal["frame"]
    camera: str = ""
    encoding: Literal["jpeg", "png"] = (
        "jpeg"  # models want png: jpeg's artefacts cost them accuracy
    )
    max_age_ms: Annotated[float, Field(gt=0, le=60_000)] = 500.0


class GetState(_Call):
    op: Literal["state"]


class GetSkills(_Call):
    op: Literal["skills"]


class GetGroundTruth(_Call):
    """Simulator only: what is really there. For judges, never for planners."""

    op: Literal["ground_truth"]


class ResetWorld(_Call):
    """Simulator only: begin the scene again, or that of another seed. Refused while a goal runs."""

    op: Literal["reset"]
    seed: Annotated[int, Field(ge=0, lt=1 << 31)] | None = None


class MarkEpisode(_Call):
    """The operator's verdict on the episode of a goal: the one that runs, or the last one. ""
    takes that goal. A discarded episode is removed from the dataset."""

    op: Literal["mark"]
    verdict: Literal["success", "failure", "discard"]
    goal_id: Name | Literal[""] = ""


class PingRunner(_Call):
    op: Literal["ping"]


class ShutdownRunner(_Call):
    op: Literal["shutdown"]


RunnerRequest = Annotated[
    SendGoal
    | CancelGoal
    | GetResult
    | GetFrame
    | GetState
    | GetSkills
    | GetGroundTruth
    | ResetWorld
    | MarkEpisode
    | PingRunner
    | ShutdownRunner,
    Field(discriminator="op"),
]
RUNNER_REQUEST: TypeAdapter[RunnerRequest] = TypeAdapter(RunnerRequest)


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
    data: dict[str, JsonValue]
