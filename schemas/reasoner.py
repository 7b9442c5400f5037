"""The reasoner's wire: what a person says to a running episode, on one ZeroMQ ROUTER socket.

Request {"op": …, "id": n, …} → reply {"re": n, "ok": true, …} | {"re": n, "ok": false, "error":
{…}}. Nothing here moves anything: words reach the planner, a cancel ends the episode and its goal.
"""

from typing import Annotated, Literal, NotRequired, TypedDict

from pydantic import BaseModel, ConfigDict, Field, JsonValue, TypeAdapter


class _Call(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    id: Annotated[int, Field(ge=0, lt=1 << 53)]


class Say(_Call):
    """Words for the planner, also while a goal runs."""

    op: Literal["say"]
    text: Annotated[str, Field(min_length=1, max_length=2000)]


class CancelEpisode(_Call):
    """End the episode: its goal is cancelled, the planner is not asked."""

    op: Literal["cancel"]
    reason: Annotated[str, Field(max_length=500)] = ""


class ConfirmMotion(_Call):
    """Let the motion that waits for the operator begin, or refuse it. `state` names its number."""

    op: Literal["confirm"]
    motion: Annotated[int, Field(ge=1)]
    yes: bool
    reason: Annotated[str, Field(max_length=500)] = ""


class GetEpisode(_Call):
    """Which task it works on, its process, and the motion that waits for a confirmation."""

    op: Literal["state"]


class PingReasoner(_Call):
    op: Literal["ping"]


ReasonerRequest = Annotated[
    Say | CancelEpisode | ConfirmMotion | GetEpisode | PingReasoner, Field(discriminator="op")
]
REASONER_REQUEST: TypeAdapter[ReasonerRequest] = TypeAdapter(ReasonerRequest)
OPS = ("say", "cancel", "confirm", "state", "ping")


class Motion(TypedDict):
    """A motion that waits for the operator's confirmation."""

    number: int
    text: str


class StateReply(TypedDict):
    task: str
    pid: int
    motion: Motion | None


# -- what a task came to: the result file, and the history
class StepRecord(TypedDict):
    """One call of a planner and its outcome."""

    call: dict[str, JsonValue]
    status: str
    code: str
    text: str


class NoteRecord(TypedDict):
    """A message from outside; `after` counts the steps that were over by then."""

    source: str
    text: str
    after: int


class LlmUsage(TypedDict):
    """What a language model's decisions cost. Rejected answers were not usable as a decision."""

    model: str
    requests: int
    failed: int
    rejected: int
    input_tokens: int
    output_tokens: int


class Result(TypedDict):
    """What a task came to; the shape of the result file."""

    task: str
    status: Literal["success", "failure"]
    reason: str
    attempts: int
    vlm_confirmed: bool
    vlm_answers: list[str]
    steps: list[StepRecord]
    notes: list[NoteRecord]
    llm: NotRequired[LlmUsage]


class TranscriptLine(BaseModel):
    """A line of a language model's transcript. Request and answer are the API's own; pictures are
    replaced by their length."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    at: str
    kind: Literal["answered", "failed", "rejected"]
    request: JsonValue = None
    answer: JsonValue = None
    problem: str | None = None
