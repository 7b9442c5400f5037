"""The async client while its daemon is killed, hangs and comes back, on asyncio and on trio."""

import os
import signal
import sys
from collections.abc import Callable

import anyio
import anyio.to_thread
import pytest
from anyio.streams.buffered import BufferedByteReceiveStream

from tests.support.beside import Start, within
from tests.support.leases import Spec, Until, states
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.errors import LeaseLost, VramError
from vram_arbiter.sidecars.device.fake import FakeMemory

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", ["asyncio", "trio"]),
    pytest.mark.e2e,
]


async def test_a_restart_of_the_daemon_is_ridden_out(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, until: Until, beside: Start
) -> None:
    arbiter = make_arbiter().start()
    async with AsyncClient("t", endpoint=arbiter.endpoint) as client:
        pinned = await client.acquire(spec("a", 5))
        waiting = beside(client.acquire(spec("b", 2), PATIENCE_S))
        while "b" not in await states(client):
            await anyio.sleep(0.01)
        arbiter.kill()
        # the socket's monitor says so, no heartbeat has to run out
        await until(lambda: not client.connected)
        asked = beside(client.status())
        await anyio.to_thread.run_sync(arbiter.start)
        await until(lambda: client.connected and client.epoch > pinned.token[0])
        assert (await asked).epoch == client.epoch
        # the GPU is empty here: whatever the daemon decides about the old lease, the waiter kept
        # its place
        if pinned.state == "loading":
            await pinned.ready()
        lease = await waiting
        assert lease.token[0] == client.epoch
        assert lease.token > pinned.token


async def test_self_fencing(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, until: Until
) -> None:
    lost: list[VramError] = []
    unloaded = anyio.Event()

    async def unload() -> None:
        unloaded.set()

    arbiter = make_arbiter().start()
    async with AsyncClient("t", endpoint=arbiter.endpoint) as client:
        lease = await client.acquire(
            spec("a", 5), unload=unload, on_lost=lambda _, error: lost.append(error)
        )
        await lease.ready()
        arbiter.kill()
        # without an arbiter only: a busy machine may take longer over a short ttl than it lasts
        client._session.protocol.connection.grace_s = -lease.spec.ttl_s
        async with within(PATIENCE_S):
            await lease.wait_gone()
        assert unloaded.is_set()
        assert [type(error) for error in lost] == [LeaseLost]
        assert "fenced" in str(lease.error)
        with pytest.raises(LeaseLost):
            async with lease.use():
                pytest.fail("a use began on a fenced lease")


async def test_a_hung_daemon_is_noticed_by_silence(
    make_arbiter: Callable[..., ArbiterProcess], until: Until
) -> None:
    arbiter = make_arbiter().start()
    async with AsyncClient("t", endpoint=arbiter.endpoint) as client:
        client._session.protocol.connection.heartbeat_s = 0.1
        os.kill(arbiter.pid, signal.SIGSTOP)
        try:
            await until(lambda: not client.connected)
        finally:
            os.kill(arbiter.pid, signal.SIGCONT)
        await until(lambda: client.connected)


RUNNER = """
import sys
from vram_arbiter.clients.sync import Client
token = (int(sys.argv[2]), int(sys.argv[3]))
with Client("runner") as client, client.use(sys.argv[1], token, "goal") as use:
    print("in use", flush=True)
    sys.stdin.readline()
    print(use.lost, flush=True)
"""


async def test_a_use_begins_without_the_daemon_and_is_told_when_it_is_back(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, until: Until
) -> None:
    """Regression: a use that began before the client noticed the daemon's death waited until the
    lease was fenced, and a robot's goal with it."""
    arbiter = make_arbiter().start()
    async with AsyncClient("sidecar", endpoint=arbiter.endpoint) as client, within(PATIENCE_S):
        lease = await client.acquire(spec("a", 5))
        await lease.ready()
        arbiter.kill()
        async with lease.use("not noticed yet"):
            await until(lambda: not client.connected)
            async with lease.use("noticed"):
                await anyio.to_thread.run_sync(arbiter.start)
                while not client.connected or (await client.status()).leases[0].uses != 2:
                    await anyio.sleep(0.01)
            assert (lease.state, lease.uses) == ("held", 1)
        while (await client.status()).leases[0].uses:
            await anyio.sleep(0.01)


async def test_leases_and_uses_survive_a_kill_of_the_daemon(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, until: Until, beside: Start
) -> None:
    arbiter = make_arbiter().start()
    memory = FakeMemory(arbiter.gpu_folder, "a", 0)
    unloaded = anyio.Event()

    async def unload() -> None:
        memory.free(block)
        memory.empty_cache()
        unloaded.set()

    async with AsyncClient("sidecar", endpoint=arbiter.endpoint) as client:
        lease = await client.acquire(spec("a", 5), unload=unload)
        block = memory.allocate("a", 5 << 30)
        await lease.ready(memory.used_bytes())
        runner = await anyio.open_process(
            [sys.executable, "-c", RUNNER, lease.lease_id, *map(str, lease.token)],
            env=arbiter.environ, stderr=None,
        )  # fmt: skip
        assert runner.stdout is not None
        assert runner.stdin is not None
        said = BufferedByteReceiveStream(runner.stdout)
        try:
            assert await said.receive_until(b"\n", 100) == b"in use"
            async with lease.use("request"):
                arbiter.kill()
                await until(lambda: not client.connected)
                await anyio.to_thread.run_sync(arbiter.start)
                await until(lambda: client.connected)
                async with within(PATIENCE_S):
                    while (shown := (await client.status()).leases[0]).uses != 2:
                        await anyio.sleep(0.01)
            assert (shown.lease_id, shown.state) == (lease.lease_id, "held")
            assert client.epoch > lease.token[0]
            wanted = beside(client.acquire(spec("b", 5), PATIENCE_S))
            await until(lambda: lease.revoking)
            assert not unloaded.is_set()  # the runner's goal goes on
            await runner.stdin.send(b"end\n")
            assert await said.receive_until(b"\n", 100) == b"None"
            second = await wanted
        finally:
            await runner.aclose()
        assert unloaded.is_set()
        await lease.wait_gone()
        assert lease.error is None
        assert second.token > lease.token
