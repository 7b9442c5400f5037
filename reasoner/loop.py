"""The reasoner's loop: ask the planner, check the palette, dispatch, remember. It knows neither VRAM nor any model.

The planner (perhaps a language model) and the tools run as awaits: a cancel of the loop's task reaches whichever is under way.
"""

import logging
from collections.abc import Awaitable, Callable
from typing import Any, Literal, TypedDict

from reasoner.palette import Palette
from reasoner.planner import Episode, Finish, Outcome, Planner, Step
from schemas.errors import VramError
from schemas.tools import QueryScene, ToolCall

log = logging.getLogger(__name__)

STEPS_MAX = 60
REPEATS_MAX = 8  # the same call over and over is a planner that does not listen

Dispatch = Callable[[ToolCall], Awaitable[Outcome]]


class StepRecord(TypedDict):
    call: dict[str, Any]
    status: str
    code: str
    text: str


class Result(TypedDict):
    """What an episode came to; the shape of the result file."""

    task: str
    status: Literal["success", "failure"]
    reason: str
    attempts: int
    vlm_confirmed: bool
    vlm_answers: list[str]
    steps: list[StepRecord]


async def run_episode(
    task: str, planner: Planner, palette: Palette, dispatch: Dispatch, *, steps_max: int = STEPS_MAX
) -> Result:
    """Run one task to its end. Never raises for what a planner or a tool does: the result says how it ended."""
    episode = Episode(task)
    finish = Finish(False, f"gave up after {steps_max} steps")
    for _ in range(steps_max):
        try:
            decision = await planner.decide(episode)
        except VramError as error:
            finish = Finish(False, f"the planner failed: {error}")
            break
        if isinstance(decision, Finish):
            finish = decision
            break
        if _stuck(episode, decision):
            finish = Finish(False, f"the same call {REPEATS_MAX} times in a row: {decision.tool}")
            break
        log.info("%s %s", decision.tool, describe(decision))
        outcome = await _outcome(decision, palette, dispatch)
        log.info("%s: %s%s", decision.tool, outcome.status, f", {outcome.text}" if outcome.text else "")
        episode.steps.append(Step(decision, outcome))
    log.info("%s: %s", "success" if finish.success else "failure", finish.reason)
    return _result(episode, finish, palette)


async def _outcome(call: ToolCall, palette: Palette, dispatch: Dispatch) -> Outcome:
    if (refusal := palette.check(call)) is not None:
        return Outcome("refused", str(refusal), refusal.code)
    return await dispatch(call)


def _stuck(episode: Episode, call: ToolCall) -> bool:
    recent = episode.steps[-REPEATS_MAX:]
    return len(recent) == REPEATS_MAX and all(step.call == call for step in recent)


def describe(call: ToolCall) -> str:
    """A call's arguments on one line, for logs and displays."""
    fields = call.model_dump(exclude={"tool", "rationale"}, exclude_defaults=True)
    text = ", ".join(f"{key}={value!r}" for key, value in fields.items())
    return f"({text})" + (f": {call.rationale}" if call.rationale else "")


def _result(episode: Episode, finish: Finish, palette: Palette) -> Result:
    answers = [
        step.outcome.text
        for step in episode.steps
        if isinstance(step.call, QueryScene) and step.outcome.status == "answered"
    ]
    return {
        "task": episode.task,
        "status": "success" if finish.success else "failure",
        "reason": finish.reason,
        "attempts": episode.attempts(palette.manipulation),
        "vlm_confirmed": episode.confirmed(palette.manipulation),
        "vlm_answers": answers,
        "steps": [
            {
                "call": step.call.model_dump(exclude_defaults=True) | {"tool": step.call.tool},
                "status": step.outcome.status,
                "code": step.outcome.code,
                "text": step.outcome.text,
            }
            for step in episode.steps
        ],
    }
