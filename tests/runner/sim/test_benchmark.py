"""`vram-runner benchmark`: rates with their interval, one reset a seed, errors that are no
verdicts, videos, recordings, and a report whatever happens.
"""

import argparse
import asyncio
import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.runner.conftest import KinematicEnv, world_of
from tests.runner.manual_clock import ManualClock
from tests.support import prepared
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.cli import lerobot_eval
from vram_arbiter.runner.cli.benchmark import add_parser, entries_of
from vram_arbiter.runner.cli.lerobot_eval import cells_of, checkpoint_of, flags_of, lease_of
from vram_arbiter.runner.protocols import ChunkStart, Hold
from vram_arbiter.runner.recording.reader import read_frame
from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, file_name, wilson
from vram_arbiter.runner.sim.config import SceneConfig
from vram_arbiter.runner.sim.policies import PolicySkill, policy_of
from vram_arbiter.runner.sim.robot import sim_runner
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable, UnknownSkill
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

HERE = Path(__file__).parents[1]
ROOT = HERE.parents[1]
LOST = f"scripted:{HERE}/lost.py"

Run = Callable[[Any], Any]


# -- the interval
@pytest.mark.heavy  # the interval is SciPy's
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


def test_nothing_played_has_no_rate() -> None:
    assert wilson(0, 0) is None
    assert Cell("w", "c", None).summary()["success_rate"] is None


def test_any_name_can_be_a_file() -> None:
    assert file_name("so101:a/b v0") == "so101-a-b-v0"
    assert file_name("../x") == "x"


# -- one cell
class Played:
    """A benchmark on the kinematic robot; an episode is a success in its third step."""

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
        self.bench = Benchmark(self.runner, world="table", **options)

    def policy(self, name: str) -> PolicySkill:
        return PolicySkill(name, policy_of(name), self.world)


@pytest.mark.heavy
def test_one_reset_a_seed_and_a_verdict_each(run_async: Run) -> None:
    one = Played()
    cell: Cell = run_async(one.bench.run(one.policy(LOST), range(20, 25)))
    assert [(e.seed, e.success, e.steps) for e in cell.episodes] == [
        (n, True, 3) for n in range(20, 25)
    ]
    assert one.env.resets == [20, 21, 22, 23, 24]
    assert one.runner.tick_idx == 5 * (1 + 3)
    summary = cell.summary()
    assert (summary["complete"], summary["success_rate"], summary["errors"]) == (True, 1.0, 0)


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
    cell: Cell = run_async(one.bench.run(Thinks("thinks", policy_of(LOST), one.world), (20,)))
    (played,) = cell.episodes
    assert (played.success, played.standing_steps) == (True, 1)
    assert clock.slept == pytest.approx([1 / 20] * 3)


@pytest.mark.heavy
def test_a_policy_with_a_defect_fails_and_one_that_gives_up_is_judged(run_async: Run) -> None:
    one = Played()
    cell: Cell = run_async(one.bench.run(one.policy(LOST), (12, 13, 14)))
    assert [(e.success, e.error, e.steps) for e in cell.episodes] == [
        (True, "", 3),
        (False, "model_error", 1),
        (False, "", 2),
    ]
    assert cell.episodes[2].truncated
    assert "IndexError: beyond the table" in cell.episodes[1].message
    summary = cell.summary()
    assert (summary["judged"], summary["successes"], summary["errors"]) == (3, 1, 0)
    assert {e.trace_id for e in cell.episodes} == {None}


def test_an_episode_names_the_trace_that_it_is_in(run_async: Run) -> None:
    trace_id, one = "a" * 32, Played()
    with tracing.joined(f"00-{trace_id}-{'b' * 16}-01"):
        cell: Cell = run_async(one.bench.run(one.policy(LOST), (20,)))
    assert [e.trace_id for e in cell.episodes] == [trace_id]


