"""Frames of the simulator through a (simulated) GPU: a real arbiter, sidecar and runner; under a
lease, and the arm keeps still.
"""

import asyncio
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runner.grab_programs import ROOT
from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import RunnerClient

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(300)]

RSKILL = ROOT / "configs/diagnostics/gpu-passthrough/rskill.yaml"
SKILL = "vram-arbiter/gpu-passthrough"


@pytest.fixture
def passthrough_programs(arbiter_daemon: ArbiterProcess, tmp_path: Path) -> Iterator[list[Forked]]:
    environ = arbiter_daemon.environ | {"OMP_NUM_THREADS": "1"}
    sidecar = [
        "--name",
        "passthrough",
        "--rskill",
        str(RSKILL),
        "--device",
        f"fake:{arbiter_daemon.gpu_folder}",
    ]
    runner = ["sim", "--seed", "1", "--skills", str(RSKILL)]
    log = tmp_path / "programs.log"
    with log.open("ab") as sink:
        started = [
            start(program, words, environ, sink.fileno(), sink.fileno(), cwd=ROOT)
            for program, words in (("vram-sidecar", sidecar), ("vram-runner", runner))
        ]
    yield started
    for process in reversed(started):
        process.terminate()
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    print(log.read_text(errors="replace")[-3000:])


async def one_goal(daemon: ArbiterProcess, sidecar: Forked) -> None:
    async with (
        RunnerClient(f"ipc://{daemon.runtime}/runner.sock", connect_timeout_s=120.0) as runner,
        AsyncClient("watcher", endpoint=daemon.endpoint, role="observer") as watcher,
    ):
        before = (await runner.state())["world"]["joint_state"]["position"]
        goal = await runner.send_goal(SKILL, deadline_s=120.0)
        held: list[int] = []
        async for feedback in goal.feedback():
            if feedback["state"] == "running" and not held:
                (lease,) = (await watcher.status()).leases
                assert lease.consumer == "passthrough"
                assert lease.state == "held"
                held.append(lease.pid)
        result = await goal.result(120)
        assert result["status"] == "succeeded", result
        assert result["data"]["steps"] == 60
        assert result["data"]["withheld"] == 0
        assert held == [sidecar.pid], "who holds the bytes holds the lease"
        after = (await runner.state())["world"]["joint_state"]["position"]
        assert after == pytest.approx(before, abs=0.03)


def test_frames_pass_the_gpu_under_a_lease_and_nothing_moves(
    arbiter_daemon: ArbiterProcess, passthrough_programs: list[Forked]
) -> None:
    asyncio.run(asyncio.wait_for(one_goal(arbiter_daemon, passthrough_programs[0]), 280))
