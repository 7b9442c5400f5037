"""The async client against a real daemon with a simulated GPU, on asyncio and on trio."""

import contextlib
import json
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

from tests.support.beside import Canceled, Start, within
from tests.support.leases import Spec, Until, states
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.clients._protocol.records import Eviction
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.defaults import STATUS_PAGE
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    BadRequest,
    LeaseLost,
    LeaseRevoking,
    LimitExceeded,
    StaleToken,
    UnknownGpu,
    VramError,
    VramInsufficient,
    WaitTimeout,
)
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.requests import Acquire, Evict, Status, Unloading
from vram_arbiter.schemas.wire.views import Totals

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", ["asyncio", "trio"]),
    pytest.mark.e2e,
]


async def test_acquire_ready_use_release(arbiter_daemon: ArbiterProcess, spec: Spec) -> None:
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = await client.acquire(spec("a", 5))
        assert (lease.state, lease.token[0]) == ("loading", client.epoch)
        await lease.ready(5 << 30)
        async with lease.use("detect"):
            assert (await client.status()).leases[0].uses == 1
        assert lease.state == "held"
        await lease.release()
        await lease.release()
        assert lease.state == "gone"
        assert lease.error is None
        with pytest.raises(LeaseLost):
            await lease.ready()


async def test_an_evicted_holder_hears_by_whom_and_why(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until
) -> None:
    """After an eviction every call on the lease said that it "was released", as if its holder had
    wanted that."""
    async with (
        AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client,
        AsyncClient("ops", endpoint=arbiter_daemon.endpoint, role="operator") as ops,
    ):
        first = await client.acquire(spec("a", 5))
        await first.ready()
        assert first.evicted is None
        second = await ops.acquire(spec("b", 5), PATIENCE_S)
        assert first.evicted == Eviction("waiter", "b", "b needs the room", 50)
        with pytest.raises(LeaseLost, match="was evicted: b needs the room"):
            await first.ready()
        await second.ready()
        await ops.ask(Evict("lunch", "b"))
        await until(lambda: second.state == "gone")
        assert (second.evicted.cause, second.evicted.by.split()[0]) == ("operator", "ops")
        assert second.evicted.reason.endswith(": lunch")