def test_an_environment_that_raises_is_no_verdict(run_async: Run) -> None:
    one = Played()
    one.env.fails = True
    cell: Cell = run_async(one.bench.run(one.policy("random"), range(9)))
    assert [(e.success, e.error) for e in cell.episodes] == [(None, "environment_failed")] * 3
    assert one.env.resets == [0, 1, 2]
    assert (cell.complete, cell.summary()["errors"]) == (False, 3)
    assert "given up" in cell.why
    assert "the physics blew up" in cell.why


def test_a_sidecar_that_is_not_there_is_given_up(run_async: Run) -> None:
    class NotThere(PolicySkill):
        released = 0

        async def start(self, goal: Any) -> None:
            raise SidecarUnavailable("nothing answers")

        async def release(self) -> None:
            self.released += 1

    one = Played()
    absent = NotThere("test/absent", policy_of("random"), one.world)
    cell: Cell = run_async(one.bench.run(absent, range(100)))
    assert [e.error for e in cell.episodes] == ["sidecar_unavailable"] * 3
    assert (cell.complete, absent.released) == (False, 1)


def test_stopping_within_an_episode_keeps_what_was_played(run_async: Run) -> None:
    one = Played()

    async def scenario() -> Cell:
        loop = asyncio.get_running_loop()

        def make(env: Any, seed: int) -> Any:
            def act(world: Any) -> Any:
                if seed == 2:
                    loop.call_soon_threadsafe(one.bench.stop)
                    return Hold  # not an action: the episode fails unless it is stopped before
                return dict(env.sent())

            return act

        return await one.bench.run(PolicySkill("p", make, one.world), range(100))

    cell: Cell = run_async(scenario())
    assert [(e.seed, e.success) for e in cell.episodes] == [
        (0, True),
        (1, True),
        *[(2, False)][: len(cell.episodes) - 2],
    ]
    assert (cell.complete, cell.why) == (False, "stopped")
    assert one.env.resets == [0, 1, 2]


def test_a_contestant_that_never_acts_does_not_play_for_ever(run_async: Run) -> None:
    class Still(PolicySkill):
        def step(self, world: Any) -> Any:
            return Hold("thinking")

    one = Played(episode_s=0.0)
    still = Still("still", policy_of("random"), one.world)
    cell: Cell = run_async(one.bench.run(still, range(9)))
    assert [(e.success, e.error) for e in cell.episodes] == [(None, "limit_exceeded")] * 3


# -- the command
def report(out: Path) -> Any:
    return json.loads((out / "benchmark.json").read_text(encoding="utf-8"))


@pytest.mark.heavy
def test_contestants_and_seeds_make_a_report_a_table_and_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import imageio_ffmpeg

    flags = ["--episodes", "2", "--seed", "12", "--max-steps", "9", "--out", str(tmp_path)]
    assert main(["benchmark", "--policy", "random", "--policy", LOST, *flags]) == 0
    cells = report(tmp_path)["cells"]
    assert [(c["world"], c["contestant"], c["successes"], c["judged"]) for c in cells] == [
        ("so101", "random", 0, 2),
        ("so101", LOST, 0, 2),
    ]
    assert [e["error"] for e in cells[1]["episodes"]] == ["", "model_error"]
    episodes = cells[0]["episodes"]
    assert [played["steps"] for played in episodes] == [9, 9]
    frames = [imageio_ffmpeg.count_frames_and_secs(played["video"])[0] for played in episodes]
    assert frames == [3, 4], "every third tick, counted on over resets"
    assert "0/2 = 0%  0% to 66%" in capsys.readouterr().out


@pytest.mark.heavy
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("forked_writers")
def test_the_expert_in_our_own_scene_is_recorded(tmp_path: Path) -> None:
    common = ["benchmark", "--no-arbiter", "--no-videos", "--out", str(tmp_path)]
    grabs = ["--policy", "expert", "--episodes", "1", "--max-steps", "150"]
    assert main([*common, *grabs, "--record", str(tmp_path / "set")]) == 0
    (cell,) = report(tmp_path)["cells"]
    assert (cell["task"], cell["success_rate"], cell["complete"]) == ("grab", 1.0, True)
    (played,) = cell["episodes"]
    last = read_frame(tmp_path / "set", played["steps"] - 1)
    assert (last.tick["success"], last.goal["skill"]) == (True, "expert")
    assert last.task.startswith("grab the ")
    assert main([*common, *grabs, "--policy", "random", "--record", str(tmp_path / "set")]) == 2


