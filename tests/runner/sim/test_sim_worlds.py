"""`vram-runner sim --env …`: policies that play by themselves, and goals with a served policy, in
gymnasium environments and our own scene.
"""

import asyncio
import json
import os
from pathlib import Path
from typing import Any

import pytest

from tests.support.prepared import start, warm
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.recording.reader import read_frame
from vram_arbiter.schemas.errors import UnknownSkill
from vram_arbiter.schemas.plain import Message

pytestmark = pytest.mark.heavy

HERE = Path(__file__).parents[1]
ROOT = HERE.parents[1]
POINT = "gym:tests.runner.gym_worlds:test/Point-v0"
MANIFEST = """
name: "test/point-seek"
version: "1.0.0"
license: mit
kind: vla
model_family: act
embodiment_tags: [custom]
embodiment_extra:
  sensors: [{modality: rgb, count: 1}]
  actuators: [{kind: joint_position, n_dof: 2, control_mode_semantics: {mode: absolute}}]
sensors_required:
  - {modality: rgb, vla_feature_key: observation.images.front}
actuators_required:
  - {kind: joint_position, n_dof: 2, vla_action_key: action,
     control_mode_semantics: {mode: absolute}}
weights_uri: "local://models/none"
chunk_size: 3
latency_budget: {per_chunk_ms: 100.0, max_execution_s: 20.0}
min_vram_gb: {fp32: 1.0}
description: "A policy of this test."
actions: [reach]
action_contract: {dim: 2}
policy_extras: {rollout_steps: 600, stop_when_still: false}
"""
WORLD = """
kwargs: {mark: [0.25, -0.5], width: 34}
state: agent_pos
joints: [a, b]
actions: [a, b]
cameras: {front: pixels.top}
"""


def sim(tmp_path: Path, capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[int, Any, str]:
    """Exit code, result and what was said."""
    code = main(["sim", "--endpoint", f"ipc://{tmp_path}/r.sock", "--rate", "0", *flags])
    out, said = capsys.readouterr()
    return code, json.loads(out.splitlines()[-1]) if out else None, said


# -- policies by themselves
def test_a_scripted_policy_balances_gymnasiums_pole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = f"scripted:{HERE}/balance.py"
    flags = ("--episodes", "2", "--max-steps", "120", "--success", "return:120")
    code, result, _ = sim(tmp_path, capsys, "--env", "gym:CartPole-v1", "--policy", script, *flags)
    assert (code, result["success"], result["n_ticks"]) == (0, True, 2 * 121)
    assert result["metadata"]["episodes"] == 2
    code, result, _ = sim(
        tmp_path, capsys, "--env", "gym:CartPole-v1", "--policy", "random", *flags
    )
    assert (code, result["success"]) == (0, False)


def test_the_video_of_gymnasiums_pole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import imageio_ffmpeg

    pytest.importorskip("pygame", reason="needs the runner extra")
    video = tmp_path / "pole.mp4"
    flags = ("--policy", "random", "--max-steps", "20", "--video", str(video))
    code, result, _ = sim(tmp_path, capsys, "--env", "gym:CartPole-v1", *flags)
    assert code == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(video))[0] == result["n_ticks"] - 1


def test_random_actions_in_our_own_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, result, _ = sim(tmp_path, capsys, "--policy", "random", "--max-steps", "5")
    assert (code, result["n_ticks"], result["success"]) == (0, 6, None)
    assert result["metadata"]["withheld"] == 0


def test_a_policy_with_a_defect_ends_the_run_and_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = (
        "--env",
        POINT,
        "--policy",
        f"scripted:{HERE}/seek.py",
        "--seed",
        "12",
        "--episodes",
        "5",
    )
    code, result, said = sim(tmp_path, capsys, *flags)
    assert (code, result["metadata"]["episodes"]) == (1, 2)  # the second is the one that failed
    assert said.splitlines()[-1].endswith("seek.py: IndexError: beyond the mark")
    assert "Traceback" not in said


def test_an_environment_that_fails_ends_the_run_and_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = tmp_path / "world.yaml"
    world.write_text("kwargs: {fails_at: 1}\n", encoding="utf-8")
    code, result, said = sim(
        tmp_path, capsys, "--env", POINT, "--env-config", str(world), "--policy", "random"
    )
    assert (code, result["metadata"]["episodes"]) == (1, 0)
    assert "ZeroDivisionError: the physics blew up" in said.splitlines()[-1]


