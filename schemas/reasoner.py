"""The reasoner's wire: tasks, and what a person says to a running one, on one ZeroMQ ROUTER socket;
and the files that tasks leave behind.

Request {"op": …, "id": n, …} → reply {"re": n, "ok": true, …} | {"re": n, "ok": false, "error":
{…}}. Nothing here moves anything: words reach the planner, a cancel ends the episode and its goal.
"""

from typing import Annotated, Literal, NotRequired, TypedDict

from pydantic import BaseModel, ConfigDict, Field, JsonValue, TypeAdapter

TaskNumber = Annotated[int, Field(ge=1, lt=1 << 53)]
TaskState = Literal["queued", "running", "success", "failure", "canceled"]


class _Call(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    id: Annotated[int, Field(ge=0, lt=1 << 53)]


class Say(_Call):
    """Words for the planner, also while a goal runs."""

    op: Literal["say"]
    text: Annotated[str, Field(min_length=1, max_length=2000)]


class CancelEpisode(_Call):
    """End the running task, its goal is canceled and the planner is not asked; or the task with
    this number, also one that waits."""

    op: Literal["cancel"]
    reason: Annotated[str, Field(max_length=500)] = ""
    task: TaskNumber | None = None


class SubmitTask(_Call):
    """Queue a task (`vram-reasoner serve`). Reply: its number, and how many come before it."""

    op: Literal["submit"]
    text: Annotated[str, Field(min_length=1, max_length=4000)]


class ListTasks(_Call):
    """The tasks that wait, run, or ended (the last 64), the oldest first."""

    op: Literal["tasks"]


class GetTaskResult(_Call):
    """The result of a task that ended."""

    op: Literal["result"]
    task: TaskNumber


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
    Say
    | CancelEpisode
    | SubmitTask
    | ListTasks
    | GetTaskResult
    | ConfirmMotion
    | GetEpisode
    | PingReasoner,
    Field(discriminator="op"),
]
REASONER_REQUEST: TypeAdapter[ReasonerRequest] = TypeAdapter(ReasonerRequest)
OPS = ("say", "cancel", "submit", "tasks", "result", "confirm", "state", "ping")


class Motion(TypedDict):
    """A motion that waits for the operator's confirmation."""

    number: int
    text: str


class ReasonerState(TypedDict):
    """`task` is the running one's text, or empty."""

    task: str
    pid: int
    motion: Motion | None
    queued: int


class SubmitReply(TypedDict):
    task: int
    ahead: int


class TaskView(TypedDict):
    """One task of a reasoner. Times are ISO 8601 in UTC; `reason` is its result's."""

    task: int
    text: str
    state: TaskState
    reason: str
    submitted_at: str
    started_at: str | None
    ended_at: str | None


class TasksReply(TypedDict):
    tasks: list[TaskView]


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
    """What a language model's decisions cost. Each try is a request; a failed one that was repeated
    (a busy server's, say) does not fail the decision. Rejected answers were not usable as one."""

    model: str
    requests: int
    failed: int
    rejected: int
    input_tokens: int
    output_tokens: int


class Result(TypedDict):
    """What a task came to; the shape of the result file. `stopped`: an emergency stop or a lost
    runner ended it, not the planner."""

    task: str
    status: Literal["success", "failure"]
    reason: str
    stopped: bool
    attempts: int
    vlm_confirmed: bool
    vlm_answers: list[str]
    steps: list[StepRecord]
    notes: list[NoteRecord]
    llm: NotRequired[LlmUsage]


class ResultReply(TypedDict):
    result: Result


class HistoryLine(BaseModel):
    """A line of a serving reasoner's history: a task that ended, and its result."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    task: TaskView
    result: Result


class TranscriptLine(BaseModel):
    """A line of a language model's transcript. Request and answer are the API's own; pictures are
    replaced by their length."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    at: str
    kind: Literal["answered", "failed", "rejected"]
    request: JsonValue = None
    answer: JsonValue = None
    problem: str | None = None