@pytest.mark.heavy
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("forked_writers")
def test_a_benchmark_ends_with_the_first_episode_that_is_not_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: all episodes were played for a dataset that took none of them."""
    scene, larger = tmp_path / "scene.yaml", SceneConfig().model_dump(mode="json")
    larger["cameras"]["wrist"]["width_px"] = 161  # no video has it
    scene.write_text(json.dumps(larger), encoding="utf-8")
    flags = ["--scene", str(scene), "--max-steps", "2", "--episodes", "1000000", "--no-videos"]
    recorded = ["--record", str(tmp_path / "set"), "--out", str(tmp_path)]
    assert main(["benchmark", "--policy", "random", *flags, *recorded]) == 2
    assert "a video needs even numbers" in capsys.readouterr().err


@pytest.mark.heavy
def test_a_skill_in_our_own_scene(tmp_path: Path) -> None:
    common = ["benchmark", "--no-arbiter", "--no-videos", "--out", str(tmp_path)]
    assert main([*common, "--skill", "vram-arbiter/so101-navigate", "--episodes", "2"]) == 0
    (cell,) = report(tmp_path)["cells"]
    told = (cell["world"], cell["task"], cell["successes"], cell["judged"])
    assert told == ("so101", "navigate", 2, 2)
    assert cell["revision"]
    assert all(played["steps"] > 10 and played["video"] is None for played in cell["episodes"])


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "expected --skill RSKILL or --policy NAME"),
        (["--policy", "clever"], "clever"),
        (["--policy", "scripted:no_such_module"], "no_such_module"),
        (["--policy", "scripted:none.py"], "none.py"),
        (["--policy", "scripted:json"], "make(env, seed)"),
        (["--skill", "nobody/nothing"], "nobody/nothing"),
        (["--skill", "vram-arbiter/so101-detector"], "cannot be executed"),
        (["--policy", "random", "--task", "cook"], "cook"),
        (["--policy", "expert", "--task", "navigate"], "expert"),
        (["--policy", "random", "--env", "pusht"], "give --skill"),
        (["--skill", "vram-arbiter/so101-navigate", "--env", "pusht"], "no policy of that name"),
        pytest.param(
            ["--skill", "vram-arbiter/so101-grab", "--env", "libero"],
            "in an environment of its own",
            marks=pytest.mark.skipif(find_spec("libero") is not None, reason="LIBERO is here"),
        ),
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
@pytest.mark.parametrize(
    "argv",
    [
        ["sim", "--rate", "0", "--no-arbiter", "--timings", "{}/t.jsonl"],
        ["sim", "--rate", "0", "--no-arbiter", "--video", "{}/v.mp4"],
        ["benchmark", "--episodes", "1", "--max-steps", "1", "--policy", "random", "--out", "{}"],
    ],
)
def test_a_file_that_cannot_be_written_is_said_in_one_line_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str]
) -> None:
    """Regression: output paths were checked when they were written, after hours of running."""
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    words = [word.format(tmp_path / "file") for word in argv]
    there = ["--endpoint", f"ipc://{tmp_path}/r.sock"] if argv[0] == "sim" else []
    assert main([*words, *there]) in (1, 2)
    out, said = capsys.readouterr()
    assert out == ""
    assert "cannot be written" in said
    assert "Traceback" not in said


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
    argv = ["benchmark", "--no-arbiter", "--policy", "random", *flags, "--out", str(out)]
    assert main(argv) == 2
    assert "would have one name" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.heavy
@pytest.mark.e2e
def test_a_signal_ends_it_with_a_report_of_what_was_played(tmp_path: Path) -> None:
    argv = [
        *("benchmark", "--policy", "random", "--no-videos", "--max-steps", "2"),
        *("--episodes", "1000000", "--out", str(tmp_path)),
    ]
    said, says = os.pipe()
    with (tmp_path / "printed").open("wb") as printed:
        process = prepared.start("vram-runner", argv, os.environ, printed.fileno(), says, cwd=ROOT)
    os.close(says)
    try:
        with open(said) as errors:
            while "seed 3:" not in (line := errors.readline()):
                assert line, "it ended by itself"
            process.terminate()
            errors.read()
        assert process.wait(60) == 1
    finally:
        process.kill()
    assert "not complete: stopped" in (tmp_path / "printed").read_text()
    written = report(tmp_path)
    assert (written["complete"], written["cells"][0]["complete"]) == (False, False)
    assert written["cells"][0]["played"] >= 4


# -- environments of lerobot
def grab_of(folder: Path, weights: str) -> Path:
    """Write the shipped grab's manifest with other weights."""
    grab = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    manifest = folder / "rskill.yaml"
    manifest.write_text(grab.replace("local://models/so101-grab", weights), encoding="utf-8")
    return manifest


