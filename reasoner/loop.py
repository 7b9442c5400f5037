"""Loop of the reasoner: ask the planner, check the palette, dispatch, remember.

It knows neither VRAM nor any model. Nothing waits for the planner (perhaps a language model that
hangs): planner and tool are two tasks, and the loop wakes for the first event of them or of the
inbox. A result, a cancel or a danger that comes while the planner thinks is taken at once; the
planner's question is out of date then, so it is asked again. While a goal runs the planner is asked
only when an operator sent a text, and may let the goal continue, stop it, or end the episode.

Traced as `reasoner.tick`: from the first question to the outcome, with every `reasoner.plan` (also
outdated ones) and the `reasoner.tool` within it; the tool's calls carry the trace on to the runner
and the sidecars.
"""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING, Any

from vram_arbiter.reasoner.inbox import Cancel, Danger, Inbox, Said
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import (
    Episode,
    Finish,
    Note,
    Outcome,
    Planner,
    Sight,
    Step,
    benched,
)
from vram_arbiter.reasoner.results import result_of
from vram_arbiter.schemas.errors import EstopRequested, VramError
from vram_arbiter.schemas.reasoner import Result
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.tools import (
    ExecuteRskill,
    LocateInView,
    Look,
    QueryScene,
    QueryTaskProgress,
    StopGoal,
    ToolCall,
    WaitOn,
)

if TYPE_CHECKING:
    from opentelemetry.trace import Span

log = logging.getLogger(__name__)

STEPS_MAX = 60
REPEATS_MAX = 8  # the same call over and over is a planner that does not listen
REFUSALS_MAX = 5  # in a row
LOOKS_IN_A_ROW_MAX = (
    12  # looking and asking without anything done between: the answers prompt only more questions
)
THINK_MAX_S = 300.0  # a decision, with all retries of the planner's own
NOTES_MAX = 64  # the oldest are forgotten
SUPERSEDED_MAX = 3  # an operator that keeps sending texts must not keep the planner from deciding
STOP_MAX_S = 15.0  # at the end, for a canceled goal to report

Dispatch = Callable[[ToolCall], Awaitable[Outcome]]
LookAt = Callable[[], Awaitable[Sight | None]]


class _NoDecision(Finish):
    """The planner gave none: ends an episode, but no goal that runs."""


class _Stopped(Finish):
    """A danger ended the episode."""


async def run_episode(
    task: str,
    planner: Planner,
    palette: Palette,
    dispatch: Dispatch,
    *,
    inbox: Inbox | None = None,
    look_at: LookAt | None = None,
    steps_max: int = STEPS_MAX,
    think_max_s: float = THINK_MAX_S,
) -> Result:
    """Run one task to its end. Never raises for a planner or a tool: the result tells how it ended.

    `look_at` returns what continuous detectors see, before each question to the planner.
    A canceled episode cancels its goal and waits for it, at most `STOP_MAX_S`.
    """
    loop = _Loop(
        Episode(task), planner, palette, dispatch, inbox or Inbox(), look_at, steps_max, think_max_s
    )
    finish = await loop.run()
    log.info("%s: %s", "success" if finish.success else "failure", finish.reason)
    stopped = isinstance(finish, _Stopped)
    return result_of(loop.episode, finish, palette.manipulation, stopped=stopped)


