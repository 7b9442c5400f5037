"""`vram-runner benchmark`: rates with their interval, one reset a seed, errors that are no
verdicts, videos, and a report whatever happens.
"""

import argparse
import asyncio
import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.runner.manual_clock import ManualClock
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.cli.benchmark import add_parser, entries_of, remembers, worlds_of
from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, PolicyContestant, file_name, wilson
from vram_arbiter.runner.sim.gym_config import GymConfig
from vram_arbiter.runner.sim.gym_env import GymEnv
from vram_arbiter.runner.sim.policies import Policy, policy_of
from vram_arbiter.runner.sim.presets import PRESETS, preset_of
from vram_arbiter.runner.sim.robot import sim_runner
from vram_arbiter.runner.sim.worlds import world_of
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable, UnknownSkill
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.manifest.vocabulary import ModelFamily
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

HERE = Path(__file__).parents[1]
ROOT = HERE.parents[1]
POINT_ID = "tests.runner.gym_worlds:test/Point-v0"
POINT = f"gym:{POINT_ID}"
SEEK = f"scripted:{HERE}/seek.py"

Run = Callable[[Any], Any]


# -- the interval
@pytest.mark.parametrize(
    ("successes", "of", "low", "high"),
    # Wilson's score interval without continuity correction, as statsmodels' `proportion_confint(…,
    # method="wilson")` gives it
    [
        (0, 10, 0.0, 0.2775),
        (5, 10, 0.2366, 0.7634),
        (10, 10, 0.7225, 1.0),
        (1, 1, 0.2065, 1.0),
        (95, 100, 0.8882, 0.9785),
    ],
)
def test_wilsons_interval(successes: int, of: int, low: float, high: float) -> None:
    assert wilson(successes, of) == pytest.approx((low, high), abs=5e-5)


@given(st.integers(1, 5000).flatmap(lambda of: st.tuples(st.integers(0, of), st.just(of))))
def test_the_interval_holds_the_rate_and_mirrors(counts: tuple[int, int]) -> None:
    successes, of = counts
    low, high = wilson(successes, of) or (2.0, 2.0)
    assert 0.0 <= low <= successes / of + 1e-12
    assert successes / of - 1e-12 <= high <= 1.0
    assert wilson(of - successes, of) == pytest.approx((1 - high, 1 - low))


def test_nothing_played_has_no_rate() -> None:
    assert wilson(0, 0) is None
    assert Cell("w", "c", None).summary()["success_rate"] is None


def test_any_name_can_be_a_file() -> None:
    assert file_name("gym:a/b v0") == "gym-a-b-v0"
    assert file_name("../x") == "x"


# -- one cell
class Counted:
    """Runs cells on one environment and keeps it, so that its resets can be counted."""

    def __init__(self, **kwargs: Any) -> None:
        self.env = GymEnv(POINT_ID, GymConfig(kwargs=kwargs), render=False)
        self.runner = sim_runner(lambda: self.env, rate_hz=0, ends_with_skill=True, max_steps=50)
        self.bench = Benchmark(self.runner, world="point")

    @property
    def resets(self) -> list[int]:
        resets: list[int] = self.env._env.unwrapped.resets
        return resets


@pytest.mark.heavy
def test_one_reset_a_seed_and_the_same_seeds_play_the_same(run_async: Run) -> None:
    def play() -> Cell:
        one = Counted()
        cell: Cell = run_async(one.bench.run(PolicyContestant(policy_of(SEEK)), range(20, 25)))
        assert one.resets == [20, 21, 22, 23, 24]
        assert one.runner.tick_idx == 5 * (1 + 3)
        return cell

    first, second = play(), play()
    assert [(e.seed, e.success, e.steps) for e in first.episodes] == [
        (n, True, 3) for n in range(20, 25)
    ]
    assert [e.total_reward for e in first.episodes] == [e.total_reward for e in second.episodes]
    assert (first.complete, first.success_rate, first.errors) == (True, 1.0, 0)


