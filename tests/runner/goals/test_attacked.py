"""A runner whose goal socket is attacked by another process of its own user: goals are served, the
loop ticks, and a stop is answered.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from tests.runner.goal_bench import goals_served
from tests.runner.small_robots import FedCamera, Nod, Twin, twin_runner
from tests.support.attacks import WITHOUT_A_SESSION
from tests.support.running import attacked
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.robots.hardware import HardwareRunner
from vram_arbiter.schemas.errors import EstopRequested
from vram_arbiter.schemas.manifest import Kind, load_manifest

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

RSKILL = "vram-arbiter/so101-navigate"


@asynccontextmanager
async def hardware_serving(endpoint: str, manifest: Path) -> AsyncIterator[HardwareRunner]:
    clock = SystemClock()
    twin, camera = Twin(clock), FedCamera("front", clock)
    skill = Nod(load_manifest(manifest), steps=20)
    runner = twin_runner(twin, camera, clock=clock, max_age_ms=60_000.0, rate_hz=100.0)
    catalogue = Catalogue([skill.manifest], {Kind.ROS_ACTION: lambda _: skill})
    async with goals_served(endpoint, runner, catalogue):
        yield runner


@pytest.mark.parametrize("attack", WITHOUT_A_SESSION)
async def test_goals_ticks_and_the_stop_of_an_attacked_runner(
    endpoint: str, navigate_manifest: Path, attack: str
) -> None:
    """Regression: empty frames delayed a stop by 20.9 s, maps stopped the control loop for 2.6 s,
    connects ended the process at 1,024, and MORE took memory without end.
    """
    async with (
        hardware_serving(endpoint, navigate_manifest) as runner,
        RunnerClient(endpoint) as client,
    ):
        await client.ping(timeout_s=60.0)
        with attacked(endpoint, attack) as attacker:
            async with RunnerClient(endpoint, connect_timeout_s=60.0, timeout_s=60.0) as another:
                for one in (client, another):
                    goal = await one.send_goal(RSKILL)
                    assert (await goal.result(60))["success"]
                ticks = runner.tick_idx
                while runner.tick_idx < ticks + 20:
                    await another.state()
                assert "stand still" in (await another.estop("smoke")).message
                with pytest.raises(EstopRequested):
                    await another.send_goal(RSKILL)
            assert attacker.process.poll() is None, "the attack was over before the test was"