async def test_status_is_whole_though_it_comes_in_pages(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """The daemon answers `status` in pages: thousands of waiters in one reply held its loop for
    seconds."""
    waiters = STATUS_PAGE + 40
    async with contextlib.AsyncExitStack() as stack:
        clients = [
            await stack.enter_async_context(AsyncClient("t", endpoint=arbiter_daemon.endpoint))
            for _ in range(5)
        ]
        await clients[0].acquire(spec("holder", 5))
        crowd = spec("crowd", 5)
        for number in range(waiters):
            await clients[1 + number % 4].ask(Acquire(f"n{number}", crowd))
        page = await clients[0].ask(Status())
        assert (len(page.leases), page.totals) == (STATUS_PAGE, Totals(waiters + 1, waiters))
        whole = await clients[0].status()
        assert [lease.position for lease in whole.leases] == [None, *range(1, waiters + 1)]
        assert whole.next is None
        vramctl = str(Path(sys.executable).with_name("vramctl"))
        command = [vramctl, "status", "--json", "--endpoint", arbiter_daemon.endpoint]
        told = await anyio.run_process(command)
        assert len(json.loads(told.stdout)["leases"]) == waiters + 1


async def test_a_block_unloads_and_releases_also_when_it_raises(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    unloaded: list[str] = []

    async def unload() -> None:
        unloaded.append("a")

    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        with pytest.raises(ZeroDivisionError):
            async with client.lease(spec("a", 5), unload=unload) as lease:  # fails while loading
                raise ZeroDivisionError
        assert (unloaded, lease.state) == (["a"], "gone")
        async with client.lease(spec("a", 5), unload=unload) as lease:
            await lease.ready()
        assert unloaded == ["a", "a"]


async def test_a_plain_function_may_unload(
    arbiter_daemon: ArbiterProcess, spec: Spec, caplog: pytest.LogCaptureFixture
) -> None:
    """The README's example does it so: its end was a traceback, and a lease whose bytes nobody had
    freed."""
    unloaded: list[str] = []
    async with (
        AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client,
        client.lease(spec("a", 5), unload=lambda: unloaded.append("a")) as lease,
    ):
        await lease.ready()
    assert (unloaded, lease.state, caplog.messages) == (["a"], "gone", [])


async def test_closing_the_client_gives_up_its_leases(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    unloaded = anyio.Event()

    async def unload() -> None:
        unloaded.set()

    async with AsyncClient("other", endpoint=arbiter_daemon.endpoint) as other:
        async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
            lease = await client.acquire(spec("a", 5), unload=unload)
            await lease.ready()
        assert unloaded.is_set()
        await (await other.acquire(spec("b", 7), PATIENCE_S)).release()


async def test_leaving_does_not_wait_for_an_arbiter_that_is_away(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, until: Until
) -> None:
    unloaded = anyio.Event()

    async def unload() -> None:
        unloaded.set()

    arbiter = make_arbiter().start()
    async with within(PATIENCE_S), AsyncClient("t", endpoint=arbiter.endpoint) as client:
        lease = await client.acquire(spec("a", 5, ttl_s=3600), unload=unload)
        await lease.ready()
        arbiter.kill()
        await until(lambda: not client.connected)
        async with within(REQUEST_TIMEOUT_S / 3):  # for a request it would wait that long
            await lease.give_up()
        assert unloaded.is_set()


async def test_revoked_at_the_safe_point_and_not_before(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start, until: Until
) -> None:
    story: list[str] = []

    async def unload() -> None:
        story.append("unload")

    async def revoked(_: object, eviction: Eviction) -> None:
        story.append(f"revoke for {eviction.by}")

    async with (
        AsyncClient("holder", endpoint=arbiter_daemon.endpoint) as holder,
        AsyncClient("waiter", endpoint=arbiter_daemon.endpoint) as waiter,
    ):
        lease = await holder.acquire(
            spec("a", 5), unload=unload, on_revoke=revoked, safe_point_eta_s=lambda: 0.5
        )
        await lease.ready()
        async with lease.use("first"):
            wanted = beside(waiter.acquire(spec("b", 5)))
            await until(lambda: lease.revoking)
            with pytest.raises(LeaseRevoking):
                async with lease.use("second"):
                    pytest.fail("a use began on a lease that is asked to leave")
            assert (await states(waiter))["a"] == "revoking"
            story.append("use ends")
        await lease.wait_gone()
        second = await wanted
        assert story == ["revoke for b", "use ends", "unload"]
        assert second.state == "loading"
        assert lease.state == "gone"
        assert lease.error is None


async def test_a_holder_stays_when_nothing_wants_its_room_any_more(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """The holder unloaded at the end of its use for a waiter that had given up."""
    story: list[str] = []
    async with (
        AsyncClient("holder", endpoint=arbiter_daemon.endpoint) as holder,
        AsyncClient("waiter", endpoint=arbiter_daemon.endpoint) as waiter,
    ):
        lease = await holder.acquire(spec("a", 5), unload=lambda: story.append("unload"))
        await lease.ready()
        for name in ("first", "second"):
            async with lease.use(name):
                with pytest.raises(WaitTimeout):
                    await waiter.acquire(spec("b", 5), wait_timeout_s=0.5)
                with anyio.fail_after(PATIENCE_S):
                    while (state := lease.state) != "held":
                        await lease.wait_change(state)
                assert lease.evicted is None
                async with lease.use("another"):
                    assert (await states(waiter))["a"] == "held"
        assert story == []
        kinds = [event["kind"] for event in (await waiter.history(0, 500)).events]
        assert kinds.count("revoke_withdrawn") == 2
        other = await waiter.acquire(spec("b", 5), PATIENCE_S)
        assert (story, lease.state, other.state) == (["unload"], "gone", "loading")


async def test_a_use_of_somebody_else_keeps_the_holder_in_place(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start, until: Until
) -> None:
    unloaded = anyio.Event()

    async def unload() -> None:
        unloaded.set()

    async with (
        AsyncClient("sidecar", endpoint=arbiter_daemon.endpoint) as sidecar,
        AsyncClient("runner", endpoint=arbiter_daemon.endpoint) as runner,
    ):
        lease = await sidecar.acquire(spec("a", 5), unload=unload)
        await lease.ready()
        async with runner.use(lease.lease_id, lease.token, "goal"):
            wanted = beside(runner.acquire(spec("b", 5)))
            await until(lambda: lease.revoking)
            while (await states(runner))["a"] != "revoking":
                await anyio.sleep(0.01)
            with anyio.move_on_after(0.6):  # longer than the holder's own retries
                await unloaded.wait()
            assert not unloaded.is_set()
            with pytest.raises(LeaseRevoking):
                await runner.begin_use(lease.lease_id, lease.token, "another goal")
        await wanted
        assert unloaded.is_set()


async def test_a_use_needs_the_right_token_and_is_forgotten_at_its_end(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """A runner kept an object for each goal that it ever had."""
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = await client.acquire(spec("a", 1))
        await lease.ready()
        with pytest.raises(StaleToken):
            async with client.use(lease.lease_id, (1, 999)):
                pytest.fail("a use began with a wrong token")
        with pytest.raises(BadRequest, match="at most 128"):
            async with lease.use("x" * 129):
                pytest.fail("a use began with a label that the arbiter refuses")
        async with client.use(lease.lease_id, lease.token, "goal"):
            assert len(client._session._foreign_uses) == 1
        assert len(client._session._foreign_uses) == 0


async def test_typed_refusals(arbiter_daemon: ArbiterProcess, spec: Spec) -> None:
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        with pytest.raises(VramInsufficient) as never:
            await client.acquire(spec("a", 9))
        assert never.value.details["capacity_bytes"] == 8 << 30
        with pytest.raises(UnknownGpu):
            await client.acquire(spec("a", 1, gpu="GPU-none"))
        pinned = await client.acquire(spec("a", 5, evictable=False))
        await pinned.ready()
        with pytest.raises(WaitTimeout) as late:
            await client.acquire(spec("b", 5), 0.2)
        assert late.value.details["why"]["blockers"][0]["consumer"] == "a"


async def test_a_cancelled_acquire_leaves_the_queue(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start
) -> None:
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = await client.acquire(spec("a", 5))
        await lease.ready()
        async with lease.use():
            waiting = beside(client.acquire(spec("b", 5)))
            while "b" not in await states(client):
                await anyio.sleep(0.01)
            waiting.cancel()
            with pytest.raises(Canceled):
                await waiting
            while "b" in await states(client):
                await anyio.sleep(0.01)


async def test_an_acquire_cancelled_at_any_moment_leaks_nothing(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start
) -> None:
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        for steps in range(12):  # of the loop, between asking and turning away
            waiting = beside(client.acquire(spec(f"c{steps}", 5)))
            for _ in range(steps * 3):
                await anyio.sleep(0)
            waiting.cancel()
            try:
                await (await waiting).release()  # it was faster
            except Canceled:
                pass
        async with within(PATIENCE_S):
            while await states(client):
                await anyio.sleep(0.01)
        whole = await client.acquire(spec("whole", 5), PATIENCE_S)
        assert (whole.state, await states(client)) == ("loading", {"whole": "loading"})


async def test_callbacks_that_raise_do_not_keep_the_lease(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    async def unload() -> None:
        raise ValueError("a bug of the holder")

    def revoked(*_: object) -> None:
        raise ValueError("another")

    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = await client.acquire(spec("a", 5), unload=unload, on_revoke=revoked)
        await lease.ready()
        second = await client.acquire(spec("b", 5), PATIENCE_S)
        await lease.wait_gone()
        assert second.state == "loading"


async def test_a_word_that_the_arbiter_refuses_is_said_again(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: one `unloading` beyond the client's rate ended the task that leaves, and the
    holder stayed until it was killed for it."""
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = await client.acquire(spec("a", 5))
        await lease.ready()
        said: list[int] = []
        ask, reply = client._session.protocol.holdings.ask, client._session.reply

        def counted(record: Any, request: Any, *arguments: Any, **options: Any) -> int:
            number = ask(record, request, *arguments, **options)
            said.extend([number] if isinstance(request, Unloading) else [])
            return number

        async def refused_once(number: int) -> AnyReply:
            answer = await reply(number)
            if said == [number]:
                raise LimitExceeded("too many messages", hint="wait")
            return answer

        monkeypatch.setattr(client._session.protocol.holdings, "ask", counted)
        monkeypatch.setattr(client._session, "reply", refused_once)
        async with (
            AsyncClient("other", endpoint=arbiter_daemon.endpoint) as other,
            within(PATIENCE_S),
        ):
            await (await other.acquire(spec("b", 5))).release()
            await lease.wait_gone()
        assert len(said) == 2


async def test_a_release_that_is_refused_ends_the_lease_all_the_same(
    arbiter_daemon: ArbiterProcess, spec: Spec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: its holder renewed nothing any more, and waited for ever for a lease that was
    neither held nor over."""
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = await client.acquire(spec("a", 5))
        reply = client._session.reply

        async def refused(number: int) -> AnyReply:
            await reply(number)
            raise LimitExceeded("too many messages", hint="wait")

        monkeypatch.setattr(client._session, "reply", refused)
        with pytest.raises(LimitExceeded):
            await lease.release()
        monkeypatch.undo()
        assert lease.state == "gone"
        async with within(PATIENCE_S):
            await lease.wait_gone()


async def test_nobody_at_the_endpoint(tmp_path: Path) -> None:
    client = AsyncClient("t", endpoint=f"ipc://{tmp_path}/none.sock", connect_timeout_s=0.2)
    with pytest.raises(ArbiterUnreachable) as unreachable:
        await client.__aenter__()
    assert "VRAM_ARBITER_ENDPOINT" in unreachable.value.hint
    with pytest.raises(ArbiterUnreachable):
        await client.status()


async def test_an_observer_may_look_but_not_acquire(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint, role="observer") as client:
        assert (await client.status()).clients == 1
        with pytest.raises(VramError, match="observer"):
            await client.acquire(spec("a", 1))


async def one(events: AsyncIterator[Any]) -> Any:
    return await anext(events)


async def test_subscribers_see_events_in_order(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start
) -> None:
    kinds: list[str] = []

    async def follow(client: AsyncClient, started: anyio.Event) -> None:
        events = client.subscribe()
        first = beside(one(events))
        await client.ping(timeout_s=PATIENCE_S)
        started.set()
        kinds.append((await first)["kind"])
        async for event in events:
            kinds.append(event["kind"])
            if event["kind"] == "released":
                return

    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        started = anyio.Event()
        following = beside(follow(client, started))
        await started.wait()
        lease = await client.acquire(spec("a", 5))
        await lease.ready()
        await lease.release()
        async with within(PATIENCE_S):
            await following
        # where the first reading of the GPU is still under way
        kinds = [kind for kind in kinds if kind != "queued"]
        assert kinds == ["granted", "ready", "switch", "released"]
        assert [event["kind"] for event in (await client.history(kinds=["granted"])).events] == [
            "granted"
        ]