@pytest.mark.heavy
def test_a_rate_paces_the_ticks_and_standing_is_counted(run_async: Run) -> None:
    """In real time a policy's latency costs what it costs on a robot."""
    from vram_arbiter.runner.protocols import ChunkStart, Hold
    from vram_arbiter.runner.sim.policies import PolicyPlayer

    class Thinks(PolicyPlayer):
        thought = 0

        def step(self, world: Any) -> Any:
            self.thought += 1
            if self.thought in (2, 3):
                return Hold("thinks", standing=True)
            outcome = super().step(world)
            return replace(outcome, chunk=ChunkStart(0.1, None)) if self.thought == 1 else outcome

    class Thinker(PolicyContestant):
        def player(self, env: Any, seed: int) -> Any:
            played = self._policy.play(env, seed)
            return Thinks(self.name, env, played._act)

    one, clock = Counted(), ManualClock()
    one.runner = sim_runner(
        lambda: one.env, rate_hz=20, ends_with_skill=True, max_steps=50, clock=clock
    )
    cell: Cell = run_async(
        Benchmark(one.runner, world="point").run(Thinker(policy_of(SEEK)), (20,))
    )
    (played,) = cell.episodes
    assert (played.success, played.standing_steps) == (True, 2)
    assert cell.summary()["mean_standing_steps"] == 2
    assert clock.slept == pytest.approx([1 / 20] * 5)  # two of standing, three of acting


@pytest.mark.heavy
def test_a_policy_with_a_defect_fails_and_one_that_gives_up_is_judged(run_async: Run) -> None:
    cell: Cell = run_async(Counted().bench.run(PolicyContestant(policy_of(SEEK)), (12, 13, 14)))
    assert [(e.success, e.error, e.steps) for e in cell.episodes] == [
        (True, "", 3),
        (False, "model_error", 0),
        (False, "", 1),
    ]
    assert cell.episodes[2].truncated
    assert (cell.judged, cell.successes, cell.errors) == (3, 1, 0)
    assert {e.trace_id for e in cell.episodes} == {None}


@pytest.mark.heavy
def test_an_episode_names_the_trace_that_it_is_in(run_async: Run) -> None:
    trace_id = "a" * 32
    with tracing.joined(f"00-{trace_id}-{'b' * 16}-01"):
        cell: Cell = run_async(Counted().bench.run(PolicyContestant(policy_of(SEEK)), (20,)))
    assert [e.trace_id for e in cell.episodes] == [trace_id]


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("least", "steps", "success"),
    [(-100, 0, False), (-100, 3, False), (-100, 6, True), (-1, 6, False)],
)
def test_who_leaves_before_it_costs_anything_has_not_succeeded(
    run_async: Run, least: int, steps: int, success: bool
) -> None:
    """Rewards of a pendulum are costs: whoever does nothing has the greatest return."""
    config = GymConfig(success=f"return:{least}")
    runner = sim_runner(
        lambda: GymEnv("Pendulum-v1", config, render=False),
        rate_hz=0,
        ends_with_skill=True,
        max_steps=5,
    )

    def make(env: Any, seed: int) -> Any:
        left = [[0.0]] * steps
        return lambda world: left.pop() if left else None

    cell: Cell = run_async(
        Benchmark(runner, world="pendulum").run(PolicyContestant(Policy("quits", make)), (0,))
    )
    assert [(e.success, e.steps, e.truncated) for e in cell.episodes] == [
        (success, min(steps, 5), True)
    ]


@pytest.mark.heavy
def test_nobody_judges_a_world_that_says_nothing(run_async: Run) -> None:
    cell: Cell = run_async(
        Counted(told=False).bench.run(PolicyContestant(policy_of(SEEK)), (12, 13))
    )
    assert [(e.success, e.error) for e in cell.episodes] == [(None, ""), (None, "model_error")]
    assert cell.summary()["success_rate"] is None
    assert (cell.judged, cell.errors) == (0, 1)


@pytest.mark.heavy
def test_an_environment_that_raises_is_no_verdict_and_no_phantom(run_async: Run) -> None:
    one = Counted(fails_at=1)
    cell: Cell = run_async(one.bench.run(PolicyContestant(policy_of("random")), range(9)))
    assert [(e.success, e.error) for e in cell.episodes] == [(None, "environment_failed")] * 3
    assert one.resets == [0, 1, 2]
    assert one.runner.robot.episodes == []
    assert (cell.complete, cell.errors) == (False, 3)
    assert "given up" in cell.why
    assert "ZeroDivisionError" in cell.why