@dataclass
class _Loop:
    episode: Episode
    planner: Planner
    palette: Palette
    dispatch: Dispatch
    inbox: Inbox
    look_at: LookAt | None
    steps_max: int
    think_max_s: float
    _thinking: asyncio.Task[ToolCall | Finish] | None = None
    _acting: asyncio.Task[Outcome] | None = None
    _call: ToolCall | None = None
    """What `_acting` does."""
    _news: bool = False
    """Said while a goal runs: the planner is to be asked."""
    _superseded: int = 0
    _finish: Finish | None = None
    _tick: "Span | None" = None

    async def run(self) -> Finish:
        """1. Ask the planner if it is due.

        2. Wait for the first event. 3. Take all events, urgent ones first.
        """
        message = asyncio.create_task(self.inbox.wait())
        try:
            while self._ask():
                waited = {
                    task for task in (message, self._thinking, self._acting) if task is not None
                }
                await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
                if message.done():
                    self._take_messages()
                    message = asyncio.create_task(self.inbox.wait())
                if self._acting is not None and self._acting.done():
                    self._take_outcome()
                if self._thinking is not None and self._thinking.done():
                    self._take_decision()
        finally:
            message.cancel()
            self._forget_decision()
            await self._stop_acting()
            self._end_tick("finished" if self._finish is not None else "canceled")
        assert self._finish is not None, "only an end stops the asking"
        return self._finish

    # -- 1
    def _ask(self) -> bool:
        """Return whether the episode continues."""
        if self._finish is not None:
            return False
        if self._thinking is not None or (self._acting is not None and not self._news):
            return True
        if self._acting is None and len(self.episode.steps) >= self.steps_max:
            self._finish = Finish(False, f"gave up after {self.steps_max} steps")
            return False
        self._news = False
        self.episode.running = self._call
        if self._tick is None:
            self._tick = tracing.begin(telemetry.SPAN_REASONER_TICK)
        with tracing.inside(self._tick):
            self._thinking = asyncio.create_task(self._think(), name="think")
        return True

    async def _think(self) -> ToolCall | Finish:
        outcome = "superseded"
        with tracing.span(telemetry.SPAN_PLAN):
            try:
                async with asyncio.timeout(self.think_max_s):
                    if self.look_at is not None:
                        self.episode.sight = await self.look_at()
                    decision = await self.planner.decide(self.episode)
                outcome = "finish" if isinstance(decision, Finish) else decision.tool
                return decision
            except VramError as error:
                outcome = error.code
                return _NoDecision(False, f"the planner failed: {error}")
            except TimeoutError:
                outcome = "timeout"
                why = f"the planner failed: no decision within {self.think_max_s:g} s"
                return _NoDecision(False, why)
            finally:
                tracing.note({telemetry.ATTR_OUTCOME: outcome})

    async def _act(self, call: ToolCall) -> Outcome:
        attributes: dict[str, str] = {telemetry.ATTR_TOOL: call.tool}
        if isinstance(call, ExecuteRskill):
            attributes[telemetry.ATTR_SKILL] = call.rskill_id
        status = "canceled"
        with tracing.span(telemetry.SPAN_TOOL, attributes=attributes):
            try:
                outcome = await self.dispatch(call)
                status = outcome.status
                return outcome
            finally:
                tracing.note({telemetry.ATTR_OUTCOME: status})

    def _end_tick(self, outcome: str) -> None:
        if self._tick is not None:
            self._tick.set_attribute(telemetry.ATTR_OUTCOME, outcome)
            self._tick.end()
        self._tick = None

    # -- 3
    def _take_messages(self) -> None:
        for item in self.inbox.take():
            match item:
                case Cancel():
                    self._end(Finish(False, f"canceled: {item.reason}"))
                case Danger(stop=True):
                    self._end(_Stopped(False, f"stopped: {item.text}"))
                case Danger():
                    self._note(Note("safety", item.text, len(self.episode.steps)))
                case Said():
                    self._note(Note("operator", item.text, len(self.episode.steps)))

    def _end(self, finish: Finish) -> None:
        log.warning("%s", finish.reason)
        self._finish = self._finish or finish

    def _note(self, note: Note) -> None:
        log.info("%s: %s", note.source, note.text)
        self._add_note(note)
        if self._superseded < SUPERSEDED_MAX:
            self._superseded += self._thinking is not None
            self._forget_decision()
        self._news = isinstance(self._call, ExecuteRskill)

    def _add_note(self, note: Note) -> None:
        self.episode.notes.append(note)
        del self.episode.notes[:-NOTES_MAX]

    def _take_outcome(self) -> None:
        assert self._acting is not None, "only called when it is done"
        assert self._call is not None, "a decision to act has a call"
        outcome = _outcome_of(self._acting)
        self._remember(self._call, outcome)
        self._acting = self._call = None
        self._end_tick(outcome.status)
        self._news = False
        self._forget_decision()  # it was made without this outcome
        if outcome.code == EstopRequested.code:
            self._end(_Stopped(False, f"stopped: {outcome.text}"))

    def _remember(self, call: ToolCall, outcome: Outcome) -> None:
        log.info("%s: %s%s", call.tool, outcome.status, f", {outcome.text}" if outcome.text else "")
        labels = {telemetry.ATTR_TOOL: str(call.tool), telemetry.ATTR_OUTCOME: str(outcome.status)}
        if outcome.code and outcome.status != "canceled":
            labels[telemetry.ATTR_ERROR_TYPE] = outcome.code
        meters.count(telemetry.METRIC_TOOL_CALLS, labels)
        self.episode.steps.append(Step(call, outcome))

    def _take_decision(self) -> None:
        assert self._thinking is not None, "only called when it is done"
        decision, self._thinking = self._thinking.result(), None
        self._superseded = 0
        self.episode.running = None
        if self._finish is not None:
            return
        if self._acting is not None:
            self._decided_beside(decision)
        elif isinstance(decision, Finish):
            self._finish = decision
        elif self._stuck(decision := self._with_known_follower(decision)):
            why = f"the same call {REPEATS_MAX} times in a row: {decision.tool}"
            self._finish = Finish(False, why)
        else:
            self._begin(decision)

    def _stuck(self, call: ToolCall) -> bool:
        return _in_a_row(self.episode, lambda step: step.call == call) >= REPEATS_MAX

    def _with_known_follower(self, call: ToolCall) -> ToolCall:
        """Return the call, without `next_rskill_id` where no such skill can follow.

        A hint is not worth a refusal: the call is performed, and a note tells the planner.
        """
        if not isinstance(call, ExecuteRskill) or not call.next_rskill_id:
            return call
        known = self._allowed().followers(call.rskill_id)
        if call.next_rskill_id in known:
            return call
        choose = f"choose from {', '.join(known)}" if known else "no other skill has a model"
        text = f"next_rskill_id {call.next_rskill_id!r} was ignored: {choose}"
        log.warning("%s", text)
        self._add_note(Note("reasoner", text, len(self.episode.steps)))
        return call.model_copy(update={"next_rskill_id": ""})

    def _decided_beside(self, decision: ToolCall | Finish) -> None:
        """Continue the goal unless the decision clearly ends it. A failed planner decides
        nothing.
        """
        match decision:
            case Finish() if not isinstance(decision, _NoDecision):
                self._finish = decision
            case StopGoal() if self._acting is not None:
                log.info("stop_goal %s", describe(decision))
                self._call_off()
            case WaitOn():
                pass
            case _:
                log.warning("the goal goes on; not taken: %s", decision)

    def _begin(self, call: ToolCall) -> None:
        log.info("%s %s", call.tool, describe(call))
        if (refusal := self._refusal(call)) is not None:
            self._remember(call, refusal)
            self._end_tick(refusal.status)
            if _in_a_row(self.episode, _refused) >= REFUSALS_MAX:
                why = f"{REFUSALS_MAX} calls in a row were refused: {refusal.text}"
                self._finish = Finish(False, why)
            return
        self._call = call
        with tracing.inside(self._tick) if self._tick is not None else contextlib.nullcontext():
            self._acting = asyncio.create_task(self._act(call), name=call.tool)

    def _allowed(self) -> Palette:
        return self.palette.without(benched(self.episode.steps))

    def _refusal(self, call: ToolCall) -> Outcome | None:
        if (error := self._allowed().check(call)) is not None:
            return Outcome("refused", str(error), error.code)
        if _is_look(call) and _in_a_row(self.episode, _looked) >= LOOKS_IN_A_ROW_MAX:
            why = f"looked and asked {LOOKS_IN_A_ROW_MAX} times in a row: do something, or finish"
            return Outcome("refused", why, "limit_exceeded")
        return None

    # -- ends
    def _forget_decision(self) -> None:
        if self._thinking is not None:
            self._thinking.cancel()
            self._thinking.add_done_callback(_look_away)
        self._thinking = None
        self.episode.running = None

    def _call_off(self) -> None:
        """Cancel once: a second cancellation would end the wait for the goal's end."""
        if self._acting is not None and not self._acting.cancelling():
            self._acting.cancel()

    async def _stop_acting(self) -> None:
        """End the goal with its episode."""
        if self._acting is None or self._call is None:
            return
        self._call_off()
        await asyncio.wait({self._acting}, timeout=STOP_MAX_S)
        if self._acting.done():
            self._remember(self._call, _outcome_of(self._acting))
        else:
            log.error(
                "%s did not end within %.0f s of its cancellation", self._call.tool, STOP_MAX_S
            )


def _outcome_of(acting: "asyncio.Task[Outcome]") -> Outcome:
    if acting.cancelled():
        return Outcome("canceled", "called off", "cancelled")
    return acting.result()


def _look_away(task: "asyncio.Task[Any]") -> None:
    """Retrieve the exception of a task that is no longer awaited."""
    if not task.cancelled() and (error := task.exception()) is not None:
        log.warning("a decision that was not waited for failed: %r", error)


def _in_a_row(episode: Episode, such: Callable[[Step], bool]) -> int:
    """Return how many of the newest steps are such."""
    return sum(1 for _ in takewhile(such, reversed(episode.steps)))


def _refused(step: Step) -> bool:
    return step.outcome.status == "refused"


def _looked(step: Step) -> bool:
    return _is_look(step.call)


def _is_look(call: ToolCall) -> bool:
    return isinstance(call, LocateInView | QueryScene | Look | QueryTaskProgress)


def describe(call: ToolCall) -> str:
    """Return a call's arguments on one line, for logs and displays."""
    fields = call.model_dump(exclude={"tool", "rationale"}, exclude_defaults=True)
    text = ", ".join(f"{key}={value!r}" for key, value in fields.items())
    return f"({text})" + (f": {call.rationale}" if call.rationale else "")
