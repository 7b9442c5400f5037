"""The control loop on a clock that moves only when told: rates, deadline policies,
resynchronization, figures.
"""

import json
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.runner.manual_clock import ManualClock
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.robot import Applied, Sensed
from vram_arbiter.runner.control.timings import Timings, percentile
from vram_arbiter.runner.protocols import (
    Act,
    DeadlineMissed,
    DeadlinePolicy,
    Goal,
    Hold,
    Picture,
    SafetyGate,
    SkillEnded,
    SkillKey,
    StepOutcome,
    Stepped,
)
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.world import Action, JointState, WorldState

ACTION = Action(
    control_mode=ControlMode.JOINT_POSITION, joint_targets=((0.0,),), joint_names=("a",)
)


class Desk:
    """A robot without sensors: it keeps what was applied, which takes `apply_s`."""

    world: Any = WorldState(
        stamp_ns=0, joint_state=JointState(stamp_ns=0, name=("a",), position=(0.0,))
    )
    reset_due = False

    def __init__(self, clock: Any, apply_s: float) -> None:
        self.clock, self.apply_s = clock, apply_s
        self.applied: list[Action | None] = []

    def open(self, stopping: threading.Event) -> None: ...

    def close(self) -> None: ...

    def admit(self, skill: Stepped) -> SafetyGate:
        return JointRanges({"a": (-1.0, 1.0)})

    def stop(self) -> None: ...

    def reset(self) -> Applied:
        return Applied()

    def sense(self, skill: Stepped | None, *, followed: bool) -> Sensed:
        return Sensed()

    def apply(self, action: Action | None, *, skill_active: bool) -> Applied:
        self.applied.append(action)
        self.clock.advance(self.apply_s)
        return Applied(action_applied=action is not None)

    def targets(self) -> dict[str, float]:
        return {}

    def facts(self) -> dict[str, Any]:
        return {}

    def camera_names(self) -> tuple[str, ...]:
        return ()

    def snapshot(self, camera: str, max_age_s: float) -> Picture:
        raise KeyError(camera)


class Thinker:
    """A skill whose steps take what the script says, in seconds."""

    manifest = None
    key = SkillKey("a/thinker")
    cameras: tuple[str, ...] = ()
    fraction = 0.0

    def __init__(self, clock: Any, decide_s: list[float]) -> None:
        self.clock, self.decide_s = clock, list(decide_s)
        self.began_s: list[float] = []

    def wants_frames(self) -> bool:
        return False

    def step(self, world: WorldState) -> StepOutcome:
        self.began_s.append(self.clock.time_s)
        self.clock.advance(self.decide_s.pop(0) if self.decide_s else 0.0)
        return Act(ACTION)


def scripted(
    clock: Any, decide_s: list[float], apply_s: float = 0.0, loop_clock: Any = None, **options: Any
) -> tuple[ControlLoop[Desk], Thinker]:
    """Return a loop whose skill decides as slowly as the script says."""
    loop = ControlLoop(Desk(clock, apply_s), clock=loop_clock or clock, **options)
    skill = Thinker(clock, decide_s)
    loop.begin_skill(skill, Goal("g", "a/thinker"), lambda ended: None)
    return loop, skill


def test_ticks_stand_on_the_grid_of_the_rate(clock: Any) -> None:
    runner, skill = scripted(clock, [0.01, 0.02, 0.0], rate_hz=10)
    result = runner.run(max_ticks=3)
    assert skill.began_s == pytest.approx([100.0, 100.1, 100.2])
    assert (result.n_ticks, result.budget_violations) == (3, 0)


def test_a_long_tick_costs_its_own_slots_and_no_burst_follows(clock: Any) -> None:
    runner, skill = scripted(clock, [0.0, 0.35, 0.0, 0.0], rate_hz=10)
    result = runner.run(max_ticks=4)
    assert skill.began_s == pytest.approx([100.0, 100.1, 100.5, 100.6])
    assert result.budget_violations == 1


def test_a_tick_that_began_late_misses_its_deadline_within_its_budget() -> None:
    """The second one oversleeps by half a period, then takes longer than the other half."""

    class Oversleeping(ManualClock):
        def sleep_s(self, duration_s: float) -> None:
            super().sleep_s(duration_s + 0.05)

    runner, _ = scripted(Oversleeping(), [0.0, 0.06], rate_hz=10)
    result = runner.run(max_ticks=2)
    assert (result.metadata["deadline_misses"], result.budget_violations) == (1, 0)


def test_a_tick_that_ends_in_time_may_exceed_a_budget_of_its_own(clock: Any) -> None:
    """As on a robot whose load is to be noticed before its ticks come late."""
    runner, _ = scripted(clock, [0.01, 0.04, 0.02], rate_hz=10, latency_budget_ms=30)
    result = runner.run(max_ticks=3)
    assert (result.metadata["deadline_misses"], result.budget_violations) == (0, 1)


def test_warn_applies_a_late_action_and_counts_it(clock: Any) -> None:
    runner, _ = scripted(clock, [0.25], rate_hz=10, deadline_policy=DeadlinePolicy.WARN)
    result = runner.tick()
    assert result.action_applied
    assert result.deadline_missed
    assert runner.robot.applied == [ACTION]


def test_drop_really_withholds_a_late_action(clock: Any) -> None:
    runner, _ = scripted(clock, [0.25, 0.0], rate_hz=10, deadline_policy=DeadlinePolicy.DROP)
    assert runner.run(max_ticks=2).budget_violations == 1
    assert runner.robot.applied == [None, ACTION]
    assert runner.result().metadata["late_actions_withheld"] == 1


