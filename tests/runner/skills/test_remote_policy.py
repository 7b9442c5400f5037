"""A policy of a GPU server, through a real tunnel: a goal is a use at the server's arbiter, and the
robot stops by its own clock when the tunnel is killed or silent.
"""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.runner.skills.policy_bench import MANIFEST, Bench, Leased
from tests.support.guests import USER
from tests.support.process import Make
from tests.support.remote import Remote
from tests.support.waiting import eventually
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.runner.protocols import Act, Goal, Hold
from vram_arbiter.runner.skills import sidecar_policy
from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.schemas.manifest import parse_manifest

pytestmark = [pytest.mark.anyio, pytest.mark.heavy, pytest.mark.e2e, pytest.mark.nightly]

GOAL = Goal("g1", "test/arm-grab", prompt="grab the red cube", deadline_s=60.0)
HUNG_S = 1.0


@dataclass
class Robot:
    """A policy's bench, whose sidecar and arbiter are on the server."""

    bench: Bench
    server: AsyncClient
    remote: Remote

    async def uses(self) -> int:
        return sum(lease.uses for lease in (await self.server.status()).leases)

    async def no_uses(self) -> None:
        async with asyncio.timeout(60):
            while await self.uses():
                await asyncio.sleep(0.01)


@pytest.fixture
async def remote_robot(
    make_arbiter: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Robot]:
    for name in ("HUNG_MIN_S", "HUNG_FIRST_MIN_S", "HUNG_WAITING_MIN_S"):
        monkeypatch.setattr(sidecar_policy, name, HUNG_S)
    sidecar = Leased()
    with Remote(make_arbiter, tmp_path) as remote:
        async with (
            AsyncClient("grab", endpoint=remote.arbiter.endpoint) as server,
            server.lease(vram="1GiB", model="pi0", unload=lambda: None) as sidecar.lease,
            sidecar.served(f"ipc://{remote.sidecar}"),
        ):
            remote.sidecar.chmod(0o666)
            await sidecar.lease.ready()
            await asyncio.to_thread(remote.up, "grab")
            async with AsyncClient("runner", endpoint=remote.endpoint) as guest:
                manifest = parse_manifest(MANIFEST)
                endpoint = f"ipc://{remote.folder}/grab.sock"
                bench = Bench(manifest, endpoint, guest, wait_s=0.0)  # type: ignore[arg-type]
                bench.sidecar = sidecar
                yield Robot(bench, server, remote)
                await bench.skill.finish()
                await bench.client.close()


async def first_action(bench: Bench) -> float:
    """Step until a row of a chunk plays, past the way to the start pose; return its chunk's number
    at the sidecar."""
    while True:
        outcome = await bench.step()
        if isinstance(outcome, Act) and outcome.chunk_index is not None:
            return 100 * outcome.action.rows[0][0]


async def held(bench: Bench) -> None:
    while True:
        assert isinstance(await bench.step(), Hold)


async def test_a_goal_is_a_use_at_the_servers_arbiter(remote_robot: Robot) -> None:
    await remote_robot.bench.skill.start(GOAL)
    assert await remote_robot.uses() == 1
    await first_action(remote_robot.bench)
    await remote_robot.bench.skill.finish()
    await remote_robot.no_uses()


async def test_a_killed_tunnel_ends_the_goal_at_once_and_the_next_begins_anew(
    remote_robot: Robot,
) -> None:
    bench = remote_robot.bench
    await bench.skill.start(GOAL)
    await first_action(bench)
    remote_robot.remote.sshd.kill(USER)
    await remote_robot.no_uses()
    await eventually(lambda: not bench.client.connected)
    with pytest.raises(SidecarUnavailable, match="lost within the goal"):
        await bench.step()
    await bench.skill.finish()

    await eventually(lambda: bench.arbiter.connected)  # type: ignore[union-attr]
    await bench.skill.start(GOAL)
    assert await remote_robot.uses() == 1, "a new use"
    assert await first_action(bench) == pytest.approx(1), "a new chunk, of a new picture"


async def test_a_silent_tunnel_stops_the_robot_at_the_end_of_its_chunk(remote_robot: Robot) -> None:
    bench = remote_robot.bench
    await bench.skill.start(GOAL)
    await first_action(bench)
    remote_robot.remote.sshd.freeze(USER)
    try:
        outcomes = [await bench.step() for _ in range(3)]
        assert [type(one) for one in outcomes] == [Act, Act, Hold], "the rest of its chunk"
        with pytest.raises(SidecarUnavailable, match="hangs: no chunk within"):
            await held(bench)
        await bench.skill.finish()
    finally:
        remote_robot.remote.sshd.unfreeze(USER)
    await remote_robot.no_uses()

    await eventually(lambda: bench.arbiter.connected)  # type: ignore[union-attr]
    await bench.skill.start(GOAL)
    assert await remote_robot.uses() == 1
    newest = await first_action(bench)
    assert newest == pytest.approx(len(bench.sidecar.observations) - 1), "not the late answer"
    assert newest >= 1
