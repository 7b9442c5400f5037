"""The base of every runner: ticks at a rate, deadlines with a policy, timings, a trace span per tick.

Subclasses say what is sensed and decided (`_decide`) and how it reaches the robot (`_apply`); between the two the deadline
policy acts, so that DROP really withholds a late action. Knows no robot, simulator, skill or socket.

One tick:
 0. take what was posted (subclass): a goal that begins here has this tick in its trace
 1. decide: sensors → world state → inference → safety (subclass)
 2. was the slot over before the decision was there? DROP and RAISE withhold the action
 3. apply, or hold (subclass)
 4. measure; under RAISE a missed deadline ends the run
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.control.timings import Timings, mean, percentile
from vram_arbiter.runner.protocols import DeadlineMissed, DeadlinePolicy
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, RunResult, TickResult

_SHARES = {"p50": 0.5, "p99": 0.99, "max": 1.0}


@dataclass(slots=True)
class Decision:
    """What one tick wants to do, and where its time went."""

    action: Action | None = None
    sensors_ms: float = 0.0
    world_state_ms: float = 0.0
    inference_ms: float = 0.0
    safety_ms: float = 0.0
    chunk_index: int | None = None
    safety_violations: tuple[str, ...] = ()
    reset: bool = False


@dataclass(slots=True)
class Applied:
    """What became of it."""

    action_applied: bool
    step_idx: int | None = None
    episode_idx: int | None = None
    reward: float | None = None
    terminated: bool | None = None
    truncated: bool | None = None
    success: bool | None = None


class RunnerBase(ABC):
    """`rate_hz` 0 runs as fast as it can, without deadlines. Raises DeadlineMissed from `tick` and `run` under RAISE."""

    def __init__(
        self,
        *,
        rate_hz: float = 30.0,
        deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
        clock: Clock | None = None,
    ) -> None:
        if not math.isfinite(rate_hz) or rate_hz < 0:
            raise ValueError(f"rate_hz must be 0 or more, not {rate_hz}")
        self.rate_hz = rate_hz
        self.deadline_policy = deadline_policy
        self.clock: Clock = clock or SystemClock()
        self.tick_idx = 0
        self._first_tick = 0  # of the present run
        self.deadline_misses = 0
        self.late_actions_withheld = 0
        self.save_dir: str | None = None  # folder of the dataset that this run is recorded into
        self.traceparent: str | None = (
            None  # of the goal that the ticks are for; they join its trace
        )
        self.labels: dict[str, str] = {}  # of what the ticks measure: the goal's skill
        self.trace_ticks = 1.0  # share of the ticks that get spans, 0 to 1
        self._still = True  # no action was applied yet: until then every tick gets spans
        self._tick_credit = 0.0
        self._due_s: float | None = None  # when the present tick should have begun
        self.timings = Timings()
        self.identity: dict[
            str, Any
        ] = {}  # what it is that runs: robot, scene, seed; goes into the result
        self._trace_id: str | None = None

    # -- what a subclass provides --
    def _take_posted(self) -> None:  # noqa: B027 - a run without an event loop has nobody who posts
        """Work for this thread, before the tick begins."""

    @abstractmethod
    def activate(self) -> None:
        """Acquire what a run needs. Raises when it cannot."""

    @abstractmethod
    def deactivate(self) -> None:
        """Let go of everything; repeatable."""

    @abstractmethod
    def _decide(self, tick_idx: int) -> Decision: ...

    @abstractmethod
    def _apply(self, decision: Decision) -> Applied:
        """Carry the decision out; `decision.action` None means hold."""

    def _finished(self) -> bool:
        """Whether the run is over by itself, asked before every tick."""
        return False

    def _came_too_late(self) -> None:  # noqa: B027 — most need not know
        """The deadline policy has just withheld this tick's action."""

    def _success(self) -> bool | None:
        return None

    def _ticked(self, decision: Decision, result: TickResult) -> None:  # noqa: B027 — not every runner is followed
        """Called at the end of every tick, before a missed deadline may end the run; must not wait."""

    # -- the loop --
    @property
    def period_s(self) -> float | None:
        return 1.0 / self.rate_hz if self.rate_hz > 0 else None

    def tick(self) -> TickResult:
        """One turn. See the module's docstring for its steps.

        Its span joins the trace of the goal, or the present one (a benchmark's command). Outside both a tick begins no trace of its own: a
        robot that waits would begin thirty a second.
        """
        started_s = self.clock.now_s()
        self._take_posted()  # 0
        with self._spanned():
            carrier = tracing.carrier() or {}
            if self._trace_id is None and "traceparent" in carrier:
                self._trace_id = carrier["traceparent"].split("-")[1]
            return self._tick(started_s, carrier or None)

    def _spanned(self) -> AbstractContextManager[object]:
        """The tick's span; for one that is left out (`trace_ticks`) no span, and what it would have joined stands for it."""
        if self.traceparent is None and not tracing.traced():
            return tracing.left_out(None)
        if not self._still:
            self._tick_credit += self.trace_ticks
            if self._tick_credit < 1.0:
                return tracing.left_out(self.traceparent)
            self._tick_credit -= 1.0
        return tracing.span(telemetry.SPAN_TICK, self.traceparent, self.labels)

    def _tick(self, started_s: float, trace_context: dict[str, str] | None) -> TickResult:
        due_s = started_s if self._due_s is None or self.period_s is None else self._due_s
        late_ms = max(0.0, started_s - due_s) * 1e3
        deadline_s = math.inf if self.period_s is None else due_s + self.period_s
        decision = self._decide(self.tick_idx)  # 1
        if decision.reset:  # a scene is built, no action can come too late
            deadline_s = math.inf
        withheld = (
            self.clock.now_s() > deadline_s and self.deadline_policy is not DeadlinePolicy.WARN
        )  # 2
        if withheld and decision.action is not None:
            decision.action = None
            self.late_actions_withheld += 1
            self._came_too_late()
        apply_s = self.clock.now_s()
        with nullcontext() if decision.action is None else tracing.span(telemetry.SPAN_SEND):
            applied = self._apply(decision)  # 3
        self._still = self._still and not applied.action_applied
        ended_s = self.clock.now_s()
        missed = ended_s > deadline_s
        result = TickResult(
            stamp_ns=self.clock.now_ns(),
            tick_idx=self.tick_idx,
            tick_ms=(ended_s - started_s) * 1e3,
            late_ms=late_ms,
            sensors_ms=decision.sensors_ms,
            world_state_ms=decision.world_state_ms,
            inference_ms=decision.inference_ms,
            safety_ms=decision.safety_ms,
            hal_ms=(ended_s - apply_s) * 1e3,
            chunk_index=decision.chunk_index,
            safety_violations=decision.safety_violations,
            action_applied=applied.action_applied,
            deadline_missed=missed,
            step_idx=applied.step_idx,
            episode_idx=applied.episode_idx,
            reward=applied.reward,
            terminated=applied.terminated,
            truncated=applied.truncated,
            success=applied.success,
            trace_context=trace_context,
        )
        self.tick_idx += 1
        self.timings.add(
            started_s,
            late_ms,
            result.tick_ms,
            result.inference_ms,
            result.hal_ms,
            reset=decision.reset,
        )
        meters.measure(telemetry.METRIC_TICK, result.tick_ms, self.labels)
        self._ticked(decision, result)
        if missed:  # 4
            self.deadline_misses += 1
            meters.count(telemetry.METRIC_DEADLINE_MISSES, self.labels)
            tracing.event(telemetry.EVENT_DEADLINE_MISSED, tick_ms=result.tick_ms)
            if self.deadline_policy is DeadlinePolicy.RAISE:
                raise DeadlineMissed(
                    f"tick {result.tick_idx} took {result.tick_ms:.1f} ms of its {1e3 / self.rate_hz:.1f} ms",
                    hint="lower the rate or choose the policy warn or drop",
                )
        return result

    def run(self, max_ticks: int | None = None) -> RunResult:
        """Tick until `_finished` or `max_ticks` more ticks. A long tick costs its own slots, never
        those after it.

        The result is of this run's ticks alone; their indices go on from the run before.
        """
        if self.tick_idx != self._first_tick:
            self._first_tick, self.timings = self.tick_idx, Timings()
            self.deadline_misses = self.late_actions_withheld = 0
        first = self.tick_idx
        self._due_s = self.clock.now_s()
        try:
            while not self._finished() and (max_ticks is None or self.tick_idx - first < max_ticks):
                self.tick()
                self._wait_for_next_slot()
        finally:
            self._due_s = None
        return self.result()

    def _wait_for_next_slot(self) -> None:
        """Sleep to the next slot of the grid that is still to come: deadlines resynchronise, no burst catches up."""
        if self.period_s is None or self._due_s is None:
            return
        self._due_s += self.period_s
        behind_s = self.clock.now_s() - self._due_s
        if behind_s > 0:
            self._due_s += math.ceil(behind_s / self.period_s) * self.period_s
        self.clock.sleep_s(self._due_s - self.clock.now_s())

    def result(self) -> RunResult:
        """The present run so far, or the last one."""
        tick_ms, inference_ms = self.timings.tick_ms, self.timings.inference_ms
        return RunResult(
            n_ticks=self.tick_idx - self._first_tick,
            success=self._success(),
            budget_violations=self.deadline_misses,
            avg_inference_ms=mean(inference_ms),
            p99_inference_ms=percentile(inference_ms, 0.99),
            avg_tick_ms=mean(tick_ms),
            p99_tick_ms=percentile(tick_ms, 0.99),
            trace_id=self._trace_id,
            metadata=self._metadata(),
            save_dir=self.save_dir,
        )

    def _metadata(self) -> dict[str, Any]:
        """What else there is to say of the run; subclasses add what they know."""
        late_ms = self.timings.late_ms
        return {
            **self.identity,
            "rate_hz": self.rate_hz,
            "deadline_policy": self.deadline_policy.value,
            "deadline_misses": self.deadline_misses,
            "late_actions_withheld": self.late_actions_withheld,
            "start_late_ms": {name: percentile(late_ms, share) for name, share in _SHARES.items()},
        }
