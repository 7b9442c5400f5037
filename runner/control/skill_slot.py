"""Place for the one skill that has the robot, with the safety gate of its goal.

Everything runs on the control thread. The event loop may read `progress` at any time: it is
replaced whole. Must not know the robot, the rate or a socket.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.follow import GoalFollower
from vram_arbiter.runner.control.robot import StaleInput
from vram_arbiter.runner.control.tally import Tally
from vram_arbiter.runner.control.withheld import LATE, Streak
from vram_arbiter.runner.protocols import (
    Act,
    ChunkStart,
    Done,
    Goal,
    GoalData,
    Hold,
    Paced,
    Progress,
    SafetyGate,
    SkillEnded,
    Stepped,
)
from vram_arbiter.runner.safety.violations import SafetyViolation, Violation
from vram_arbiter.schemas.errors import InternalError, LimitExceeded, ModelError, VramError
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, WorldState

log = logging.getLogger(__name__)

VIOLATIONS_KEPT = 256
WITHHELD_IN_A_ROW_MAX = 15  # half a second of refused actions: the policy is lost, the goal fails


@dataclass(slots=True)
class Decision:
    """Action of one tick, and what was wrong on the way to it."""

    action: Action | None = None
    inference_ms: float = 0.0
    safety_ms: float = 0.0
    chunk_index: int | None = None
    violations: tuple[str, ...] = ()
    intervention: bool = False  # an operator has the robot


@dataclass(slots=True)
class _Active:
    skill: Stepped
    goal: Goal
    on_end: Callable[[SkillEnded], None]
    gate: SafetyGate
    streak: Streak
    ticks: int = 0
    acted: bool = False  # it gave an action
    passed: bool = False  # an action of this tick passed the gate and was not late
    operated: bool = False  # an operator has the robot in this tick
    tally: Tally = field(default_factory=Tally)
    detail: str = ""

    def account(self) -> GoalData:
        return {"ticks": self.ticks, **self.tally.as_data()}


class SkillSlot:
    """Asks the active skill for an action, checks it, and ends the goal on success or failure."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._active: _Active | None = None
        self.follower = GoalFollower()
        self.progress = Progress(0.0, "idle")
        self.violations: deque[str] = deque(maxlen=VIOLATIONS_KEPT)
        self.total = Tally()
        self.goals_by_skill: dict[str, int] = {}
        self.traceparent: str | None = None  # of the active goal; its ticks join that trace
        self.labels: dict[str, str] = {}  # of measurements: the active goal's skill

    @property
    def skill(self) -> Stepped | None:
        return None if self._active is None else self._active.skill

    @property
    def busy(self) -> bool:
        return self._active is not None

    # -- begin and end
    def begin(
        self, skill: Stepped, goal: Goal, on_end: Callable[[SkillEnded], None], gate: SafetyGate
    ) -> None:
        """Give the robot to a skill."""
        self._active = _Active(skill, goal, on_end, gate, Streak(goal.goal_id))
        key = str(skill.key)
        self.goals_by_skill[key] = self.goals_by_skill.get(key, 0) + 1
        self.traceparent, self.labels = goal.traceparent, {telemetry.ATTR_SKILL: goal.rskill_id}
        self.progress = Progress(0.0, "running")

    def take_back(self) -> GoalData:
        """Take the robot from the skill and return the counts so far. Repeatable."""
        active = self._vacate()
        self.progress = Progress(0.0, "idle")
        if active is None:
            return {}
        self.follower.goal_ended(active.goal, None)
        return active.account()

    def end(self, ended: SkillEnded) -> None:
        """End the active goal, if there is one, and tell its owner."""
        if (active := self._vacate()) is None:
            return
        fraction = 1.0 if ended.error is None else self.progress.fraction
        self.progress = Progress(fraction, "ended")
        full = SkillEnded({**active.account(), **ended.data}, ended.error)
        self.follower.goal_ended(active.goal, full)
        active.on_end(full)

    def _vacate(self) -> _Active | None:
        active, self._active = self._active, None
        if active is not None:
            self.traceparent, self.labels = None, {}
            active.streak.end("the goal ends")
        return active

    def tick_over(self, late_ms: float | None) -> None:
        """Count the tick that just ended; an action that reached the motors ends a streak.

        `late_ms`: how far behind its slot it began; None without slots. Ticks before the goal's
        first action are its start-up and not counted as late.
        """
        if (active := self._active) is not None:
            active.ticks += 1
            if active.acted and late_ms is not None:
                active.tally.late_ms.append(late_ms)
                self.total.late_ms.append(late_ms)
                meters.measure(telemetry.METRIC_START_LATE, late_ms / 1e3, self.labels)
            if active.passed:
                active.streak.end("actions pass again")
            active.passed = False

    # -- one tick
    def decide(self, world: WorldState) -> Decision:
        """Ask the active skill for this tick's action and pass it through the gate."""
        decision = Decision()
        if (active := self._active) is None:
            return decision
        limit = active.goal.max_ticks
        if limit is not None and active.ticks >= limit:
            problem = f"not done within {limit} ticks"
            error = LimitExceeded(problem, details={"limit": "max_ticks"})
            self.end(SkillEnded({"truncated": True}, error))
            return decision
        self.follower.goal_asked(active.goal)
        decision.intervention = active.operated
        asked_s = self._clock.now_s()
        try:
            with tracing.span(telemetry.SPAN_INFERENCE):
                outcome = active.skill.step(world)
        except VramError as error:
            decision.violations = (f"{error.code}: {error.message}",)
            self.violations.append(decision.violations[0])
            self.end(SkillEnded({}, error))
            return decision
        except Exception as error:
            log.exception("skill %s failed", active.goal.rskill_id)
            problem = f"the skill failed: {type(error).__name__}: {error}"
            self.end(SkillEnded({}, InternalError(problem)))
            return decision
        decision.inference_ms = (self._clock.now_s() - asked_s) * 1e3
        meters.measure(telemetry.METRIC_INFERENCE, decision.inference_ms / 1e3, self.labels)
        active.operated = decision.intervention = outcome.operator
        match outcome:
            case Act(action=action, chunk_index=chunk_index, chunk=chunk, problem=short):
                active.acted = True
                tracing.note({telemetry.ATTR_CONFIDENCE: action.confidence})
                decision.chunk_index = chunk_index
                if chunk is not None:
                    self._count_chunk(active, chunk)
                self._check(active, action, world, decision, short)
            case Hold(reason=reason, withheld=True):
                decision.violations = (reason,)
                self.violations.append(reason)
                self._refused(active, reason)
            case Hold(reason=reason, standing=standing):
                active.detail = reason
                if standing:
                    self._count_standing(active)
            case Done(data=data):
                self.end(SkillEnded(dict(data)))
        self._show_progress(active)
        return decision

    def _show_progress(self, active: _Active) -> None:
        if self._active is active:
            fraction = min(max(active.skill.fraction, 0.0), 1.0)
            self.progress = Progress(fraction, "running", active.ticks, active.detail)

    def _count_chunk(self, active: _Active, chunk: ChunkStart) -> None:
        active.tally.count_chunk(chunk)
        self.total.count_chunk(chunk)
        if chunk.in_time is None:
            return
        hit = chunk.in_time
        tracing.event(telemetry.EVENT_PREFETCH_HIT if hit else telemetry.EVENT_PREFETCH_MISS)
        labels = {**self.labels, telemetry.ATTR_OUTCOME: "hit" if hit else "miss"}
        meters.count(telemetry.METRIC_PREFETCH, labels)

    def _count_standing(self, active: _Active) -> None:
        active.tally.standing_steps += 1
        self.total.standing_steps += 1
        meters.count(telemetry.METRIC_STANDING, self.labels)

    def _check(
        self, active: _Active, action: Action, world: WorldState, decision: Decision, short: str
    ) -> None:
        checked_s = self._clock.now_s()
        with tracing.span(telemetry.SPAN_SAFETY):
            decision.action, found = active.gate.check(action, world)
            found = (*found, Violation("skill", short)) if short else found
            self._report(found, withheld=decision.action is None)
        decision.safety_ms = (self._clock.now_s() - checked_s) * 1e3
        problems = decision.violations = tuple(map(str, found))
        self.violations.extend(problems)
        if decision.action is None:
            self._refused(active, problems[0])
        else:
            active.passed = True
            active.tally.clamped += bool(problems)
            self.total.clamped += bool(problems)
            active.detail = ""

    def _report(self, problems: Sequence[Violation], *, withheld: bool) -> None:
        """Tell telemetry of the violations of one action; the first one is why it is withheld."""
        for index, problem in enumerate(problems):
            refused = withheld and index == 0
            about = {
                telemetry.ATTR_CHECK: problem.check,
                telemetry.ATTR_SEVERITY: "error" if refused else "warning",
            }
            meters.count(telemetry.METRIC_SAFETY_VIOLATIONS, {**self.labels, **about})
            tracing.event(telemetry.EVENT_SAFETY_VIOLATION, reason=str(problem), **about)
            if refused:
                tracing.refused(SafetyViolation(problem.check, problem), about)

    # -- actions that never reach the motors
    def input_stale(self, stale: StaleInput) -> Decision:
        """Hold instead of asking the skill, and fail the goal once `stale` carries an error."""
        if (active := self._active) is not None:
            if stale.first:
                self.violations.append(stale.problem)
            self._withhold(active, stale.problem, asked=False)
            if stale.error is not None:
                self.end(SkillEnded({}, stale.error))
        return Decision(violations=(stale.problem,))

    def came_too_late(self) -> None:
        """Count an action that the deadline policy withheld."""
        if (active := self._active) is not None:
            active.passed = False
            self._refused(active, LATE)

    def _refused(self, active: _Active, reason: str) -> None:
        """Withhold an action. Too many in a row fail the goal, with the cause of the first one.

        A skill does not have to notice that its actions are not sent: it would play to its end and
        report success. An operator does notice it: an operator's actions are not counted.
        """
        self._withhold(active, reason, asked=not active.operated)
        if isinstance(active.skill, Paced):
            active.skill.withheld()
        streak = active.streak
        if streak.actions < WITHHELD_IN_A_ROW_MAX:
            return
        said = f"{streak.actions} actions in a row were withheld, the first because: {streak.first}"
        details = {"causes": dict(streak.causes)}
        if streak.first == LATE:
            hint = "lower rate_hz, or look at what makes the ticks long"
            late = LimitExceeded(said, hint=hint, details={**details, "limit": "deadline"})
            self.end(SkillEnded({}, late))
        else:
            hint = "the skill commands what this robot's envelope forbids"
            self.end(SkillEnded({}, ModelError(said, hint=hint, details=details)))

    def _withhold(self, active: _Active, reason: str, *, asked: bool) -> None:
        tracing.event(telemetry.EVENT_ACTION_WITHHELD, reason=reason)
        meters.count(telemetry.METRIC_WITHHELD, self.labels)
        active.tally.withheld += 1
        self.total.withheld += 1
        active.streak.add(reason, asked=asked)
        active.detail = f"withheld: {active.streak.first}"
