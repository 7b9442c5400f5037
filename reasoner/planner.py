"""What a planner is: it reads the episode so far and decides the next tool call, or that the episode is over.

Pure data and one protocol. Planners never touch sockets, models or leases: `reasoner.tools` does the calls, and no decision of a
planner can put bytes on a GPU other than through a sidecar that holds a lease.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from schemas.tools import ExecuteRskill, QueryScene, ToolCall

Status = Literal[
    "found",  # locate_in_view: the object, with its place
    "not_seen",  # locate_in_view: the detector looked and it is not there
    "answered",  # query_scene
    "succeeded",  # execute_rskill
    "failed",  # execute_rskill ended without success
    "evicted",  # the model was made to leave: says nothing about the scene
    "no_frame",  # no picture young enough
    "refused",  # not allowed, or not understood
    "error",  # anything else; `code` says what
]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one tool call. `text` is for people and language models, `data` for scripts."""

    status: Status
    text: str
    code: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Step:
    call: ToolCall
    outcome: Outcome


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

    def attempts(self, manipulation: frozenset[str]) -> int:
        """How many goals of the skills named in `manipulation` were executed."""
        return sum(
            isinstance(step.call, ExecuteRskill) and step.call.rskill_id in manipulation
            for step in self.steps
        )

    def confirmed(self, manipulation: frozenset[str]) -> bool:
        """Whether the scene VLM's newest yes or no after the newest manipulation was a yes."""
        for step in reversed(self.steps):
            asked = isinstance(step.call, QueryScene) and step.outcome.status == "answered"
            if asked and step.outcome.text.strip().lower().startswith(("yes", "no")):
                return says_yes(step.outcome.text)
            if isinstance(step.call, ExecuteRskill) and step.call.rskill_id in manipulation:
                return False
        return False


class Planner(Protocol):
    """Decides what happens next. May take long (a language model): the loop stays responsive meanwhile.

    Raises LlmError when no decision can be had.
    """

    async def decide(self, episode: Episode) -> ToolCall | Finish: ...


def says_yes(answer: str) -> bool:
    """Whether a scene VLM's answer to a yes-no question is a yes. Anything unclear is a no: claims need a clear yes."""
    return answer.strip().lower().startswith("yes")