def test_drop_keeps_an_action_that_was_decided_in_time(clock: Any) -> None:
    runner, _ = scripted(
        clock, [0.05], apply_s=0.08, rate_hz=10, deadline_policy=DeadlinePolicy.DROP
    )
    result = runner.tick()
    assert result.action_applied
    assert result.deadline_missed


def test_raise_holds_and_ends_the_run(clock: Any) -> None:
    runner, _ = scripted(clock, [0.25], rate_hz=10, deadline_policy=DeadlinePolicy.RAISE)
    with pytest.raises(DeadlineMissed, match="250\\.0 ms of its 100\\.0 ms"):
        runner.run(max_ticks=3)
    assert runner.robot.applied == [None]


def test_rate_zero_never_sleeps_and_never_misses(clock: Any) -> None:
    runner, _ = scripted(clock, [5.0, 5.0], rate_hz=0, deadline_policy=DeadlinePolicy.RAISE)
    assert runner.run(max_ticks=2).budget_violations == 0
    assert clock.slept == []


@pytest.mark.parametrize("rate", [-1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(clock: Any, rate: float) -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        scripted(clock, [], rate_hz=rate)


def test_figures_of_a_run(clock: Any) -> None:
    runner, _ = scripted(clock, [0.01, 0.02, 0.03, 0.04], rate_hz=10)
    result = runner.run(max_ticks=4)
    assert result.avg_inference_ms == pytest.approx(25.0)
    assert result.p99_inference_ms == pytest.approx(39.7)
    assert result.avg_tick_ms == pytest.approx(25.0)
    assert result.p99_tick_ms == pytest.approx(39.7)


def test_a_second_run_counts_its_own_ticks(clock: Any) -> None:
    """Its result was of both runs; the ticks' indices still go on."""
    runner, _ = scripted(clock, [0.0, 0.25, 0.01, 0.01], rate_hz=10)
    first = runner.run(max_ticks=2)
    assert (first.n_ticks, first.budget_violations) == (2, 1)
    second = runner.run(max_ticks=2)
    assert (second.n_ticks, second.budget_violations, runner.tick_idx) == (2, 0, 4)
    assert second.avg_tick_ms == pytest.approx(10.0)
    assert runner.result() == second


@pytest.mark.parametrize(
    ("values", "share", "expected"),
    [
        ([], 0.99, 0.0),
        ([7.0], 0.5, 7.0),
        ([1.0, 2.0], 0.5, 1.5),
        ([4.0, 1.0, 3.0, 2.0], 0.99, 3.97),
    ],
)
def test_percentile_interpolates(values: list[float], share: float, expected: float) -> None:
    assert percentile(values, share) == pytest.approx(expected)


def test_ticks_carry_the_callers_trace(clock: Any) -> None:
    from opentelemetry import context, propagate

    parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    token = context.attach(propagate.extract({"traceparent": parent}))
    try:
        result = scripted(clock, [])[0].tick()
    finally:
        context.detach(token)
    assert result.trace_context["traceparent"].split("-")[1] == parent.split("-")[1]
    assert scripted(clock, [])[0].tick().trace_context is None


class Oversleeper:
    """A manual clock on a busy machine: its sleeps end late, by so much each."""

    def __init__(self, clock: Any, late_s: list[float]) -> None:
        self._clock, self._late_s = clock, list(late_s)
        self.now_s, self.now_ns, self.wall_ns = clock.now_s, clock.now_ns, clock.wall_ns

    def sleep_s(self, duration_s: float) -> None:
        self._clock.sleep_s(duration_s + self._late_s.pop(0))


def test_how_far_behind_its_slot_a_tick_began_is_kept(clock: Any, tmp_path: Path) -> None:
    sleeper = Oversleeper(clock, [0.003, 0.0, 0.0])
    runner, _ = scripted(clock, [0.01, 0.02], rate_hz=10, loop_clock=sleeper)
    result = runner.run(max_ticks=3)
    assert runner.timings.late_ms == pytest.approx([0.0, 3.0, 0.0])
    assert result.metadata["start_late_ms"] == pytest.approx({"p50": 0.0, "p99": 2.94, "max": 3.0})
    assert result.metadata["late_starts_ms"] == result.metadata["start_late_ms"]
    runner.timings.write(tmp_path / "ticks.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "ticks.jsonl").read_text().splitlines()]
    assert [line["started_s"] for line in lines] == pytest.approx([100.0, 100.103, 100.2])
    assert [line["tick_ms"] for line in lines] == pytest.approx([10.0, 20.0, 0.0])
    assert [line["reset"] for line in lines] == [False] * 3


class Starting(Thinker):
    """Gives no action in its first two ticks."""

    def step(self, world: WorldState) -> StepOutcome:
        outcome = super().step(world)
        return Hold("starting") if len(self.began_s) <= 2 else outcome


def test_late_starts_are_counted_from_a_goals_first_action_on(clock: Any) -> None:
    sleeper = Oversleeper(clock, [0.009, 0.003, 0.0, 0.0])
    loop = ControlLoop(Desk(clock, 0.0), clock=sleeper, rate_hz=10)
    ended: list[SkillEnded] = []
    loop.begin_skill(Starting(clock, [0.0] * 4), Goal("g", "a/thinker", max_ticks=3), ended.append)
    assert loop.run(max_ticks=4).metadata["start_late_ms"]["max"] == pytest.approx(9.0)
    assert ended[0].data["late_starts_ms"]["max"] == pytest.approx(3.0)


def test_only_so_many_timings_are_kept() -> None:
    timings = Timings(kept=2)
    for n in range(4):
        timings.add(float(n), 0.0, float(n), 0.0)
    assert timings.tick_ms == [2.0, 3.0]
