"""Control loop of hardware and simulator alike.

`ControlLoop` is composed of a `Robot`, a `SkillSlot` with the goal's safety gate, the emergency
stop's latch, a pacing grid and observers of each tick. It knows no make of robot and no socket.

One tick:
 1. take work: run what other threads posted; a goal that begins here has this tick in its trace
 2. sense: cameras and joints become the world state
 3. decide: ask the skill, unless an input is stale
 4. gate: every action passes the goal's safety gate
 5. deadline policy: WARN applies a late action, DROP and RAISE withhold it
 6. apply, or hold
 7. report: measure the tick and tell its observers; under RAISE a missed deadline ends the run

A latched emergency stop acts before the steps 1, 3 and 6.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Protocol

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.control.mailbox import Mailbox
from vram_arbiter.runner.control.pacing import Pacing, Slot
from vram_arbiter.runner.control.robot import Applied, Robot, Sensed
from vram_arbiter.runner.control.skill_slot import Decision, SkillSlot
from vram_arbiter.runner.control.tick_spans import TickSpans
from vram_arbiter.runner.control.timings import Timings, mean, percentile, spread
from vram_arbiter.runner.protocols import (
    DeadlineMissed,
    DeadlinePolicy,
    Goal,
    GoalData,
    GoalTick,
    Picture,
    Progress,
    SkillEnded,
    Stepped,
    TickSink,
)
from vram_arbiter.runner.safety.estop_latch import EstopLatch
from vram_arbiter.schemas.errors import EstopRequested, InternalError
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, RunResult, TickResult, WorldState


class Video(Protocol):
    """Films the run. Called within the tick, after the action was applied."""

    def show(
        self, applied: Applied, *, tick_idx: int, skill_active: bool, caption: tuple[str, ...]
    ) -> None: ...


@dataclass(slots=True)
class _Tick:
    """What the steps of one tick tell each other."""

    started_s: float
    reset: bool = False
    slot: Slot = field(default_factory=Slot)
    trace_context: dict[str, str] | None = None
    sensed: Sensed = field(default_factory=Sensed)
    decision: Decision = field(default_factory=Decision)
    apply_s: float = 0.0
    applied: Applied = field(default_factory=Applied)


class ControlLoop[R: Robot]:
    """Ticks at `rate_hz`; 0 runs as fast as it can, without deadlines.

    A tick that takes longer than `latency_budget_ms` (None: a period) is a budget violation.

    Everything runs on the control thread, except `request_stop`, `request_estop` and what the
    event loop may read at any time: `progress`, `world`, `caption` and `estop` are replaced whole.
    """

    def __init__(
        self,
        robot: R,
        *,
        rate_hz: float = 30.0,
        deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
        latency_budget_ms: float | None = None,
        clock: Clock | None = None,
        latch: EstopLatch | None = None,
        video: Video | None = None,
    ) -> None:
        self.clock: Clock = clock or SystemClock()
        self.robot = robot
        self.deadline_policy = deadline_policy
        self.latch = latch or EstopLatch()
        self.slot = SkillSlot(self.clock)
        self.mailbox = Mailbox()
        self.timings = Timings()
        self.spans = TickSpans()
        self.tick_idx = 0
        self.deadline_misses = 0  # ticks that ended after their slot
        self.budget_violations = 0  # ticks that took longer than allowed, whenever they began
        self.late_actions_withheld = 0
        self.caption: tuple[str, ...] = ()  # lines for the video
        self.identity: GoalData = {}  # what runs: robot, scene, seed; part of the result
        self.save_dir: str | None = None  # folder of the dataset that the run is recorded into
        self._video = video
        self._pacing = Pacing(rate_hz, self.clock)
        self._budget_ms = latency_budget_ms or 1e3 * (self._pacing.period_s or math.inf)
        self._stopping = threading.Event()
        self._first_tick = 0  # of the present run
        self._obeyed = False  # the latched stop, at least once

    # -- life
    def activate(self) -> None:
        """Acquire what a run needs. Raises what the robot raises."""
        meters.count(telemetry.METRIC_ESTOPS, times=0)  # so that `increase` sees the first one
        self.robot.open(self._stopping)

    def deactivate(self) -> None:
        """End the active goal and free everything. Repeatable."""
        self.slot.end(SkillEnded({}, self.estop or InternalError("the runner is stopping")))
        self.robot.close()

    def run(self, max_ticks: int | None = None) -> RunResult:
        """Tick until the run is over, or for `max_ticks` ticks.

        The result covers this run's ticks alone; tick indices continue from the run before.
        """
        if self.tick_idx != self._first_tick:
            self._first_tick = self.tick_idx
            self.timings.clear()
            self.deadline_misses = self.budget_violations = self.late_actions_withheld = 0
        first = self.tick_idx
        with self.paced() as wait:
            while not self.stopping and (max_ticks is None or self.tick_idx - first < max_ticks):
                self.tick()
                wait()
        return self.result()

    @contextmanager
    def paced(self) -> Iterator[Callable[[], None]]:
        """Begin a grid of slots for ticks; yield what sleeps until the next slot."""
        self._pacing.start()
        try:
            yield self._pacing.wait
        finally:
            self._pacing.stop()

    def request_stop(self) -> None:
        """End the run before its next tick. Any thread."""
        self._stopping.set()

    @property
    def stopping(self) -> bool:
        return self._stopping.is_set()

    # -- emergency stop
    @property
    def estop(self) -> EstopRequested | None:
        """The latched stop; it stays for the life of the process."""
        return self.latch.error

    @property
    def estop_ns(self) -> int:
        """Monotonic time of the stop; 0: not latched."""
        return self.latch.since_ns

    def request_estop(self, reason: str) -> None:
        """Latch the emergency stop. Any thread. The loop obeys before it moves anything again."""
        self.latch.request(reason)

    def obey_estop(self) -> EstopRequested | None:
        """Stop the motors and end the goal if the stop is latched. Repeatable.

        Returns: the stop, with what became of the motors.
        """
        if self.estop is not None:
            if not self._obeyed:
                self._obeyed = True
                meters.count(telemetry.METRIC_ESTOPS)
            self.robot.stop()
            self.slot.end(SkillEnded({}, self.estop))
        return self.estop

    # -- goals
    @property
    def progress(self) -> Progress:
        return self.slot.progress

    def begin_skill(self, skill: Stepped, goal: Goal, on_end: Callable[[SkillEnded], None]) -> None:
        """Give the robot to a skill.

        Raises InternalError when another skill has it, EstopRequested when the stop is latched,
        and what `Robot.admit` raises.
        """
        if self.estop is not None:
            raise self.estop
        if self.slot.busy:
            raise InternalError("another skill has the robot")
        self.slot.begin(skill, goal, on_end, self.robot.admit(skill))
        self.spans.goal_began()

    def end_skill(self) -> GoalData:
        """Take the robot back; it holds. Returns the goal's counts so far. Repeatable."""
        return self.slot.take_back()

    def follow(self, sink: TickSink, save_dir: str | None = None) -> None:
        """Report the ticks of all goals to `sink` as well, from before the first goal on."""
        self.slot.follower.sinks += (sink,)
        self.save_dir = save_dir or self.save_dir

    # -- what others look at
    @property
    def rate_hz(self) -> float:
        return self._pacing.rate_hz

    @property
    def world(self) -> WorldState | None:
        return self.robot.world

    def camera_names(self) -> tuple[str, ...]:
        """Return the observation cameras, the default one first."""
        return self.robot.camera_names()

    def snapshot(self, camera: str, max_age_s: float) -> Picture:
        """Return a picture no older than `max_age_s`. Raises FrameStale, BadRequest."""
        return self.robot.snapshot(camera, max_age_s)

    # -- one tick
    def tick(self) -> TickResult:
        """Run one tick; the module's docstring lists its steps."""
        tick = _Tick(self.clock.now_s())
        self._take_work(tick)  # 1
        with self.spans.tick(self.slot.traceparent, self.slot.labels):
            self._open(tick)
            self._sense(tick)  # 2
            self._decide(tick)  # 3, 4
            self._meet_deadline(tick)  # 5
            self._apply(tick)  # 6
            return self._report(tick)  # 7

    def _take_work(self, tick: _Tick) -> None:
        """Run posted work, but not before a latched stop is obeyed, nor before a scene stands."""
        if self.estop is None and not self.robot.reset_due:
            self.mailbox.run_pending()
        tick.reset = self.robot.reset_due

    def _open(self, tick: _Tick) -> None:
        """Note the tick's trace and slot, and obey a latched stop before anything is sensed."""
        tick.trace_context = self.spans.carrier()
        tick.slot = self._pacing.slot(tick.started_s)
        if tick.reset:
            tick.slot = Slot(tick.slot.late_ms, math.inf)  # no action can come too late
        elif self.obey_estop() is not None:
            self.mailbox.run_pending()

    def _sense(self, tick: _Tick) -> None:
        """Update the world state; the goal ends if the robot cannot go on."""
        if tick.reset:
            return
        followed = bool(self.slot.follower.sinks)
        tick.sensed = self.robot.sense(self.slot.skill, followed=followed)
        if tick.sensed.problem:
            tick.decision.violations = (tick.sensed.problem,)
        if tick.sensed.ended is not None:
            self.slot.end(tick.sensed.ended)

    def _decide(self, tick: _Tick) -> None:
        """Ask the skill and pass its action through the gate, unless an input is stale."""
        if tick.reset or self.obey_estop() is not None or not self.slot.busy:
            return
        if tick.sensed.stale is not None:
            tick.decision = self.slot.input_stale(tick.sensed.stale)
        elif self.world is not None:
            tick.decision = self.slot.decide(self.world)

    def _meet_deadline(self, tick: _Tick) -> None:
        """Withhold a late action under DROP and RAISE."""
        if self.deadline_policy is DeadlinePolicy.WARN or tick.decision.action is None:
            return
        if self.clock.now_s() > tick.slot.deadline_s:
            tick.decision.action = None
            self.late_actions_withheld += 1
            self.slot.came_too_late()

    def _apply(self, tick: _Tick) -> None:
        """Apply the action, hold, or prepare a scene; the goal ends if the robot says so."""
        tick.apply_s = self.clock.now_s()
        if tick.reset:
            tick.applied = self.robot.reset()
        else:
            if self.obey_estop() is not None:
                tick.decision.action = None
            action = tick.decision.action
            with nullcontext() if action is None else tracing.span(telemetry.SPAN_SEND):
                tick.applied = self.robot.apply(action, skill_active=self.slot.busy)
            if action is not None:
                self.obey_estop()  # the hardware may have latched a stop of its own
        if self._video is not None:
            self._video.show(
                tick.applied,
                tick_idx=self.tick_idx,
                skill_active=self.slot.busy,
                caption=self.caption,
            )
        if tick.applied.problem:
            self.slot.violations.append(tick.applied.problem)
        if tick.applied.ended is not None:
            self.slot.end(tick.applied.ended)

    def _report(self, tick: _Tick) -> TickResult:
        """Measure the tick and tell everything that follows it. Raises DeadlineMissed."""
        result = self._measured(tick)
        labels = self.slot.labels
        self.tick_idx += 1
        self.slot.tick_over(None if math.isinf(tick.slot.deadline_s) else result.late_ms)
        self.spans.applied(result.action_applied)
        self.timings.add(
            tick.started_s,
            result.late_ms,
            result.tick_ms,
            result.inference_ms,
            result.hal_ms,
            reset=tick.reset,
        )
        meters.measure(telemetry.METRIC_TICK, result.tick_ms / 1e3, labels)
        self.slot.follower.tick_over(lambda goal: self._goal_tick(goal, tick, result))
        if not math.isinf(tick.slot.deadline_s) and result.tick_ms > self._budget_ms:
            self.budget_violations += 1
            meters.count(telemetry.METRIC_BUDGET_VIOLATIONS, labels)
        if result.deadline_missed:
            self.deadline_misses += 1
            meters.count(telemetry.METRIC_DEADLINE_MISSES, labels)
            tracing.event(telemetry.EVENT_DEADLINE_MISSED, tick_ms=result.tick_ms)
            if self.deadline_policy is DeadlinePolicy.RAISE:
                raise DeadlineMissed(
                    f"tick {result.tick_idx} took {result.tick_ms:.1f} ms"
                    f" of its {1e3 / self.rate_hz:.1f} ms, and began {result.late_ms:.1f} ms late",
                    hint="lower the rate or choose the policy warn or drop",
                )
        return result

    def _measured(self, tick: _Tick) -> TickResult:
        ended_s = self.clock.now_s()
        sensed, decision, applied = tick.sensed, tick.decision, tick.applied
        return TickResult(
            stamp_ns=self.clock.now_ns(),
            tick_idx=self.tick_idx,
            tick_ms=(ended_s - tick.started_s) * 1e3,
            late_ms=tick.slot.late_ms,
            sensors_ms=sensed.sensors_ms,
            world_state_ms=sensed.world_state_ms,
            inference_ms=decision.inference_ms,
            safety_ms=decision.safety_ms,
            hal_ms=(ended_s - tick.apply_s) * 1e3,
            chunk_index=decision.chunk_index,
            safety_violations=decision.violations,
            action_applied=applied.action_applied,
            deadline_missed=ended_s > tick.slot.deadline_s,
            step_idx=applied.step_idx,
            episode_idx=applied.episode_idx,
            terminated=applied.terminated,
            truncated=applied.truncated,
            success=applied.success,
            trace_context=tick.trace_context,
        )

    def _goal_tick(self, goal: Goal, tick: _Tick, result: TickResult) -> GoalTick | None:
        if self.world is None:
            return None
        return GoalTick(
            goal,
            self.world,
            result,
            dict(self.robot.targets()),
            _base_command(self.world, tick.decision.action),
            tick.decision.intervention,
        )

    # -- result
    def result(self) -> RunResult:
        """Return the present run so far, or the last one."""
        tick_ms, inference_ms = self.timings.tick_ms, self.timings.inference_ms
        return RunResult(
            n_ticks=self.tick_idx - self._first_tick,
            budget_violations=self.budget_violations,
            avg_inference_ms=mean(inference_ms),
            p99_inference_ms=percentile(inference_ms, 0.99),
            avg_tick_ms=mean(tick_ms),
            p99_tick_ms=percentile(tick_ms, 0.99),
            trace_id=self.spans.trace_id,
            metadata=self._metadata(),
            save_dir=self.save_dir,
        )

    def _metadata(self) -> GoalData:
        late_ms, recorded = self.timings.late_ms, self.slot.follower.facts()
        return {
            **self.identity,
            "rate_hz": self.rate_hz,
            "deadline_policy": self.deadline_policy.value,
            "deadline_misses": self.deadline_misses,
            "late_actions_withheld": self.late_actions_withheld,
            "start_late_ms": spread(late_ms),
            **self.slot.total.as_data(),
            "goals_by_skill": dict(self.slot.goals_by_skill),
            **({"recorded": recorded} if recorded else {}),
            **self.robot.facts(),
        }


def _base_command(world: WorldState, action: Action | None) -> tuple[float, float, float] | None:
    """Return what the base was told (m/s, m/s, rad/s); None for a robot without a base."""
    if world.base_pose is None:
        return None
    if action is None or action.body_twist is None:
        return (0.0, 0.0, 0.0)  # a base without a command stands still
    vx, vy, _, _, _, wz = action.body_twist[0]
    return (vx, vy, wz)