def test_the_video_of_an_environment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import imageio_ffmpeg

    video = tmp_path / "point.mp4"
    flags = ("--policy", f"scripted:{HERE}/seek.py", "--video", str(video))
    code, result, _ = sim(tmp_path, capsys, "--env", POINT, *flags)
    assert (code, result["success"]) == (0, True)
    assert imageio_ffmpeg.count_frames_and_secs(str(video))[0] == result["n_ticks"] - 1


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--env", "gym:"], "unknown --env"),
        (["--env", "mujoco"], "unknown --env"),
        (["--env", "gym:NoSuch-v0", "--policy", "random"], "NoSuch"),
        (["--env", "gym:CartPole-v1", "--scene", "x.yaml"], "--scene"),
        (["--env-config", "x.yaml"], "--env-config"),
        (["--env", "gym:CartPole-v1", "--success", "maybe"], "--success maybe"),
        (["--policy", "clever"], "clever"),
        (["--policy", "scripted:no_such_module"], "no_such_module"),
        (["--policy", "scripted:none.py"], "none.py"),
        (["--policy", "scripted:json"], "make(env, seed)"),
        (["--episodes", "2"], "--policy"),
    ],
)
def test_mistakes_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    code, _, told = sim(tmp_path, capsys, "--no-arbiter", *flags)
    assert code == 2
    assert said in told
    assert len(told.splitlines()) == 1


# -- goals
class Sidecar:
    """A served policy that always aims at the same place."""

    def __init__(self) -> None:
        self.aim = (0.25, -0.5)
        self.observations: list[Any] = []
        self.calls: list[str] = []

    async def serve(self, endpoint: str) -> None:
        async with RouterServer(
            endpoint, lambda error: {"ok": False, "error": str(error)}
        ) as self.server:
            await self.server.serve(self.answer)

    async def answer(self, peer: Peer, message: Message) -> None:
        import numpy as np

        reply: Message = {"ok": True, "re": message.get("id")}
        self.calls.append(message["endpoint"])
        if message["endpoint"] == "load":
            reply |= {"lease_id": None, "token": None, "loaded": True}
        elif message["endpoint"] == "get_action":
            self.observations.append(npy.unpack(message["data"]["observation"]))
            reply = {
                "action": npy.pack(np.array([self.aim] * 3, dtype=np.float32)),
                "re": message.get("id"),
            }
        await self.server.send(peer, reply)


