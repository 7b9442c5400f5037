"""Interface of planners: read the episode so far, decide the next tool call or the end.

Pure data and one protocol. Planners never touch sockets, models or leases: `reasoner.tools` makes
the calls, and a planner's decision can put bytes on a GPU only through a sidecar that holds a
lease.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.tools import ExecuteRskill, QueryScene, ToolCall

UNSTARTABLE_MAX = 3

Status = Literal[
    "found",  # locate_in_view: the object, with its place
    "not_seen",  # locate_in_view: the detector looked and it is not there
    "answered",  # query_scene, query_task_progress
    "shown",  # look: the picture is in the outcome
    "succeeded",  # execute_rskill; of a learned policy: it ran to its end
    "failed",  # execute_rskill ended without success
    "canceled",  # execute_rskill was called off, by the planner or by a person
    "done",  # lifecycle_transition, emit_prompt
    "evicted",  # the model was evicted: says nothing about the scene
    "no_frame",  # no picture young enough
    "refused",  # not allowed, or not understood
    "error",  # anything else; `code` says what
]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one tool call. `text` is for people and language models, `data` for scripts,
    `picture` (JPEG) for models that see.
    """

    status: Status
    text: str
    code: str = ""
    data: JsonMap = field(default_factory=dict)
    picture: bytes = b""


@dataclass(frozen=True, slots=True)
class Step:
    call: ToolCall
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class Note:
    """A message during the episode that answers no call. `after` counts the steps that were over
    by then.
    """

    source: Literal["operator", "safety", "reasoner"]
    text: str
    after: int


@dataclass(frozen=True, slots=True)
class Seen:
    """A thing that a continuous detector sees in a camera; `age_s` counts from its picture."""

    label: str
    confidence: float
    camera: str
    age_s: float


@dataclass(frozen=True, slots=True)
class Sight:
    """What continuous detectors see now.

    `blind`: cameras whose detector has not looked within its bound, evicted for example. They say
    nothing about the scene.
    """

    seen: tuple[Seen, ...]
    blind: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Finish:
    """The planner's last word."""

    success: bool
    reason: str


@dataclass(slots=True)
class Episode:
    """One task and everything that was tried for it."""

    task: str
    steps: list[Step] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    running: ToolCall | None = None
    """The goal that runs while the planner is asked: only `wait`, `stop_goal` and the end are
    valid.
    """
    sight: Sight | None = None
    """As of this question to the planner; None: no detector looks all the time."""

    def attempts(self, manipulation: frozenset[str]) -> int:
        """Return how many goals of the skills named in `manipulation` were executed."""
        return sum(_executed(step, manipulation) for step in self.steps)

    def confirmed(self, manipulation: frozenset[str]) -> bool:
        """Return whether the scene VLM's newest answer after the newest manipulation was a yes."""
        for step in reversed(self.steps):
            asked = isinstance(step.call, QueryScene) and step.outcome.status == "answered"
            if asked and step.outcome.text.strip().lower().startswith(("yes", "no")):
                return says_yes(step.outcome.text)
            if _executed(step, manipulation):
                return False
        return False


def _executed(step: Step, manipulation: frozenset[str]) -> bool:
    """Return whether the robot was asked to do it: what was refused here never was."""
    call = step.call
    return (
        isinstance(call, ExecuteRskill)
        and call.rskill_id in manipulation
        and step.outcome.status != "refused"
    )


class Planner(Protocol):
    """Decides the next step. May take long (a language model): the loop stays responsive meanwhile.

    An outdated decision is discarded and asked for again, with what has happened meanwhile:
    `decide` must not count its calls. Raises LlmError when no decision can be had.
    """

    async def decide(self, episode: Episode) -> ToolCall | Finish: ...


def benched(steps: Sequence[Step]) -> frozenset[str]:
    """Return skills whose sidecar failed to start `UNSTARTABLE_MAX` times in a row in this
    episode.
    """
    streaks: dict[str, int] = {}
    for step in steps:
        if (
            isinstance(step.call, ExecuteRskill)
            and streaks.get(step.call.rskill_id, 0) < UNSTARTABLE_MAX
        ):
            failed = step.outcome.code == SidecarUnavailable.code
            streaks[step.call.rskill_id] = streaks.get(step.call.rskill_id, 0) + 1 if failed else 0
    return frozenset(rskill for rskill, streak in streaks.items() if streak >= UNSTARTABLE_MAX)


def says_yes(answer: str) -> bool:
    """Return whether a scene VLM's answer to a yes-no question is a clear yes."""
    return answer.strip().lower().startswith("yes")
