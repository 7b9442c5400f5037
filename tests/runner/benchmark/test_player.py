"""Episodes of one contestant: one reset a seed, errors that are no verdicts, and their end."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.runner.conftest import KinematicEnv, world_of
from tests.runner.manual_clock import ManualClock
from vram_arbiter.runner.benchmark.outcomes import SeedOutcome
from vram_arbiter.runner.benchmark.player import Player
from vram_arbiter.runner.protocols import ChunkStart, Hold
from vram_arbiter.runner.sim.policies import PolicySkill, policy_of
from vram_arbiter.runner.sim.robot import sim_runner
from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

LOST = f"scripted:{Path(__file__).parents[1]}/lost.py"

Run = Callable[[Any], Any]


class Played:
    """The kinematic robot; an episode is a success in its third step."""

    def __init__(self, rate_hz: float = 0.0, **options: Any) -> None:
        self.env = KinematicEnv()
        begun: dict[int, int] = {}  # steps of the robot at each reset

        def judge(env: KinematicEnv) -> bool:
            return len(env.steps) - begun.setdefault(len(env.resets), len(env.steps) - 1) >= 3

        self.world = world_of(self.env, judge)
        clock = options.pop("clock", None)
        self.runner = sim_runner(
            self.world, rate_hz=rate_hz, ends_with_skill=True, max_steps=50, clock=clock
        )
        self.options = options

    def policy(self, name: str) -> PolicySkill:
        return PolicySkill(name, policy_of(name), self.world)

    def player(self, skill: PolicySkill) -> Player:
        return Player(self.runner, skill, world="table", **self.options)

    async def play(self, skill: PolicySkill, seeds: Iterable[int]) -> list[SeedOutcome]:
        async with self.player(skill) as player:
            return [await player.play(seed) for seed in seeds]


@pytest.mark.heavy
def test_one_reset_a_seed_and_a_verdict_each(run_async: Run) -> None:
    one = Played()
    episodes = run_async(one.play(one.policy(LOST), range(20, 25)))
    assert [(e.seed, e.success, e.steps) for e in episodes] == [(n, True, 3) for n in range(20, 25)]
    assert one.env.resets == [20, 21, 22, 23, 24]
    assert one.runner.tick_idx == 5 * (1 + 3)


def test_a_rate_paces_the_ticks_and_standing_is_counted(run_async: Run) -> None:
    """In real time a policy's latency costs what it costs on a robot."""

    class Thinks(PolicySkill):
        thought = 0

        def step(self, world: Any) -> Any:
            self.thought += 1
            if self.thought == 2:
                return Hold("thinks", standing=True)
            outcome = super().step(world)
            return replace(outcome, chunk=ChunkStart(0.1, None)) if self.thought == 1 else outcome

    clock = ManualClock()
    one = Played(20.0, clock=clock)
    (played,) = run_async(one.play(Thinks("thinks", policy_of(LOST), one.world), (20,)))
    assert (played.success, played.standing_steps) == (True, 1)
    assert clock.slept == pytest.approx([1 / 20] * 3)


@pytest.mark.heavy
def test_a_policy_with_a_defect_fails_and_one_that_gives_up_is_judged(run_async: Run) -> None:
    one = Played()
    episodes = run_async(one.play(one.policy(LOST), (12, 13, 14)))
    assert [(e.success, e.error, e.steps) for e in episodes] == [
        (True, "", 3),
        (False, "model_error", 1),
        (False, "", 2),
    ]
    assert episodes[2].truncated
    assert "IndexError: beyond the table" in episodes[1].message
    assert {e.trace_id for e in episodes} == {None}


def test_an_episode_names_the_trace_that_it_is_in(run_async: Run) -> None:
    trace_id, one = "a" * 32, Played()
    with tracing.joined(f"00-{trace_id}-{'b' * 16}-01"):
        episodes = run_async(one.play(one.policy(LOST), (20,)))
    assert [e.trace_id for e in episodes] == [trace_id]


def test_an_environment_that_raises_is_no_verdict(run_async: Run) -> None:
    one = Played()
    one.env.fails = True
    (played,) = run_async(one.play(one.policy("random"), (7,)))
    assert (played.success, played.error) == (None, "environment_failed")
    assert "the physics blew up" in played.message


def test_a_sidecar_that_is_not_there_is_no_verdict(run_async: Run) -> None:
    class NotThere(PolicySkill):
        released = 0

        async def start(self, goal: Any) -> None:
            raise SidecarUnavailable("nothing answers")

        async def release(self) -> None:
            self.released += 1

    one = Played()
    absent = NotThere("test/absent", policy_of("random"), one.world)
    episodes = run_async(one.play(absent, (1, 2)))
    assert [e.error for e in episodes] == ["sidecar_unavailable"] * 2
    assert absent.released == 1


def test_a_contestant_that_never_acts_does_not_play_for_ever(run_async: Run) -> None:
    class Still(PolicySkill):
        def step(self, world: Any) -> Any:
            return Hold("thinking")

    one = Played(episode_s=0.0)
    still = Still("still", policy_of("random"), one.world)
    (played,) = run_async(one.play(still, (9,)))
    assert (played.success, played.error) == (None, "limit_exceeded")
