"""A runner whose goal socket is attacked by another process of its own user: goals are served, the
loop ticks, and a stop is answered.
"""

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from tests.runner.small_robots import FedCamera, Nod, Twin, hardware_runner
from tests.support.paths import SUPPORT
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.goals.server import GoalServer
from vram_arbiter.runner.robots.hardware import HardwareRunner
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.schemas.errors import EstopRequested
from vram_arbiter.schemas.manifest import Kind, load_manifest

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

ATTACKER = SUPPORT / "attacker.py"
RSKILL = "vram-arbiter/so101-navigate"


@asynccontextmanager
async def hardware_serving(endpoint: str, manifest: Path) -> AsyncIterator[HardwareRunner]:
    clock = SystemClock()
    twin, camera = Twin(clock), FedCamera("front", clock)
    skill = Nod(load_manifest(manifest), steps=20)
    limits = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in twin.description.joints}
    runner = hardware_runner(
        twin, [(camera, 60_000.0)], lambda _: JointRanges(limits), rate_hz=100.0, clock=clock
    )
    catalogue = Catalogue([skill.manifest], {Kind.ROS_ACTION: lambda _: skill})
    async with ControlThread(runner) as control:
        server = GoalServer(endpoint, control, catalogue, clock, estop_s=60.0)
        task = asyncio.create_task(server.serve())
        await server.bound.wait()
        try:
            yield runner
        finally:
            server.stopping.set()
            await task


@asynccontextmanager
async def attacked(endpoint: str, mode: str) -> AsyncIterator[None]:
    path = endpoint.removeprefix("ipc://")
    attacker = await asyncio.create_subprocess_exec(
        sys.executable, str(ATTACKER), mode, path, stdout=subprocess.PIPE
    )
    assert attacker.stdout is not None
    try:
        assert await attacker.stdout.readline() == b"under way\n"
        yield
        assert attacker.returncode is None, "the attack was over before the test was"
    finally:
        if attacker.returncode is None:
            attacker.kill()
        await attacker.wait()


@pytest.mark.parametrize("mode", ["empties", "maps", "more", "connects"])
async def test_goals_ticks_and_the_stop_of_an_attacked_runner(
    endpoint: str, navigate_manifest: Path, mode: str
) -> None:
    """Regression: empty frames delayed a stop by 20.9 s, maps stopped the control loop for 2.6 s,
    connects ended the process at 1,024, and MORE took memory without end.
    """

    async with (
        hardware_serving(endpoint, navigate_manifest) as runner,
        RunnerClient(endpoint) as client,
    ):
        await client.ping(timeout_s=60.0)
        async with (
            attacked(endpoint, mode),
            RunnerClient(endpoint, connect_timeout_s=60.0, timeout_s=60.0) as another,
        ):
            for one in (client, another):
                goal = await one.send_goal(RSKILL)
                assert (await goal.result(60))["success"]
            ticks = runner.tick_idx
            while runner.tick_idx < ticks + 20:
                await another.state()
            assert "stand still" in (await another.estop("smoke")).message
            with pytest.raises(EstopRequested):
                await another.send_goal(RSKILL)