@pytest.fixture
def pinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of `hf://lab/point@v1` in an offline cache of the hub, still empty."""
    constants = pytest.importorskip("huggingface_hub.constants")
    cached, commit = tmp_path / "hub/models--lab--point", "0123456789" * 4
    folder = cached / "snapshots" / commit
    folder.mkdir(parents=True)
    (cached / "refs").mkdir()
    (cached / "refs/v1").write_text(commit, encoding="utf-8")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    return folder


def test_a_pinned_checkpoint_is_played_from_its_own_folder(tmp_path: Path, pinned: Path) -> None:
    """Regression: lerobot-eval was given the revision as a flag, and read configuration and
    processors of the newest one.
    """
    (pinned / "config.json").write_text("{}", encoding="utf-8")
    played = load_manifest(grab_of(tmp_path, "hf://lab/point@v1"))
    assert Path(checkpoint_of(played)) == pinned
    newest = load_manifest(grab_of(tmp_path, "hf://lab/point"))
    assert checkpoint_of(newest) == "lab/point"


@pytest.mark.heavy
@pytest.mark.nightly  # its program imports torch and lerobot once more
@pytest.mark.timeout(600)
def test_lerobot_eval_plays_a_checkpoint_in_an_environment_of_lerobot(
    tmp_path: Path, pinned: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """lerobot's own program, with an environment and a small policy that it knows by a plugin."""
    pytest.importorskip("lerobot.policies", reason="needs the sidecars extra")
    make_point_policy(pinned)
    manifest = grab_of(tmp_path, "hf://lab/point@v1")
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}/src:{ROOT}")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # lerobot leaves a file there
    argv = [
        *("benchmark", "--env", "point", "--skill", "vram-arbiter/so101-grab", "--no-arbiter"),
        *("--skills", str(manifest), "--episodes", "2", "--out", str(tmp_path / "out"), "--"),
        *("--env.discover_packages_path=tests.runner.point_world", "--policy.device=cpu"),
        *("--eval.batch_size=1", "--eval.use_async_envs=false"),
    ]
    code = main(argv)
    out, said = capfd.readouterr()
    assert code == 0, said[-3000:]
    (cell,) = report(tmp_path / "out")["cells"]
    assert (cell["world"], cell["judged"], cell["complete"]) == ("point", 2, True)
    assert "/2 = " in out


