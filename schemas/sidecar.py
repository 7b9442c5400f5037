"""The sidecars' wires: two families that the field already speaks, on one ZeroMQ ROUTER socket (ipc
or loopback).

Op family (detector, scene VLM, reward)   {"op": "ping" | "load" | "detect" | "query" | "score" |
"unload" | "shutdown", …}
                                     → {"ok": true, …} | {"ok": false, "error": "Type: message",
                                     "code": …, "hint": …, "details": …}
Endpoint family (policy)             {"endpoint": "ping" | "load" | "reset" | "get_action" |
"unload" | "shutdown", "data": …}
                                     → the result | {"error": "Type: message", "code": …, …}
                                     without "id": `get_action` → [the result, {}], an error →
                                     {"error": "Type: message"}, as the field's clients expect

`detect`, `query`, `score` and `get_action` may carry "fresh_s": pictures that had to wait longer
(for the GPU, a load, another request) are not looked at. Every request may carry "id" (echoed as
"re": a DEALER may have several under way; REQ clients leave it out), "token" ([epoch, serial]:
refuse with `evicted` unless it is the sidecar's current one) and "traceparent". Images are PNG or
JPEG bytes of RGB, and a video is a list of them. Arrays are
`{"__ndarray_class__": true, "as_npy": bytes}` (numpy's .npy format, pickle never allowed).

`get_action` answers the actions that are to be played before it is asked again, or with
"whole_chunk" all that the policy predicted; it may carry "rtc", what its chunk shall continue. The
answer may have "confidence", a number or several (0 to 1): the actions have their mean.
A policy with a history takes the last `n_obs_steps` control steps in one observation: each picture
and vector with a leading dimension (or a list of pictures), oldest first, and before there were
so many, the first of the episode repeated. The answer to `reset` says how many, and how many
actions are played (`ResetResult`). One observation alone, as the field's clients send it, is
accepted as the first one after a `reset`, and always where one action is played. With "afresh" a
call depends on no other one, so that several robots share a policy: what the policy remembers is
forgotten, a shorter history is filled with its first step, and the answer says `n_obs_steps`.

`load` makes the model resident (acquiring the lease) and answers with the lease id and token, so
that a caller can mark a use of its own on it at the arbiter: a goal that spans many `get_action`
calls is one use.
"""

from typing import Annotated, Literal, NotRequired, Self, TypedDict

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    FiniteFloat,
    Tag,
    TypeAdapter,
    model_validator,
)

from vram_arbiter.schemas.limits import Seconds
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.telemetry.traceparent import Traceparent
from vram_arbiter.schemas.wire.requests import TokenPair

ImageBytes = Annotated[bytes, Field(min_length=8, max_length=16 * 1024 * 1024)]
Question = Annotated[str, Field(min_length=1, max_length=2000)]
Side = Annotated[int, Field(ge=1, le=4096)]

PICTURES_MAX = 32  # of one `query` or `score`
QUERIES_MAX = 64  # of one `detect`
LEFT_OVER_MAX = 100  # rows of a chunk that guide the next one


class _Call(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    id: int | None = None
    token: TokenPair | None = None
    traceparent: Traceparent = None


class PingOp(_Call):
    op: Literal["ping"]


class LoadOp(_Call):
    """Make the model resident. `timeout_s` bounds the wait for the lease."""

    op: Literal["load"]
    timeout_s: Seconds | None = None


class UnloadOp(_Call):
    op: Literal["unload"]


class ShutdownOp(_Call):
    op: Literal["shutdown"]


class _Look(_Call):
    """About pictures. Without `fresh_s` it does not matter how long they wait, as for the field's
    clients."""

    fresh_s: Seconds | None = None
    """From the request's arrival on, the model has to begin to look within so long; else
    `frame_stale`, and nothing was looked at."""


class DetectOp(_Look):
    """Find `query` in an image. Several are separated by `</c>`, ` . ` or commas, as the field
    writes them, end in a dot each, or come as a list."""

    op: Literal["detect"]
    image: ImageBytes
    query: Annotated[
        Annotated[Question, Tag("text")]
        | Annotated[list[Question], Field(min_length=1, max_length=QUERIES_MAX), Tag("list")],
        # else an error of one is told as an error of the other
        Discriminator(lambda query: "text" if isinstance(query, str) else "list"),
    ]
    max_side: Annotated[int, Field(ge=32, le=4096)] = 1024
    # how LocateAnything decodes; other detectors have one way
    mode: Literal["fast", "slow", "hybrid"] = "hybrid"
    max_new_tokens: Annotated[int, Field(ge=1, le=8192)] = 1024
    score_threshold: Annotated[float, Field(ge=0, le=1)] | None = None


class QueryOp(_Look):
    """Ask `question` about pictures, in this order: `image` (the field's one), `images`, `video`.

    `video` is frames of one camera, oldest first, `fps` of them a second.
    """

    op: Literal["query"]
    question: Question
    image: ImageBytes | None = None
    images: Annotated[list[ImageBytes], Field(max_length=PICTURES_MAX)] = []
    video: Annotated[list[ImageBytes], Field(max_length=PICTURES_MAX)] = []
    fps: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] | None = None
    max_side: Annotated[int, Field(ge=32, le=4096)] = 1024
    max_new_tokens: Annotated[int, Field(ge=1, le=8192)] = 256

    @model_validator(mode="after")
    def _some_pictures(self) -> Self:
        count = (self.image is not None) + len(self.images) + len(self.video)
        if not 1 <= count <= PICTURES_MAX:
            raise ValueError(f"give 1 to {PICTURES_MAX} pictures in image, images and video")
        if bool(self.video) != (self.fps is not None):
            raise ValueError("video and fps belong together")
        return self


