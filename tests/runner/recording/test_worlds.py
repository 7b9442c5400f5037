"""`vram-runner sim --record` in any world: what it showed and what it was sent, by name, frame by
frame; by policies and for goals.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.support.prepared import run
from vram_arbiter.runner import __main__ as program
from vram_arbiter.runner.recording import commit

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.e2e,
    pytest.mark.timeout(600),
    pytest.mark.usefixtures("forked_writers"),
]

ROOT = Path(__file__).parents[3]
HAND = "tests.runner.gym_worlds:test/Hand-v0"
POINT = "tests.runner.gym_worlds:test/Point-v0"
SEED = 5
TASK = "close the hand"
DEAF = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}  # spans are made; nobody takes them
WAIT_S = 280.0
ACTIONS = ["arm.0", "arm.1", "gripper", "lamps.0", "lamps.1", "walk.0.0", "walk.0.1", "walk.1"]
SHOWN = ["arm.0", "arm.1", "gripper", "views.1.0", "views.1.1"]


def record(
    root: Path, runtime: Path, *flags: str, **environ: str
) -> subprocess.CompletedProcess[str]:
    """One run of a policy, as fast as it can."""
    given = {
        "VRAM_ARBITER_RUNTIME": str(runtime),
        "OMP_NUM_THREADS": "1",
    }
    flags = ("sim", "--record", str(root), "--rate", "0", *flags)
    return run("vram-runner", flags, os.environ | given | environ, WAIT_S, cwd=ROOT)


@pytest.fixture(scope="module")
def recorded_world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Three episodes of random actions in a world whose actions and observations have parts of all
    kinds; and the run's result.
    """
    folder = tmp_path_factory.mktemp("worlds")
    (folder / "hand.yaml").write_text(f"instruction: {TASK}\n")
    flags = ("--env", f"gym:{HAND}", "--policy", "random", "--episodes", "3", "--seed", str(SEED))
    flags += ("--env-config", str(folder / "hand.yaml"))
    ran = record(folder / "set", folder, *flags, **DEAF)
    assert ran.returncode == 0, ran.stderr
    return folder / "set", json.loads(ran.stdout.splitlines()[-1])


def played(seed: int) -> list[tuple[dict[str, float], dict[str, float], float]]:
    """The same episode once more: what was shown, what was sent, what it was worth."""
    from vram_arbiter.runner.sim.gym_env import GymEnv

    env = GymEnv(HAND, render=False)
    env.reset(seed)
    rows = []
    while True:
        shown, step = env.shown(), env.step(env.sample())
        rows.append((shown, env.acted, step.reward or 0.0))
        if step.terminated or step.truncated:
            return rows


def test_lerobot_reads_what_the_world_showed_and_was_sent(
    recorded_world: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    root, result = recorded_world
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets
    from lerobot.datasets import LeRobotDataset

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path)
    dataset = LeRobotDataset("local/recording", root=root, video_backend="pyav")
    episodes = [played(SEED + index) for index in range(3)]
    frames = sum(map(len, episodes))
    assert (dataset.num_episodes, len(dataset), dataset.meta.robot_type) == (
        3,
        frames,
        f"gym:{HAND}",
    )
    features = dataset.meta.features
    assert (features["observation.state"]["names"], features["action"]["names"]) == (SHOWN, ACTIONS)
    assert {name: tuple(features[name]["shape"]) for name in dataset.meta.camera_keys} == {
        "observation.images.views.0": (16, 16, 3),
        "observation.images.render": (20, 24, 3),
    }
    spans = set()
    expected = [(index, *row) for episode in episodes for index, row in enumerate(episode)]
    for row, (index, shown, sent, reward) in zip(
        map(dataset.__getitem__, range(frames)), expected, strict=True
    ):
        assert row["observation.state"].tolist() == pytest.approx([shown[name] for name in SHOWN])
        assert row["action"].tolist() == pytest.approx([sent[name] for name in ACTIONS])
        assert float(row["next.reward"]) == pytest.approx(reward)
        assert float(row["observation.images.views.0"].mean()) * 255 == pytest.approx(
            20 * (index + 1), abs=4
        )
        assert float(row["observation.images.render"].mean()) * 255 == pytest.approx(
            10 * (index + 1), abs=4
        )
        assert row["task"] == TASK, "a policy that reads words would learn the other one's name"
        spans.add((row["trace_id"], row["span_id"]))
    assert len(spans) == frames
    assert all(trace_id and span_id for trace_id, span_id in spans)
    traces = [str(dataset[sum(map(len, episodes[:index]))]["trace_id"]) for index in range(3)]
    assert len(set(traces)) == 3  # an episode, a trace
    assert {trace_id for trace_id, _ in spans} == set(traces)
    assert traces[0] == result["trace_id"]
    assert [(note["goal_id"], note["frames"], note["units"]) for note in commit.notes(root)] == [
        (f"seed-{SEED + index}", len(episode), "own") for index, episode in enumerate(episodes)
    ]
    told = {
        "episodes": 3,
        "frames": frames,
        "discarded": 0,
        "skipped": 0,
        "dropped": 0,
        "left_out": 0,
        "error": None,
    }
    assert (result["save_dir"], result["metadata"]["recorded"]) == (str(root), told)


def test_a_frame_of_a_world_leads_back_to_its_tick(
    recorded_world: tuple[Path, dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    root, _ = recorded_world
    shown, sent, _ = played(SEED + 1)[1]
    argv = ["replay", "--dataset", str(root), "--episode", "1", "--frame", "1"]
    assert program.main([*argv, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (_, about, _) = commit.notes(root)
    assert (found["goal"]["goal_id"], found["trace_id"]) == (f"seed-{SEED + 1}", about["trace_id"])
    assert len(found["span_id"]) == 16
    assert (found["units"], found["state"], found["action"]) == (
        "own",
        pytest.approx(shown),
        pytest.approx(sent),
    )
    assert program.main(argv) == 0
    out = capsys.readouterr().out
    assert f"shown    arm.0: {shown['arm.0']:+.4g}" in out
    assert f"sent     walk.1: {sent['walk.1']:+.4g}" in out
    assert "rad" not in out.replace("random", "")


def test_a_run_for_a_recording_that_is_impossible_fails(tmp_path: Path) -> None:
    root = tmp_path / "set"
    ran = record(
        root, tmp_path, "--env", f"gym:{POINT}", "--policy", "random"
    )  # its pictures are 33 × 24
    assert ran.returncode == 2
    assert (
        "camera top gives 33 × 24 pixels; a video needs even numbers" in ran.stderr.splitlines()[-1]
    )
    assert commit.notes(root) == []