def make_point_policy(folder: Path) -> None:
    """Save an untrained policy of two joints and no cameras."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    two = (2,)
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, two),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, two),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, two)},
        device="cpu", dim_model=32, n_heads=2, dim_feedforward=32, n_encoder_layers=1,
        use_vae=False, chunk_size=4, n_action_steps=4, pretrained_backbone_weights=None,
    )  # fmt: skip
    ACTPolicy(config).save_pretrained(folder)
    before, after = make_pre_post_processors(config, dataset_stats={})
    before.save_pretrained(folder)
    after.save_pretrained(folder)


def lerobot_args(*more: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser = add_parser(parser.add_subparsers())
    return parser.parse_args(["--env", "libero", "--seed", "7", *more])


def test_lerobot_eval_runs_under_a_lease_of_the_unquantized_bytes(tmp_path: Path) -> None:
    """Regression: the lease had the bytes of the quantized weights; lerobot-eval loads the
    checkpoint as it is.
    """
    libero = load_manifest(ROOT / "configs/rskills/libero-pi05-nf4/rskill.yaml")
    args = lerobot_args("--", "--env.task=libero_10")
    flags = flags_of("lerobot/pi05", args, tmp_path / "out")
    assert flags[0] == "--policy.path=lerobot/pi05"
    assert {"--env.type=libero", "--seed=7", "--env.task=libero_10"} <= set(flags)
    sizes = {Dtype.INT4: 4.0, Dtype.BF16: 9.0, Dtype.FP32: 17.5}
    lease = lease_of(libero.model_copy(update={"min_vram_gb": sizes}), args)
    assert lease[-5:-3] == ["--vram", "17.5GB"]
    assert lease[-1] == "--"
    assert os.path.exists(lease[0])
    with pytest.raises(ConfigError, match="does not declare min_vram_gb of fp32, fp16 or bf16"):
        lease_of(libero.model_copy(update={"min_vram_gb": {Dtype.INT4: 4.0}}), args)


def test_each_task_of_lerobots_environment_is_a_cell_with_the_same_seeds(tmp_path: Path) -> None:
    """Regression: the seeds were counted on through all tasks, whose rates were one."""
    libero = load_manifest(ROOT / "configs/rskills/libero-pi05-nf4/rskill.yaml")
    told = [
        {"task_group": "libero_10", "task_id": n, "metrics": {"successes": [True, n == 1]}}
        for n in range(2)
    ]
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": told}), encoding="utf-8")
    cells = cells_of(libero, lerobot_args(), tmp_path, 0)
    played = [(c.task, c.complete, [(e.seed, e.success) for e in c.episodes]) for c in cells]
    assert played == [
        ("libero_10/0", True, [(7, True), (8, False)]),
        ("libero_10/1", True, [(7, True), (8, True)]),
    ]
    (cell,) = cells_of(libero, lerobot_args(), tmp_path / "none", 1)
    assert (cell.complete, cell.why) == (False, "lerobot-eval ended with 1")


def eval_stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> list[str]:
    """Put a program in the place of lerobot-eval; return the command that starts it by main()."""
    program = folder / "lerobot-eval"
    program.write_text(f"#!{sys.executable}\n{code}\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setattr(lerobot_eval.shutil, "which", lambda name, path: str(program))
    manifest = grab_of(folder, "local://models/so101-grab")
    return [
        *("benchmark", "--env", "point", "--skill", "vram-arbiter/so101-grab", "--no-arbiter"),
        *("--skills", str(manifest), "--out", str(folder / "out")),
    ]


def test_the_result_of_an_earlier_run_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: a run that ended without a result had the rates of the one before."""
    argv = eval_stand_in(tmp_path, monkeypatch, "")
    earlier = tmp_path / "out/point_vram-arbiter-so101-grab/eval_info.json"
    earlier.parent.mkdir(parents=True)
    told = {"task_group": "point", "task_id": 0, "metrics": {"successes": [True]}}
    earlier.write_text(json.dumps({"per_task": [told]}), encoding="utf-8")
    assert main(argv) == 1
    (cell,) = report(tmp_path / "out")["cells"]
    assert (cell["played"], cell["complete"]) == (0, False)


def test_a_signal_ends_lerobot_eval_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: lerobot-eval went on, with its GPU memory, when the runner was told to end."""
    argv = eval_stand_in(
        tmp_path,
        monkeypatch,
        "import os, signal, time; os.kill(os.getppid(), signal.SIGTERM); time.sleep(600)",
    )
    assert main(argv) == 1
    (cell,) = report(tmp_path / "out")["cells"]
    assert cell["why"] == f"lerobot-eval ended with {-signal.SIGTERM}"
