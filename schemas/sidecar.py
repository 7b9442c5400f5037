"""The sidecars' wires: two families that the field already speaks, on one ZeroMQ ROUTER socket (ipc or loopback).

Op family (detector, scene VLM)      {"op": "ping" | "load" | "detect" | "query" | "unload" | "shutdown", …}
                                     → {"ok": true, …} | {"ok": false, "error": "Type: message", "code": …, "hint": …, "details": …}
Endpoint family (policy)             {"endpoint": "ping" | "load" | "reset" | "get_action" | "unload" | "shutdown", "data": …}
                                     → the result | {"error": "Type: message", "code": …, …}

Every request may carry "id" (echoed as "re": a DEALER may have several under way; REQ clients leave it out), "token" ([epoch, serial]: refuse with
`evicted` unless it is the sidecar's current one) and "traceparent". Images are PNG bytes of RGB. Arrays are `{"__ndarray_class__": true, "as_npy": bytes}`
(numpy's .npy format, pickle never allowed).

`load` makes the model resident (acquiring the lease) and answers with the lease id and token, so that a caller can mark a use of its own on it at
the arbiter: a goal that spans many `get_action` calls is one use.
"""

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from schemas.wire import Seconds, TokenPair

ImageBytes = Annotated[bytes, Field(min_length=8, max_length=16 * 1024 * 1024)]
Question = Annotated[str, Field(min_length=1, max_length=2000)]


class _Call(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    id: int | None = None
    token: TokenPair | None = None
    traceparent: Annotated[str, Field(max_length=64)] | None = None


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


class DetectOp(_Call):
    """Find `query` (several separated by ` . ` or commas, as the field writes them) in an image."""

    op: Literal["detect"]
    image: ImageBytes
    query: Question
    max_side: Annotated[int, Field(ge=32, le=4096)] = 1024
    mode: str = "hybrid"  # of the field's wire; a zero-shot detector has one mode
    max_new_tokens: Annotated[int, Field(ge=1, le=8192)] = 1024
    score_threshold: Annotated[float, Field(ge=0, le=1)] | None = None


class QueryOp(_Call):
    op: Literal["query"]
    image: ImageBytes
    question: Question
    max_side: Annotated[int, Field(ge=32, le=4096)] = 1024
    max_new_tokens: Annotated[int, Field(ge=1, le=8192)] = 256


OpRequest = Annotated[PingOp | LoadOp | UnloadOp | ShutdownOp | DetectOp | QueryOp, Field(discriminator="op")]
OP_REQUEST: TypeAdapter[OpRequest] = TypeAdapter(OpRequest)


class EndpointCall(_Call):
    endpoint: Literal["ping", "load", "reset", "get_action", "unload", "shutdown"]
    data: dict[str, Any] | None = None
    api_token: str | None = None  # of the field's wire; not used on ipc


ENDPOINT_REQUEST: TypeAdapter[EndpointCall] = TypeAdapter(EndpointCall)


class PingResult(TypedDict):
    """Identity and state of a sidecar."""

    ok: bool
    model: str
    revision: str
    kind: Literal["detector", "vlm", "vla"]
    rskill: str
    pid: int
    boot_id: str
    state: Literal["unloaded", "waiting", "loading", "resident", "unloading"]
    lease_id: NotRequired[str | None]
    token: NotRequired[list[int] | None]
    standby: NotRequired[bool]  # evicted, and it comes back by itself when there is room
    last_error: NotRequired[str]


class LoadResult(TypedDict):
    ok: bool
    lease_id: str | None  # None when the sidecar runs without an arbiter
    token: list[int] | None
    loaded: bool  # False: it was resident already


class DetectionResult(TypedDict):
    label: str
    score: float
    box: list[float]  # x0, y0, x1, y1 in pixels of the image sent


class DetectResult(TypedDict):
    ok: bool
    answer: str  # `<ref>label</ref><box><x1><y1><x2><y2></box>…` in [0, norm], the field's grounding format
    norm: int
    detections: list[DetectionResult]


class QueryResult(TypedDict):
    ok: bool
    answer: str