class NotThere:
    """A contestant whose sidecar is not running."""

    name, revision = "test/absent", ""
    released = 0

    async def begin(self, goal: Any) -> None:
        raise SidecarUnavailable("nobody answers")

    def player(self, env: Any, seed: int) -> Any:
        raise AssertionError("it never began")

    async def finish(self) -> None: ...

    async def release(self) -> None:
        self.released += 1


@pytest.mark.heavy
def test_a_sidecar_that_is_not_there_is_given_up(run_async: Run) -> None:
    contestant = NotThere()
    cell: Cell = run_async(Counted().bench.run(contestant, range(100)))
    assert [e.error for e in cell.episodes] == ["sidecar_unavailable"] * 3
    assert (cell.complete, contestant.released) == (False, 1)


@pytest.mark.heavy
def test_stopping_within_an_episode_keeps_what_was_played(run_async: Run) -> None:
    one = Counted()

    async def scenario() -> Cell:
        loop = asyncio.get_running_loop()

        def make(env: Any, seed: int) -> Any:
            def act(world: Any) -> Any:
                if seed == 2:
                    loop.call_soon_threadsafe(one.bench.stop)
                return env.observation["agent_pos"][2:] if seed < 2 else (0.99, 0.99)

            return act

        return await one.bench.run(PolicyContestant(Policy("p", make)), range(100))

    cell: Cell = run_async(scenario())
    assert [(e.seed, e.success) for e in cell.episodes] == [
        (0, True),
        (1, True),
        *[(2, False)][: len(cell.episodes) - 2],
    ]
    assert (cell.complete, cell.why) == (False, "stopped")
    assert one.resets == [0, 1, 2]
    assert len(one.runner.robot.episodes) == len(cell.episodes)


@pytest.mark.heavy
def test_a_contestant_that_never_acts_does_not_play_for_ever(run_async: Run) -> None:
    from vram_arbiter.runner.protocols import Hold
    from vram_arbiter.runner.sim.policies import PolicyPlayer

    class Still(PolicyPlayer):
        def step(self, world: Any) -> Any:
            return Hold("thinking")

    class Thinker(PolicyContestant):
        def player(self, env: Any, seed: int) -> Any:
            return Still("thinker", env, lambda world: None)

    one = Counted()
    one.bench = Benchmark(one.runner, world="point", episode_s=0.05)
    cell: Cell = run_async(one.bench.run(Thinker(policy_of("random")), range(9)))
    assert [(e.success, e.error) for e in cell.episodes] == [(None, "limit_exceeded")] * 3


# -- the command
def report(out: Path) -> Any:
    return json.loads((out / "benchmark.json").read_text(encoding="utf-8"))


@pytest.mark.heavy
def test_worlds_contestants_and_seeds_make_a_report_a_table_and_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import imageio_ffmpeg

    flags = [
        "--policy",
        "random",
        "--policy",
        SEEK,
        "--episodes",
        "2",
        "--seed",
        "20",
        "--out",
        str(tmp_path),
    ]
    assert (
        main(["benchmark", "--env", POINT, "--env", "gym:Pendulum-v1", "--max-steps", "9", *flags])
        == 1
    )
    cells = report(tmp_path)["cells"]
    assert [(c["world"], c["contestant"], c["successes"], c["judged"]) for c in cells] == [
        (POINT, "random", 0, 2),
        (POINT, SEEK, 2, 2),
        ("gym:Pendulum-v1", "random", 0, 0),
        ("gym:Pendulum-v1", SEEK, 0, 0),
    ]
    assert cells[1]["interval_95"] == pytest.approx([0.3424, 1.0], abs=1e-4)
    assert (cells[0]["mean_steps"], cells[2]["mean_steps"]) == (9, 9)
    assert cells[2]["mean_reward"] < 0
    assert cells[3]["errors"] == 2  # its rows do not fit there
    for played in cells[0]["episodes"] + cells[1]["episodes"]:
        assert imageio_ffmpeg.count_frames_and_secs(played["video"])[0] == played["steps"] > 0
    table = capsys.readouterr().out
    assert "2/2 = 100%  34% to 100%" in table
    assert "not judged" in table