class ScoreOp(_Look):
    """How far along `task` the robot is at each of one camera's pictures, oldest first.

    Either `images` (PNG or JPEG bytes), or as the field writes it: `frames`, `n` raw pictures of
    `height` × `width` × 3 bytes, BGR, one after another.
    """

    op: Literal["score"]
    task: Annotated[str, Field(max_length=2000)] = ""
    images: Annotated[list[ImageBytes], Field(max_length=PICTURES_MAX)] = []
    frames: Annotated[bytes, Field(max_length=16 * 1024 * 1024)] = b""
    n: Annotated[int, Field(ge=1, le=PICTURES_MAX)] | None = None
    width: Side | None = None
    height: Side | None = None
    num_bins: Annotated[int, Field(ge=2, le=1000)] = (
        100  # of the field's wire; the checkpoint knows its own
    )

    @model_validator(mode="after")
    def _one_way_to_send_pictures(self) -> Self:
        if bool(self.images) == bool(self.frames):
            raise ValueError("give images, or frames with n, width and height")
        if self.frames:
            if self.n is None or self.width is None or self.height is None:
                raise ValueError("frames need n, width and height")
            if len(self.frames) != (expected := self.n * self.width * self.height * 3):
                raise ValueError(
                    f"frames has {len(self.frames)} bytes, not n x height x width x 3 = {expected}"
                )
        return self


OpRequest = Annotated[
    PingOp | LoadOp | UnloadOp | ShutdownOp | DetectOp | QueryOp | ScoreOp,
    Field(discriminator="op"),
]
OP_REQUEST: TypeAdapter[OpRequest] = TypeAdapter(OpRequest)


ActionRow = Annotated[tuple[FiniteFloat, ...], Field(min_length=1, max_length=1000)]


class RealTimeChunking(BaseModel):
    """What a chunk shall continue, for policies that lerobot guides so (`rtc`).

    `left_over`: the actions of the chunk before for the control steps from this observation on, as
    the policy answered them. The first `inference_delay` of them are played in any case; the
    influence of the others ends at `execution_horizon` steps.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    left_over: Annotated[tuple[ActionRow, ...], Field(min_length=1, max_length=LEFT_OVER_MAX)]
    inference_delay: Annotated[int, Field(ge=0, le=1000)]
    execution_horizon: Annotated[int, Field(ge=1, le=LEFT_OVER_MAX)]


class EndpointCall(_Look):
    endpoint: Literal["ping", "load", "reset", "get_action", "unload", "shutdown"]
    data: Message | None = None
    # of `get_action`; the field's clients have no such fields
    rtc: RealTimeChunking | None = None
    whole_chunk: bool = False
    afresh: bool = False
    api_token: str | None = None  # of the field's wire; not used on ipc


ENDPOINT_REQUEST: TypeAdapter[EndpointCall] = TypeAdapter(EndpointCall)


class PingResult(TypedDict):
    """Identity and state of a sidecar."""

    ok: bool
    model: str
    revision: str
    kind: Literal["detector", "vlm", "vla", "reward"]
    rskill: str
    pid: int
    boot_id: str
    consumer: NotRequired[str]  # its name at the arbiter
    state: Literal["unloaded", "waiting", "loading", "resident", "parking", "parked", "unloading"]
    lease_id: NotRequired[str | None]
    token: NotRequired[list[int] | None]
    standby: NotRequired[bool]  # evicted, and it comes back by itself when there is room
    wanted: NotRequired[bool]  # a client waits for the model: `unload` takes that back
    last_error: NotRequired[str]


class LoadResult(TypedDict):
    ok: bool
    lease_id: str | None  # None when the sidecar runs without an arbiter
    token: list[int] | None
    loaded: bool  # False: it was resident already


class ResetResult(TypedDict):
    """Begin of an episode. Servers of the field say nothing about it."""

    ok: bool
    n_obs_steps: NotRequired[int]  # control steps of an observation
    n_action_steps: NotRequired[int]  # actions that are played before the next one


class DetectionResult(TypedDict):
    label: str
    score: float
    box: list[float]  # x0, y0, x1, y1 in pixels of the image sent


class DetectResult(TypedDict):
    ok: bool
    # `<ref>label</ref><box><x1><y1><x2><y2></box>…` in [0, norm], the field's grounding format
    answer: str
    norm: int
    detections: list[DetectionResult]


class QueryResult(TypedDict):
    ok: bool
    answer: str


class ScoreResult(TypedDict):
    """A value a picture, oldest first; models that judge a window as a whole give one, the
    newest's. All in 0..1."""

    ok: bool
    progress: list[float]
    success: list[float]  # probability that the task is done; empty: the model does not say
    success_threshold: float  # from here on its manifest calls it done
