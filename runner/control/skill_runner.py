"""`SkillRunner`: a control loop that gives the robot to at most one skill, and holds when there is none.

What a simulator and a real robot have in common: work posted from the event loop between two ticks, the skill that has the arm, the
safety gate that every action passes, progress and violations for whoever asks. Subclasses sense and apply. Everything runs on the
control thread, but for what the event loop may read at any time (`progress`, `world`, `caption`: replaced whole, never changed).
"""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.loop import Decision, RunnerBase
from vram_arbiter.runner.control.thread import Mailbox
from vram_arbiter.runner.protocols import (
    Act,
    DeadlinePolicy,
    Done,
    Goal,
    GoalTick,
    Hold,
    Progress,
    SafetyGate,
    Skill,
    SkillEnded,
    Stepped,
    TickSink,
    Transition,
)
from vram_arbiter.schemas.errors import (
    EstopRequested,
    InternalError,
    LimitExceeded,
    ModelError,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, TickResult, WorldState

log = logging.getLogger(__name__)

VIOLATIONS_KEPT = 256
WITHHELD_IN_A_ROW_MAX = 15  # half a second of refused actions: the policy is lost, the goal fails


@dataclass(slots=True)
class Tally:
    """What became of a goal's actions, or of a whole run's."""

    withheld: int = 0
    clamped: int = 0
    prefetch_hits: int = 0
    prefetch_misses: int = 0

    def count_chunk(self, in_time: bool) -> None:
        if in_time:
            self.prefetch_hits += 1
        else:
            self.prefetch_misses += 1

    def as_data(self) -> dict[str, Any]:
        """For people and programs; chunks only where some followed another."""
        data: dict[str, Any] = {"withheld": self.withheld, "clamped": self.clamped}
        if chunks := self.prefetch_hits + self.prefetch_misses:
            data["prefetch"] = {
                "hits": self.prefetch_hits,
                "misses": self.prefetch_misses,
                "hit_rate": self.prefetch_hits / chunks,
            }
        return data


@dataclass(slots=True)
class Active:
    skill: Stepped
    goal: Goal
    on_end: Callable[[SkillEnded], None]
    began_tick: int
    gate: SafetyGate
    withheld_in_a_row: int = 0
    late_in_a_row: int = 0
    was_late: bool = False  # the action before
    tally: Tally = field(default_factory=Tally)
    detail: str = ""


class SkillRunner(RunnerBase):
    """A subclass provides `activate`, `_decide` (which calls `_ask_skill`), `_apply` and `_gate_of`."""

    def __init__(
        self,
        *,
        rate_hz: float = 30.0,
        deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(rate_hz=rate_hz, deadline_policy=deadline_policy, clock=clock)
        self._mailbox = Mailbox()
        self._active: Active | None = None
        self._stopping = False
        self._total = Tally()
        self._skills: dict[str, int] = {}  # goals by skill
        self._asked: Active | None = None  # whose skill this tick asked
        self._asked_ended: tuple[Goal, SkillEnded | None] | None = (
            None  # told after the tick that it ended in
        )
        self.sink: TickSink | None = None  # hears of the goals' ticks; set it before the first goal
        self.world: WorldState | None = None  # the newest; replaced, never changed
        self.violations: deque[str] = deque(maxlen=VIOLATIONS_KEPT)
        self.progress = Progress(0.0, "idle")  # replaced whole: the event loop may read it any time
        self.caption: tuple[str, ...] = ()
        self.estop: EstopRequested | None = None  # latched for the life of the process
        self.estop_ns = 0  # when it was, on the monotonic clock; 0: it is not
        self._latching = threading.Lock()  # two threads may stop at once: the first reason stays

    @abstractmethod
    def _gate_of(self, skill: Stepped) -> SafetyGate:
        """What every action of this skill passes before it reaches a motor. Raises ConfigError for an envelope that cannot be kept."""

    @abstractmethod
    def camera_names(self) -> tuple[str, ...]:
        """Observation cameras, the default one first."""

    def request_stop(self) -> None:
        """Any thread: the run ends before its next tick."""
        self._stopping = True

    def request_estop(self, reason: str) -> None:
        """Any thread: latch the emergency stop. The first reason stays. The control thread obeys before it moves anything again."""
        self._latch(
            EstopRequested(
                f"emergency stop: {reason}",
                hint="look at the robot, then start the runner again",
                details={"reason": reason},
            )
        )

    def _latch(self, error: EstopRequested) -> None:
        with self._latching:
            if self.estop is None:
                self.estop_ns = time.monotonic_ns()
                self.estop = error

    def obey_estop(self) -> EstopRequested | None:
        """Control thread: end the skill and stop what moves, if the stop is latched; repeatable. Says what was done."""
        if self.estop is not None:
            self._end(SkillEnded({}, self.estop))
        return self.estop

    @property
    def mailbox(self) -> Mailbox:
        return self._mailbox

    def _take_posted(self) -> None:
        """Not before an emergency stop that is latched: obeying it comes first, in the tick."""
        if self.estop is None:
            self._mailbox.run_pending()

    def _take_posted_after_stop(self) -> None:
        if self.estop is not None:
            self._mailbox.run_pending()

    def _finished(self) -> bool:
        return self._stopping

    def _metadata(self) -> dict[str, Any]:
        recorded = {} if self.sink is None else {"recorded": dict(self.sink.facts())}
        skills = {"goals_by_skill": dict(self._skills)}
        return {**super()._metadata(), **self._total.as_data(), **skills, **recorded}

    # -- the skill that has the arm --------------------------------------------------------------------------------------
    def begin_skill(self, skill: Skill, goal: Goal, on_end: Callable[[SkillEnded], None]) -> None:
        """Control thread. Raises InternalError when another skill has the arm, EstopRequested when the stop is latched, ConfigError when its
        envelope cannot be kept."""
        self._give(skill, goal, on_end)

    def _give(self, skill: Stepped, goal: Goal, on_end: Callable[[SkillEnded], None]) -> None:
        if self.estop is not None:
            raise self.estop
        if self._active is not None:
            raise InternalError("another skill has the arm")
        self._active = Active(skill, goal, on_end, self.tick_idx, self._gate_of(skill))
        key = str(skill.key)
        self._skills[key] = self._skills.get(key, 0) + 1
        self.traceparent, self.labels = goal.traceparent, {telemetry.ATTR_SKILL: goal.rskill_id}
        self._still = True
        self.progress = Progress(0.0, "running")

    def end_skill(self) -> dict[str, Any]:
        """Control thread: take the arm back; it holds. Says what became of the goal so far. Repeatable."""
        active, self._active = self._active, None
        self.traceparent, self.labels = None, {}
        self.progress = Progress(0.0, "idle")
        if active is None:
            return {}
        self._tell_end(active, None)
        return self._account(active)

    def _account(self, active: Active) -> dict[str, Any]:
        return {"ticks": self.tick_idx - active.began_tick, **active.tally.as_data()}

    def _end(self, ended: SkillEnded) -> None:
        if (active := self._active) is None:
            return
        self._active = None
        self.traceparent, self.labels = None, {}
        self.progress = Progress(1.0 if ended.error is None else self.progress.fraction, "ended")
        data = {**self._account(active), **ended.data}
        full = SkillEnded(data, ended.error)
        self._tell_end(active, full)
        active.on_end(full)

    # -- who follows the goals --------------------------------------------------------------------------------------------
    @property
    def _follows(self) -> bool:
        """Whether somebody wants to know of every tick, with the frames of all cameras."""
        return self.sink is not None

    @abstractmethod
    def _targets_now(self) -> Mapping[str, float]:
        """Joint targets in force, rad by joint; without those that nobody has told anything yet."""

    def _base_told(self, decision: Decision) -> tuple[float, float, float] | None:
        """What the base was told in this tick (m/s, m/s, rad/s); None for a robot that has none."""
        return None

    def _transition(self) -> Transition | None:
        """This tick's step of a world that is no robot."""
        return None

    def _tell_end(self, active: Active, ended: SkillEnded | None) -> None:
        if self.sink is None:
            return
        if self._asked is active:  # its last tick is still to come
            self._asked_ended = (active.goal, ended)
        else:
            self.sink.goal_ended(active.goal, ended)

    def _ticked(self, decision: Decision, result: TickResult) -> None:
        asked, self._asked = self._asked, None
        over, self._asked_ended = self._asked_ended, None
        if self.sink is None:
            return
        if asked is not None and self.world is not None:
            told, targets = self._base_told(decision), dict(self._targets_now())
            self.sink.tick(
                GoalTick(asked.goal, self.world, result, targets, told, self._transition())
            )
        if over is not None:
            self.sink.goal_ended(*over)

    # -- one tick ------------------------------------------------------------------------------------------------------
    def _ask_skill(self, active: Active, world: WorldState, decision: Decision) -> None:
        if self.obey_estop() is not None:
            return
        limit = active.goal.max_ticks
        if limit is not None and self.tick_idx - active.began_tick >= limit:
            problem = f"not done within {limit} ticks"
            self._end(
                SkillEnded(
                    {"truncated": True}, LimitExceeded(problem, details={"limit": "max_ticks"})
                )
            )
            return
        self._asked = active
        asked_s = self.clock.now_s()
        try:
            with tracing.span(telemetry.SPAN_INFERENCE):
                outcome = active.skill.step(world)
        except VramError as error:
            decision.safety_violations = (f"{error.code}: {error.message}",)
            self.violations.append(decision.safety_violations[0])
            self._end(SkillEnded({}, error))
            return
        except Exception as error:
            log.exception("skill %s failed", active.goal.rskill_id)
            self._end(
                SkillEnded({}, InternalError(f"the skill failed: {type(error).__name__}: {error}"))
            )
            return
        decision.inference_ms = (self.clock.now_s() - asked_s) * 1e3
        meters.measure(telemetry.METRIC_INFERENCE, decision.inference_ms, self.labels)
        match outcome:
            case Act(action=action, chunk_index=chunk_index, prefetched=prefetched):
                decision.chunk_index = chunk_index
                if prefetched is not None:
                    self._count_chunk(active, prefetched)
                self._check(active, action, world, decision)
            case Hold(reason=reason):
                active.detail = reason
            case Done(data=data):
                self._end(SkillEnded(dict(data)))
                return
        if self._active is active:
            self.progress = Progress(
                min(max(active.skill.fraction, 0.0), 1.0),
                "running",
                self.tick_idx - active.began_tick,
                active.detail,
            )

    def _count_chunk(self, active: Active, in_time: bool) -> None:
        tracing.event(telemetry.EVENT_PREFETCH_HIT if in_time else telemetry.EVENT_PREFETCH_MISS)
        active.tally.count_chunk(in_time)
        self._total.count_chunk(in_time)

    def _check(self, active: Active, action: Action, world: WorldState, decision: Decision) -> None:
        checked_s = self.clock.now_s()
        with tracing.span(telemetry.SPAN_SAFETY):
            allowed, problems = active.gate.check(action, world)
        decision.safety_ms = (self.clock.now_s() - checked_s) * 1e3
        decision.safety_violations = problems
        decision.action = allowed
        self.violations.extend(problems)
        if problems:
            meters.count(telemetry.METRIC_SAFETY_VIOLATIONS, self.labels, len(problems))
        if allowed is not None:
            active.withheld_in_a_row = 0
            if not active.was_late:
                active.late_in_a_row = 0
            active.was_late = False
            active.tally.clamped += bool(problems)
            self._total.clamped += bool(problems)
            active.detail = ""
            return
        self._withheld(active, problems[0])
        active.withheld_in_a_row += 1
        if active.withheld_in_a_row >= WITHHELD_IN_A_ROW_MAX:
            self._end(
                SkillEnded(
                    {},
                    ModelError(
                        f"{active.withheld_in_a_row} actions in a row were withheld: {problems[0]}",
                        hint="the skill commands what this robot's envelope forbids",
                    ),
                )
            )

    def _came_too_late(self) -> None:
        """A skill does not notice that nothing of it is sent: it would play to its end and call that a success."""
        if (active := self._active) is None:
            return
        active.was_late = True
        active.late_in_a_row += 1
        self._withheld(active, "it came too late")
        if active.late_in_a_row >= WITHHELD_IN_A_ROW_MAX:
            self._end(
                SkillEnded(
                    {},
                    LimitExceeded(
                        f"{active.late_in_a_row} actions in a row came too late and were withheld",
                        hint="lower rate_hz, or look at what makes the ticks long",
                        details={"limit": "deadline"},
                    ),
                )
            )

    def _withheld(self, active: Active, reason: str) -> None:
        """Note that nothing reaches the motors in this tick, and why."""
        tracing.event(telemetry.EVENT_ACTION_WITHHELD, reason=reason)
        meters.count(telemetry.METRIC_WITHHELD, self.labels)
        active.tally.withheld += 1
        self._total.withheld += 1
        active.detail = f"withheld: {reason}"