@pytest.mark.e2e
def test_goals_play_episodes_of_a_gymnasium_environment(tmp_path: Path) -> None:
    (tmp_path / "world.yaml").write_text(WORLD, encoding="utf-8")
    (tmp_path / "rskill.yaml").write_text(MANIFEST, encoding="utf-8")
    closed = MANIFEST.replace("mit", "nvidia_non_commercial").replace("/point", "/closed")
    (tmp_path / "closed.yaml").write_text(closed, encoding="utf-8")
    argv = [
        *("sim", "--env", POINT, "--env-config", str(tmp_path / "world.yaml")),
        *("--skills", str(tmp_path / "rskill.yaml"), str(tmp_path / "closed.yaml")),
        *("--no-arbiter", "--rate", "0"),
        *(
            "--sidecar",
            f"test/point-seek=ipc://{tmp_path}/policy.sock",
            "--record",
            str(tmp_path / "set"),
        ),
    ]
    environ = os.environ | {
        "VRAM_ARBITER_RUNTIME": str(tmp_path),
        "OMP_NUM_THREADS": "1",
    }
    warm("dataset-writer")
    process = start("vram-runner", argv, environ, cwd=ROOT)

    async def scenario() -> None:
        sidecar = Sidecar()
        serving = asyncio.create_task(sidecar.serve(f"ipc://{tmp_path}/policy.sock"))
        async with (
            asyncio.timeout(120),
            RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=60.0) as client,
        ):
            assert (await client.call("ping"))["robot"] == POINT
            frame = await client.call("frame", {"encoding": "png", "max_age_ms": 60_000.0})
            assert (frame["camera"], frame["width"], frame["height"]) == ("front", 34, 24)
            goal = await client.send_goal("test/point-seek", prompt="go there")
            result = await goal.result(60)
            assert (result["status"], result["data"]["success"], result["data"]["steps"]) == (
                "succeeded",
                True,
                1,
            )
            assert sidecar.observations[0]["observation.state"].tolist() == [0.0, 0.0]
            assert sidecar.observations[0]["observation.images.front"].shape == (24, 34, 3)
            sidecar.aim = (0.9, 0.9)
            result = await (await client.send_goal("test/point-seek", prompt="go there")).result(60)
            assert (result["status"], result["code"]) == ("failed", "limit_exceeded")
            assert (
                result["data"]["success"],
                result["data"]["steps"],
                result["data"]["episode"],
            ) == (
                False,
                20,
                1,
            )
            with pytest.raises(UnknownSkill):
                await client.send_goal("vram-arbiter/so101-grab", prompt="grab")
            with pytest.raises(UnknownSkill, match="--allow-noncommercial"):
                await client.send_goal("test/closed-seek", prompt="go there")
            await client.call("shutdown")
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    try:
        asyncio.run(scenario())
        out, _ = process.communicate(timeout=60)
        result = json.loads(out.splitlines()[-1])
        assert process.returncode == 0
        assert (result["success"], result["metadata"]["episodes"]) == (False, 2)
        told = result["metadata"]["recorded"]
        assert (told["episodes"], told["frames"], told["skipped"]) == (
            1,
            20,
            1,
        )  # one step is no episode
        second = read_frame(tmp_path / "set", 1)
        assert (second.goal["code"], second.task) == ("limit_exceeded", "go there")
        assert second.state == second.action == pytest.approx({"a": 0.9, "b": 0.9})
        assert list(second.pictures) == ["front"]
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


# -- benchmarks of a served policy
def test_a_served_policy_is_started_anew_for_every_seed_and_released(
    tmp_path: Path, run_async: Any
) -> None:
    from vram_arbiter.runner.sim.benchmark import Benchmark, SkillContestant
    from vram_arbiter.runner.sim.robot import sim_runner
    from vram_arbiter.runner.sim.worlds import makers_of, world_of
    from vram_arbiter.schemas.manifest import Kind, parse_manifest

    (tmp_path / "world.yaml").write_text(WORLD, encoding="utf-8")
    endpoint = f"ipc://{tmp_path}/policy.sock"
    world = world_of(POINT, env_config=tmp_path / "world.yaml", render=False)
    makers = makers_of(world, {"test/point-seek": endpoint}, None, period_s=1 / 30, wait_s=60.0)
    manifest = parse_manifest(MANIFEST + 'default_prompt: "go there"\n')
    runner = sim_runner(world.make, rate_hz=0, ends_with_skill=True)

    async def scenario() -> None:
        sidecar = Sidecar()
        serving = asyncio.create_task(sidecar.serve(endpoint))
        bench = Benchmark(runner, world=world.name)
        cell = await bench.run(SkillContestant(makers[Kind.VLA](manifest)), range(3))
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        assert [(e.seed, e.success, e.steps, e.error) for e in cell.episodes] == [
            (seed, True, 1, "") for seed in range(3)
        ]
        assert cell.summary()["revision"] == "1.0.0"
        assert [call for call in sidecar.calls if call != "ping"] == [
            "load",
            "reset",
            "get_action",
        ] * 3 + ["unload"]

    run_async(scenario())


@pytest.mark.parametrize(
    "argv",
    [
        ["sim", "--rate", "0", "--max-steps", "1", "--timings", "{}/t.jsonl"],
        ["sim", "--rate", "0", "--max-steps", "1", "--video", "{}/v.mp4"],
        ["benchmark", "--episodes", "1", "--max-steps", "1", "--out", "{}"],
    ],
)
def test_a_file_that_cannot_be_written_is_said_in_one_line_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str]
) -> None:
    """Regression: output paths were checked when they were written, after hours of running."""
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    words = [word.format(tmp_path / "file") for word in argv]
    assert main([*words, "--env", "gym:CartPole-v1", "--policy", "random"]) in (1, 2)
    out, said = capsys.readouterr()
    assert out == ""
    assert "cannot be written" in said
    assert "Traceback" not in said
