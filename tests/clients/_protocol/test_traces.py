"""The caller's trace goes along with what the clients send, and nobody who does not trace pays for
it."""

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.leases import Spec
from tests.support.process import ArbiterProcess
from tests.support.serving import answering
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.wire.replies import HistoryReply

PARENT = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
OTHER = "00-1af7651916cd43dd8448eb211c80319d-c7ad6b7169203332-01"


def test_a_program_that_does_not_trace_does_not_import_the_api() -> None:
    code = (
        "import sys, clients.client, clients.sync, clients.runner, clients.sidecar.policy, "
        "clients._protocol.traces as t\n"
        "assert t.present() is None and t.along({'a': 1}) == {'a': 1}\n"
        "with t.joined('00-1-2-01'): pass\n"
        "print([name for name in sys.modules if name.startswith('opentelemetry')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n", done.stdout + done.stderr


def test_the_present_span_goes_along_unless_another_one_is_named() -> None:
    assert traces.present() is None
    assert traces.environ() == {}
    with tracing.joined(PARENT):
        assert traces.present() == PARENT
        assert traces.environ() == {"TRACEPARENT": PARENT}, "for a program that is started here"
        assert traces.along({"op": "x"}) == {"op": "x", "traceparent": PARENT}
        assert traces.along({"traceparent": OTHER}) == {"traceparent": OTHER}
        # the arbiter asks the holder to leave while the program does something else
        with traces.joined(OTHER):
            assert traces.present() == OTHER
        with traces.joined(None):
            assert traces.present() is None
        assert traces.present() == PARENT
    with tracing.joined("nonsense"):
        assert traces.present() is None


def test_what_is_left_out_of_a_trace_is_named_all_the_same() -> None:
    with tracing.left_out(PARENT):
        assert traces.present() == PARENT[:-2] + "00"


def traced_in(history: HistoryReply, consumer: str) -> set[str | None]:
    return {
        event.get("traceparent") for event in history.events if event.get("consumer") == consumer
    }


@pytest.mark.e2e
def test_the_arbiter_hears_of_the_trace_of_an_acquire(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    async def story() -> None:
        async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
            with tracing.joined(PARENT):
                present = await client.acquire(spec("present", 1))
                await present.ready()
                await client.status()  # any request may carry it
                named = await client.acquire(spec("named", 1), traceparent=OTHER)
                await named.ready()
                use = await client.begin_use(present.lease_id, present.token, "look")
                await use.end()
            nobody = await client.acquire(spec("nobody", 1))
            history = await client.history()
            for lease in (present, named, nobody):
                await lease.release()
        assert PARENT in traced_in(history, "present")
        assert OTHER in traced_in(history, "named")
        assert traced_in(history, "nobody") == {None}

    asyncio.run(story())
    with Client("threads", endpoint=arbiter_daemon.endpoint) as client:
        with tracing.joined(PARENT):
            lease = client.acquire(spec("sync", 1))
        assert PARENT in traced_in(client.history(), "sync")
        lease.release()


@pytest.mark.e2e
def test_a_model_that_is_called_back_is_loaded_in_the_trace_of_who_wants_it(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """One that comes back by itself is nobody's: neither the evictor's nor that of whoever was just
    talking to the arbiter."""
    loaded: list[str | None] = []

    async def story() -> None:
        async def load(lease: AsyncLease) -> None:
            loaded.append(traces.present())
            await lease.ready()

        async def unload() -> None:
            pass

        async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
            with tracing.joined(PARENT):
                model = await client.acquire(
                    spec("model", 5, standby=True), unload=unload, restore=load
                )
                await model.ready()
                big = await client.acquire(spec("big", 5), unload=unload)
                await big.ready()
                assert model.state == "standby"
                await big.release()
            await model.wait_returned()
            big = await client.acquire(spec("big", 5), unload=unload)
            await big.ready()
            with tracing.joined(OTHER):
                await model.reacquire()

    asyncio.run(story())
    assert loaded == [None, OTHER]


def test_goals_and_sidecars_requests_carry_it(tmp_path: Path) -> None:
    heard: dict[str, Message] = {}

    async def story() -> None:
        server = RouterServer(f"ipc://{tmp_path}/s.sock", lambda error: error.to_wire())

        async def answer(peer: Peer, message: Message) -> None:
            heard[str(message.get("op") or message.get("endpoint"))] = message
            await server.send(peer, {"re": message["id"], "ok": True, "action": []})

        async with answering(server, answer):
            runner, policy = RunnerClient(server.endpoint), PolicyClient(server.endpoint)
            with tracing.joined(PARENT):
                await runner.send_goal("a/skill")
                await policy.get_action({})
            await policy.reset()
            await policy.close()
            await runner.close()

    asyncio.run(story())
    assert heard["goal"]["traceparent"] == heard["get_action"]["traceparent"] == PARENT
    assert "traceparent" not in heard["reset"]
