"""`vram-runner sim --record` and `deploy` with `save_dir`, as processes: goals become episodes,
also the one that the runner was killed in.
"""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.support.prepared import Forked, start
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.reader import read_frame

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.e2e,
    pytest.mark.timeout(600),
    pytest.mark.usefixtures("forked_writers"),
]

RSKILL = "vram-arbiter/so101-navigate"
TRACE = "0af7651916cd43dd8448eb211c80319c"
SPAN = "b7ad6b7169203331"
DEAF = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}  # spans are made; nobody takes them
WAIT_S = 280.0

type Started = Forked | subprocess.Popen[bytes]
type Start = Callable[..., Started]


@pytest.fixture
def start_recording(tmp_path: Path, programs: list[Started]) -> Start:
    def begin(program: str, *argv: str, afresh: bool = False, **environ: str) -> Started:
        given = (
            os.environ | {"VRAM_ARBITER_RUNTIME": str(tmp_path), "OMP_NUM_THREADS": "1"} | environ
        )
        skills = ("--skills", str(ROOT / "configs/rskills/so101-navigate"), "--no-arbiter")
        words = [*argv, *skills]
        if afresh:
            command = [sys.executable, "-m", "vram_arbiter.runner", *words]
            programs.append(subprocess.Popen(command, cwd=tmp_path, env=given))
        else:
            programs.append(start(program, words, given, cwd=tmp_path))
        return programs[-1]

    return begin


@pytest.mark.nightly  # each step of a crash is in test_commit
def test_the_episode_of_a_killed_simulator_is_finished_by_its_writer(
    start_recording: Start, tmp_path: Path
) -> None:
    root = tmp_path / "set"
    process = start_recording(
        "vram-runner", "sim", "--record", str(root), "--rate", "0", afresh=True, **DEAF
    )

    async def use() -> None:
        async with (
            asyncio.timeout(WAIT_S),
            RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=WAIT_S) as client,
        ):
            # it is killed on its way
            far = {"header": {"frame_id": "map"}, "pose": {"position": {"x": -50.0, "y": 0.0}}}
            goal = await client.send_goal(
                RSKILL, goal_params={"pose": far}, traceparent=f"00-{TRACE}-{SPAN}-01"
            )
            async for feedback in goal.feedback():
                if feedback["tick_idx"] >= 30 and (root / commit.FOLDER / commit.OPEN).exists():
                    marked = await client.mark("failure")
                    assert (marked["goal_id"], marked["episode"]) == (goal.goal_id, None)
                    process.kill()
                    return

    asyncio.run(use())
    process.wait(WAIT_S)
    with commit.locked(root, WAIT_S):  # until the writer is done
        pass
    (note,) = commit.notes(root)
    assert (note["status"], note["marked"]) == ("runner_lost", "failure")
    assert note["frames"] >= 2
    last = read_frame(root, note["frames"] - 1)
    assert last.tick["done"]
    assert last.tick["success"] is None  # no world judged
    assert (last.trace_id, last.robot, sorted(last.pictures)) == (
        TRACE,
        "so101-mobile",
        ["front", "wrist"],
    )
    looked_at = min(note["frames"], 10)
    spans = {read_frame(root, index).span_id for index in range(looked_at)}
    assert len(spans) == looked_at  # each tick its own, none the caller's
    assert SPAN not in spans
    assert any(abs(speed) > 0 for speed in last.base["velocity"].values())
    assert sorted(last.action) == sorted(last.state)
    assert commit.repair(root) == []


def test_a_deployment_records_into_its_save_dir(start_recording: Start, tmp_path: Path) -> None:
    root = tmp_path / "set"
    config = tmp_path / "robot.yaml"
    config.write_text(
        "robot_id: bench\nembodiment_tags: [so101_follower, mobile_base]\nhal: {adapter:"
        " so101_kinematic}\n"
        "task: {id: nod, instruction: nod twice, max_steps: 400}\nvla: {id: "
        f"{RSKILL}}}\nsave_dir: {root}\n"
    )
    process = start_recording("deploy-nod", "deploy", "--config", str(config), NOD_STEPS="12")
    out, _ = process.communicate(timeout=WAIT_S)
    assert process.returncode == 0
    result = json.loads(out.splitlines()[-1])
    (note,) = commit.notes(root)
    said = {
        "episodes": 1,
        "frames": note["frames"],
        "discarded": 0,
        "skipped": 0,
        "dropped": 0,
        "left_out": 0,
        "error": None,
    }
    assert (result["save_dir"], result["metadata"]["recorded"]) == (str(root), said)
    assert (note["status"], note["goal_id"], note["task"]) == ("succeeded", "task", "nod twice")
    assert note["frames"] >= 12
    first, second = read_frame(root, 0), read_frame(root, 1)
    assert first.tick["action_applied"]
    # next to each other, unless the machine stood still
    assert second.tick["index"] > first.tick["index"]
    assert first.action["wrist_flex"] == pytest.approx(first.state["wrist_flex"] + 0.01, abs=1e-4)
    # the skill's word is in the note
    assert read_frame(root, note["frames"] - 1).tick["success"] is None
