"""kill -9 of a server, the gateway and the arbiter, while requests are in each of their states."""

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")

import aiohttp

from tests.sidecars.gateway.conftest import GatewayProcess, stand_in
from tests.support.process import ArbiterProcess
from tests.support.processes import alive
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.sync import Client

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]
AT_NIGHT = pytest.mark.nightly
Start = Callable[..., GatewayProcess]


def state(gateway: GatewayProcess, name: str) -> str:
    return str(gateway.running().get(name, {}).get("lease", "away"))


@asynccontextmanager
async def chat(
    gateway: GatewayProcess, model: str, user: str | None = None
) -> AsyncIterator[aiohttp.ClientResponse]:
    """A stream of two words, each of which waits for a file where there is a user."""
    body = {"model": model, "stream": True, "max_tokens": 2, "user": user}
    body["messages"] = [{"role": "user", "content": "hello"}]
    timeout = aiohttp.ClientTimeout(PATIENCE_S)
    async with (
        aiohttp.ClientSession(timeout=timeout) as session,
        session.post(f"{gateway.url}/v1/chat/completions", json=body) as answer,
    ):
        yield answer


async def status(gateway: GatewayProcess, model: str) -> int:
    async with chat(gateway, model) as answer:
        said = await answer.text()
        assert answer.status != 200 or "[DONE]" in said
        return answer.status


@AT_NIGHT
async def test_a_server_killed_in_a_stream_breaks_it_and_is_started_again(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway({name: stand_in(arbiter_daemon, 5) for name in "ab"})
    pid = await asyncio.to_thread(started.pid_of, "a")
    started.let("u", 0)
    async with chat(started, "a", "u") as answer:
        assert await answer.content.readany()
        waits = asyncio.create_task(status(started, "b"))
        await eventually(lambda: state(started, "b") == "queued")
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(aiohttp.ClientPayloadError):  # not a clean end
            await answer.read()
    assert await waits == 200
    assert await status(started, "a") == 200


@AT_NIGHT
async def test_a_server_killed_as_it_starts_fails_its_requests_alone(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    sleeper = {"command": ["sh", "-c", "echo $$; exec sleep 600", "{port}"], "vram": "1GiB"}
    started = gateway({"a": sleeper, "b": stand_in(arbiter_daemon, 1)})
    first = asyncio.create_task(status(started, "a"))
    await eventually(lambda: state(started, "a") == "starting" and started.logs())
    os.kill(int(started.logs().removeprefix("a: ")), signal.SIGKILL)
    assert await first == 502
    assert await status(started, "b") == 200


@pytest.mark.parametrize(
    "when",
    ["ready", pytest.param("queued", marks=AT_NIGHT), pytest.param("leaving", marks=AT_NIGHT)],
)
async def test_a_gateway_killed_in_any_state_leaves_no_server_and_no_lease(
    gateway: Start, arbiter_daemon: ArbiterProcess, when: str
) -> None:
    started = gateway({name: stand_in(arbiter_daemon, 5) for name in "ab"})
    pid = await asyncio.to_thread(started.pid_of, "a")
    started.let("u", 0)
    async with chat(started, "a", "u") as answer:
        assert await answer.content.readany()
        waits = asyncio.create_task(status(started, "b" if when != "ready" else "a"))
        match when:
            case "queued":
                await eventually(lambda: state(started, "b") == "queued")
            case "leaving":
                await eventually(lambda: state(started, "a") == "leaving")
            case _:
                assert await waits == 200
        started.process.kill()
        with pytest.raises(aiohttp.ClientPayloadError):
            await answer.read()
    await asyncio.gather(waits, return_exceptions=True)
    await eventually(lambda: not alive(pid))
    with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
        await eventually(lambda: not arbiter.status().leases)


@AT_NIGHT
async def test_a_killed_arbiter_ends_no_stream(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway({name: stand_in(arbiter_daemon, 5) for name in "ab"})
    started.let("u", 0)
    async with chat(started, "a", "u") as answer:
        assert await answer.content.readany()
        waits = asyncio.create_task(status(started, "b"))
        await eventually(lambda: state(started, "b") == "queued")
        await asyncio.to_thread(arbiter_daemon.kill)
        await asyncio.to_thread(arbiter_daemon.start)
        started.let("u", 1)
        assert b"[DONE]" in await answer.read()
    assert await waits == 200
    assert await status(started, "a") == 200