@pytest.mark.heavy
def test_a_skill_and_the_expert_in_our_own_scene(tmp_path: Path) -> None:
    common = ["benchmark", "--no-arbiter", "--no-videos", "--out", str(tmp_path)]
    assert main([*common, "--skill", "vram-arbiter/so101-navigate", "--episodes", "2"]) == 0
    (cell,) = report(tmp_path)["cells"]
    assert (cell["world"], cell["task"], cell["successes"], cell["judged"]) == (
        "so101",
        "navigate",
        2,
        2,
    )
    assert cell["revision"]
    assert all(played["steps"] > 10 and played["video"] is None for played in cell["episodes"])
    assert main([*common, "--policy", "expert", "--episodes", "1", "--max-steps", "150"]) == 0
    (cell,) = report(tmp_path)["cells"]
    assert (cell["task"], cell["success_rate"], cell["complete"]) == ("grab", 1.0, True)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "there are no contestants"),
        (["--policy", "clever"], "clever"),
        (["--skill", "nobody/nothing"], "nobody/nothing"),
        (["--skill", "vram-arbiter/so101-detector"], "cannot be executed"),
        (["--policy", "random", "--env", "gym:NoSuch-v0"], "NoSuch"),
        (["--policy", "random", "--task", "cook"], "cook"),
        (["--policy", "random", "--real-time", "--parallel", "2"], "--parallel 2"),
        (["--policy", "expert", "--env", "gym:CartPole-v1"], "expert"),
        (
            ["--policy", "random", "--env", "gym:A-v0", "--env", "gym:B-v0", "--success", "info:x"],
            "one after another",
        ),
        (["--policy", "random", "--env", "gym:CartPole-v1", "--task", "grab"], "--task"),
    ],
)
def test_mistakes_are_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    assert main(["benchmark", "--no-arbiter", "--out", str(tmp_path), *flags]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert len(told.splitlines()) == 1


@pytest.mark.heavy
def test_episodes_at_once_are_those_of_one_after_another(tmp_path: Path) -> None:
    """Five seeds in two worlds, both contestants; a policy that gives up keeps its own error."""

    def cells(*flags: str) -> list[list[tuple[Any, ...]]]:
        out = tmp_path / "-".join(["out", *flags])
        common = ["benchmark", "--env", POINT, "--max-steps", "9", "--no-videos", "--seed", "11"]
        policies = ["--policy", SEEK, "--policy", "random", "--episodes", "5", "--out", str(out)]
        assert main([*common, *policies, *flags]) == 0
        told = report(out)
        assert told["complete"]
        names = ("seed", "success", "steps", "total_reward", "error")
        return [[tuple(e[n] for n in names) for e in c["episodes"]] for c in told["cells"]]

    together = cells("--parallel", "2")
    assert together == cells()
    assert [seed for seed, *_ in together[0]] == [11, 12, 13, 14, 15]


def test_a_policy_with_a_memory_is_not_played_at_once() -> None:
    grab = load_manifest(ROOT / "configs/rskills/so101-grab/rskill.yaml")
    assert not remembers(grab)
    assert remembers(grab.model_copy(update={"model_family": ModelFamily.DIFFUSION}))
    assert remembers(grab.model_copy(update={"n_action_steps": 1}))  # it may be an ensemble's
    navigate = load_manifest(ROOT / "configs/rskills/so101-navigate/rskill.yaml")
    assert not remembers(navigate)  # it has no sidecar


@pytest.mark.heavy
@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_benchmark_is_made_as_lerobot_makes_it(name: str) -> None:
    """gym-aloha's own limit of 300 steps cut the 400 steps of an episode short."""
    configs = pytest.importorskip("lerobot.envs.configs", reason="needs the policy extra")
    preset = PRESETS[name]
    theirs = configs.PushtEnv() if name == "pusht" else configs.AlohaEnv()
    wanted = {key: given for key, given in theirs.gym_kwargs.items() if key != "render_mode"}
    assert wanted.items() <= preset.config.kwargs.items()
    assert (preset.max_steps, preset.control_hz) == (theirs.episode_length, theirs.fps)


@pytest.mark.heavy
@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_benchmark_of_the_field_plays_or_names_its_package(name: str, tmp_path: Path) -> None:
    preset = PRESETS[name]
    flags = ["--policy", "random", "--episodes", "1", "--max-steps", "2", "--no-videos"]
    argv = ["benchmark", "--env", name, *flags, "--out", str(tmp_path)]
    if importlib.util.find_spec(preset.module) is None:
        with pytest.raises(ConfigError, match=f"pip install {preset.package}"):
            preset_of(name)
        assert main(argv) == 2
        return
    assert main(argv) == 0
    (cell,) = report(tmp_path)["cells"]
    assert (cell["world"], cell["judged"], cell["max_steps"]) == (name, 1, 2)
    world = world_of(name)
    assert (world.max_steps, world.control_hz) == (preset.max_steps, preset.control_hz)
    assert world.joints == preset.config.actions


def test_libero_is_refused_with_its_package_and_a_way() -> None:
    with pytest.raises(ConfigError, match=r"package hf-libero.*lerobot-eval"):
        preset_of("libero:libero_10")


@pytest.mark.heavy
def test_a_skill_needs_a_license_that_allows_commercial_use(tmp_path: Path) -> None:
    """Regression: `benchmark` ran what `deploy` refuses."""
    grab = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    closed = grab.replace("apache-2.0", "nvidia_non_commercial")
    assert closed != grab
    (tmp_path / "rskill.yaml").write_text(closed, encoding="utf-8")
    parser = argparse.ArgumentParser()
    parser = add_parser(parser.add_subparsers())
    flags = ["--skills", str(tmp_path), "--skill", "vram-arbiter/so101-grab", "--no-videos"]
    with pytest.raises(UnknownSkill, match=r"license \(nvidia_non_commercial\)"):
        entries_of(parser.parse_args(flags), None)
    (entry,) = entries_of(parser.parse_args([*flags, "--allow-noncommercial"]), None)
    assert entry.name == "vram-arbiter/so101-grab"


@pytest.mark.heavy
def test_without_videos_a_skill_sees_what_it_saw_with_them() -> None:
    """Regression: `--no-videos` rendered nothing, so a skill that looks through `render` was
    refused."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    for flags, cameras in (
        (["--skill", "any"], ("top", "render")),
        (["--skill", "any", "--no-videos"], ("top", "render")),
        (
            ["--policy", "random", "--no-videos"],
            ("top",),
        ),  # it looks through no camera: nothing is rendered
    ):
        (world,) = worlds_of(parser.parse_args(["benchmark", "--env", POINT, *flags]))
        env = world.make()
        env.reset(0)
        assert env.cameras == cameras


def test_two_cells_of_one_name_do_not_overwrite_each_others_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: scenes of one file name in different folders shared their videos and their
    row.
    """
    scenes = [tmp_path / folder / "table.yaml" for folder in ("near", "far")]
    for scene in scenes:
        scene.parent.mkdir()
        scene.write_text("{}\n", encoding="utf-8")
    flags = [word for scene in scenes for word in ("--scene", str(scene))]
    out = tmp_path / "out"
    assert main(
        [
            "benchmark",
            "--no-arbiter",
            "--policy",
            "random",
            "--episodes",
            "1",
            "--max-steps",
            "1",
            *flags,
            "--out",
            str(out),
        ]
    ) in (1, 2)
    assert "would have one name" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.heavy
@pytest.mark.e2e
def test_a_signal_ends_it_with_a_report_of_what_was_played(tmp_path: Path) -> None:
    argv = [
        *(
            sys.executable,
            "-m",
            "vram_arbiter.runner",
            "benchmark",
            "--env",
            POINT,
            "--policy",
            SEEK,
            "--no-videos",
        ),
        *("--episodes", "1000000", "--out", str(tmp_path)),
    ]
    environ = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}:{HERE}"}
    process = subprocess.Popen(
        argv, cwd=ROOT, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        assert process.stderr is not None
        while b"seed 20:" not in (line := process.stderr.readline()):
            assert line, "it ended by itself"
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    assert process.returncode == 1
    assert b"not complete: stopped" in out
    written = report(tmp_path)
    assert (written["complete"], written["cells"][0]["complete"]) == (False, False)
    assert written["cells"][0]["played"] >= 21
