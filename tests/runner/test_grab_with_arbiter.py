"""A grab goal through the real parts: daemon, policy sidecar with the shipped checkpoint, runner with the simulator.

One use spans the goal: a rival that needs the whole card waits for the goal's end, not for a moment between two chunks.
"""

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from arbiter.testing.process import ArbiterProcess
from clients.aio import ArbiterClient
from clients.runner import RunnerClient
from schemas.wire import Footprint, LeaseSpec

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(240)]

ROOT = Path(__file__).parents[2]
GRAB, NAVIGATE = "vram-arbiter/so101-grab", "vram-arbiter/so101-navigate"


class Programs:
    """Policy sidecar and runner in the daemon's runtime folder."""

    def __init__(self, arbiter: ArbiterProcess) -> None:
        environ = arbiter.environ | {"OMP_NUM_THREADS": "1"}
        log = (arbiter.runtime / "programs.log").open("ab")
        skills = ROOT / "configs/rskills"
        sidecar = ["sidecars", "--name", "grab", "--rskill", f"{skills}/so101-grab/rskill.yaml"]
        runner = [
            "runner",
            "sim",
            "--seed",
            "1",
            "--skills",
            f"{skills}/so101-grab",
            f"{skills}/so101-navigate",
        ]
        device = ["--device", f"fake:{arbiter.card}"]
        self.sidecar, self.runner = (
            subprocess.Popen([sys.executable, "-m", *argv], cwd=ROOT, env=environ, stdout=log, stderr=log)
            for argv in ([*sidecar, *device], runner)
        )
        self.log = arbiter.runtime / "programs.log"
        log.close()

    def close(self) -> None:
        for process in (self.runner, self.sidecar):
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


@pytest.fixture
def programs(arbiter_daemon: ArbiterProcess) -> Iterator[Programs]:
    if not (ROOT / "configs/models/so101-grab/model.safetensors").exists():
        pytest.skip("the grab checkpoint is not in this tree")
    started = Programs(arbiter_daemon)
    yield started
    started.close()


def leases(status: dict[str, Any], consumer: str) -> list[tuple[str, int]]:
    return [(lease["state"], lease["uses"]) for lease in status["leases"] if lease["consumer"] == consumer]


async def scenario(arbiter: ArbiterProcess, programs: Programs) -> None:
    async with (
        RunnerClient(f"ipc://{arbiter.runtime}/runner.sock", connect_timeout_s=60.0) as runner,
        ArbiterClient(arbiter.endpoint, name="rival") as rival,
    ):
        await runner.ping(timeout_s=60.0)
        truth = await runner.ground_truth()
        target = truth["target"]
        x, y, z = truth["objects"][target]["xyz_base"]
        drive = await runner.send_goal(NAVIGATE, goal_params={"target_point": {"x": x, "y": y, "z": z}})
        assert (await drive.result(60))["success"]
        assert leases(await rival.status(), "grab") == []  # driving takes no lease

        grab = await runner.send_goal(GRAB, prompt=f"grab the {target}")
        async for feedback in grab.feedback():
            if feedback["state"] == "running":
                break
        while (found := leases(await rival.status(), "grab"))[0][0] == "loading":
            await asyncio.sleep(0.01)  # the goal runs, its policy is on its way
        ((state, uses),) = found
        assert state == "held"
        assert uses >= 1, "the goal is one use; an op under way is another"
        whole_card = LeaseSpec(
            consumer="rival",
            model_id="big",
            footprint=Footprint(load_peak_bytes=6_000_000_000, steady_bytes=6_000_000_000, residue_bytes=0),
        )
        waiting = asyncio.create_task(rival.acquire(whole_card))
        async for feedback in grab.feedback():
            assert not waiting.done() or feedback["progress"] == 1.0, "granted while the goal was running"
        result = await grab.result(60)
        assert result["status"] == "succeeded", result
        assert result["data"]["withheld"] == 0
        lease = await asyncio.wait_for(waiting, 60)
        assert leases(await rival.status(), "grab") == []
        truth = await runner.ground_truth()
        assert truth["held"] == target  # evicting the policy does not open the gripper
        assert truth["held_above_table"][target]
        await lease.release()

        again = await runner.send_goal(GRAB, prompt=f"grab the {target}")
        async for feedback in again.feedback():
            if feedback["state"] == "running":
                break
        os.kill(programs.sidecar.pid, signal.SIGKILL)
        result = await again.result(60)
        assert (result["status"], result["success"]) == ("failed", False)
        assert result["code"] in ("sidecar_unavailable", "lease_lost", "evicted"), result
        assert (await runner.state())["phase"] == "idle"


def test_a_goal_is_one_use_and_a_dead_policy_fails_closed(
    arbiter_daemon: ArbiterProcess, programs: Programs
) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(200):
            await scenario(arbiter_daemon, programs)

    try:
        asyncio.run(bounded())
    except (AssertionError, TimeoutError):
        print(programs.log.read_text(errors="replace")[-4000:])
        raise
