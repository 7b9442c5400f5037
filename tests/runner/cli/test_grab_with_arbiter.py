"""A grab goal through the real parts: daemon, policy sidecar with the shipped checkpoint, runner
with the simulator.

One use spans the goal: a rival that needs the whole GPU waits for the goal's end, not for a moment
between two chunks.
"""

import asyncio
import os
import signal
from collections.abc import Iterator

import pytest

from tests.runner.grab_programs import GOAL_S, GRAB, SKILLS, GrabPrograms, need_checkpoint
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

pytestmark = [pytest.mark.nightly, pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(340)]

NAVIGATE = "vram-arbiter/so101-navigate"


@pytest.fixture
def programs(arbiter_daemon: ArbiterProcess) -> Iterator[GrabPrograms]:
    need_checkpoint()
    skills = [f"{SKILLS}/so101-grab", f"{SKILLS}/so101-navigate"]
    started = GrabPrograms(arbiter_daemon, "sim", "--seed", "1", "--skills", *skills)
    yield started
    started.close()


def leases(status: StatusReply, consumer: str) -> list[tuple[str, int]]:
    return [(lease.state, lease.uses) for lease in status.leases if lease.consumer == consumer]


async def grab_beside_rival(arbiter: ArbiterProcess, programs: GrabPrograms) -> None:
    async with (
        RunnerClient(f"ipc://{arbiter.runtime}/runner.sock", connect_timeout_s=60.0) as runner,
        AsyncClient("rival", endpoint=arbiter.endpoint) as rival,
    ):
        await runner.ping(timeout_s=60.0)
        truth = await runner.ground_truth()
        target = truth["target"]
        x, y, z = truth["objects"][target]["xyz_base"]
        drive = await runner.send_goal(
            NAVIGATE, goal_params={"target_point": {"x": x, "y": y, "z": z}}
        )
        assert (await drive.result(60))["success"]
        assert leases(await rival.status(), "grab") == []  # driving takes no lease

        grab = await runner.send_goal(GRAB, prompt=f"grab the {target}", deadline_s=GOAL_S)
        async for feedback in grab.feedback():
            if feedback["state"] == "running":
                break
        ((state, uses),) = leases(await rival.status(), "grab")
        told = [(e["kind"], e.get("reason")) for e in (await rival.history()).events]
        assert state == "held", f"no goal runs before its policy is ready: {told}"
        assert uses >= 1, "the goal is one use; an op under way is another"
        whole_gpu = LeaseSpec(
            consumer="rival",
            model_id="big",
            footprint=Footprint(
                load_peak_bytes=6_000_000_000, steady_bytes=6_000_000_000, residue_bytes=0
            ),
        )
        waiting = asyncio.create_task(rival.acquire(whole_gpu))
        result = await grab.result(60)
        assert result["status"] == "succeeded", result
        assert result["data"]["withheld"] == 0
        lease = await asyncio.wait_for(waiting, 60)
        events = (await rival.history(kinds=("use_ended", "granted"))).events
        story = [e["kind"] for e in events if e.get("label") == GRAB or e["consumer"] == "rival"]
        assert story == ["use_ended", "granted"], "not while the goal was running"
        left = leases(await rival.status(), "grab")
        assert all(one == ("parked", 0) for one in left), left
        truth = await runner.ground_truth()
        assert truth["held"] == target  # evicting the policy does not open the gripper
        assert truth["held_above_table"][target]
        await lease.release()

        again = await runner.send_goal(GRAB, prompt=f"grab the {target}", deadline_s=GOAL_S)
        async for feedback in again.feedback():
            if feedback["state"] == "running":
                break
        os.kill(programs.sidecar.pid, signal.SIGKILL)
        result = await again.result(60)
        assert (result["status"], result["success"]) == ("failed", False)
        assert result["code"] in ("sidecar_unavailable", "lease_lost", "evicted"), result
        assert (await runner.state())["phase"] == "idle"


def test_a_goal_is_one_use_and_a_dead_policy_fails_closed(
    arbiter_daemon: ArbiterProcess, programs: GrabPrograms
) -> None:
    programs.play(grab_beside_rival(arbiter_daemon, programs))
