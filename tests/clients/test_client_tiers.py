"""Leases that leave and come back, pause, park and lend: the async client against a real daemon, on
asyncio and on trio.
"""

from collections.abc import Callable

import anyio
import pytest

from tests.support.beside import Start, within
from tests.support.leases import Spec, Until, states
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients import use_context
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease, LeaseState
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import BadState, LeaseRevoking, WaitTimeout, WouldDeadlock
from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.wire.pushes import RevokePush
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.sidecars.device.fake import FakeMemory

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", ["asyncio", "trio"]),
    pytest.mark.e2e,
]


class Model:
    """What a holder does to its bytes, as a list of words."""

    def __init__(self) -> None:
        self.did: list[str] = []

    async def unload(self) -> None:
        self.did.append("unload")

    async def park(self) -> None:
        self.did.append("park")

    async def load(self, lease: AsyncLease) -> None:
        self.did.append("load")
        await lease.ready()


async def on_standby(client: AsyncClient, spec: Spec, model: Model) -> AsyncLease:
    """A detector that is resident, and comes back when it was sent away."""
    detector = await client.acquire(
        spec("detector", 5, standby=True), unload=model.unload, restore=model.load
    )
    await detector.ready()
    return detector


async def parkable(client: AsyncClient, spec: Spec, model: Model) -> AsyncLease:
    """A detector that is resident, and may keep its weights in host RAM when it leaves."""
    detector = await client.acquire(
        spec("detector", 5, park_bytes=5 * GIB),
        unload=model.unload,
        park=model.park,
        restore=model.load,
    )
    await detector.ready()
    return detector


async def test_a_standby_lease_returns_by_itself_when_there_is_room(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until
) -> None:
    model = Model()
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        detector = await on_standby(client, spec, model)
        first = detector.token
        policy = await client.acquire(spec("policy", 4), PATIENCE_S)
        await policy.ready()
        assert detector.state == "standby"
        with pytest.raises(LeaseRevoking):
            async with detector.use():
                raise AssertionError("a lease on standby cannot be used")
        await policy.give_up()
        await until(lambda: detector.state == "held")
        assert detector.token > first
        assert model.did == ["unload", "load"]
        async with detector.use():
            assert (await states(client))["detector"] == "held"
        await detector.give_up()
        assert (model.did[-1], detector.state) == ("unload", "gone")


async def followed(lease: AsyncLease, last: LeaseState) -> list[LeaseState]:
    """The states of a lease from now on, up to `last`."""
    seen = [lease.state]
    while seen[-1] != last:
        seen.append(await lease.wait_change(seen[-1]))
    return seen


async def test_a_task_that_follows_a_lease_sees_where_it_goes(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start
) -> None:
    model = Model()
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client, within(PATIENCE_S):
        detector = await on_standby(client, spec, model)
        assert (detector.state, detector.given_up) == ("held", False)
        policy = await client.acquire(spec("policy", 4), PATIENCE_S)
        await policy.ready()
        returning = beside(followed(detector, "held"))
        await anyio.wait_all_tasks_blocked()  # it follows
        await policy.give_up()
        assert policy.given_up
        assert await returning == ["standby", "loading", "held"]
        leaving = beside(followed(detector, "gone"))
        await anyio.wait_all_tasks_blocked()
        await detector.give_up()
        went = await leaving
        assert went[0] == "held"
        assert set(went[1:-1]) <= {"revoking", "unloading"}
        assert await detector.wait_change("gone") == "gone", "nothing changes any more"
        assert await detector.wait_change("held") == "gone", "the caller had not seen it"
        assert detector.given_up


async def test_a_standby_lease_survives_the_daemon(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until
) -> None:
    model = Model()
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        detector = await on_standby(client, spec, model)
        memory = FakeMemory(arbiter_daemon.gpu_folder, "t", 0)
        policy = await client.acquire(spec("policy", 4), PATIENCE_S)
        block = memory.allocate("policy", 4 * GIB)
        await policy.ready()
        arbiter_daemon.kill()
        arbiter_daemon.start()
        await until(lambda: client.connected)
        assert (await states(client)) == {"policy": "held", "detector": "standby"}
        memory.free(block)
        memory.empty_cache()
        await policy.give_up()
        await until(lambda: detector.state == "held")


async def test_a_standby_lease_can_ask_to_come_back_or_be_given_up(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until
) -> None:
    model = Model()
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        detector = await on_standby(client, spec, model)
        other = Model()
        policy = await client.acquire(spec("policy", 4), PATIENCE_S, unload=other.unload)
        await policy.ready()
        await detector.reacquire(PATIENCE_S)
        await until(lambda: detector.state == "held")
        await policy.wait_gone()
        assert other.did == ["unload"]
        policy = await client.acquire(spec("policy", 4), PATIENCE_S)
        assert detector.state == "standby"
        await detector.give_up()
        assert detector.state == "gone"
        assert "detector" not in await states(client)


async def test_weights_are_parked_where_the_budget_has_room(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, until: Until
) -> None:
    arbiter = make_arbiter(config="host:\n  park_budget_bytes: 6GiB\n").start()
    model = Model()
    async with AsyncClient("t", endpoint=arbiter.endpoint) as client:
        detector = await parkable(client, spec, model)
        policy = await client.acquire(
            spec("policy", 4, park_bytes=5 * GIB), PATIENCE_S, unload=model.unload
        )
        await policy.ready()
        assert (detector.state, model.did) == ("parked", ["park"])
        await detector.reacquire(PATIENCE_S)
        await until(lambda: detector.state == "held")
        assert model.did == ["park", "unload", "load"]
        await detector.park()
        assert detector.state == "parked"
        with pytest.raises(BadState):
            await policy.park()
        await detector.give_up()
        assert (model.did[-1], detector.state) == ("unload", "gone")


AGAIN = RevokePush("L1", Token(1, 1), "", 1.0, 0, park=False)


async def test_who_parks_hears_how_it_ended_not_how_it_was_meant(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec, beside: Start
) -> None:
    """Regression: whatever happened on the lease while the arbiter was asked ended the wait, and it
    was `parked`, and gone a moment later."""
    arbiter = make_arbiter(config="host:\n  park_budget_bytes: 0\n").start()
    model = Model()
    async with AsyncClient("t", endpoint=arbiter.endpoint) as client, within(PATIENCE_S):
        detector = await parkable(client, spec, model)
        parking = beside(detector.park())
        while not parking.done:
            detector._revoke_asked(AGAIN)  # as the arbiter repeats it
            await anyio.sleep(0)
        await parking
        assert (detector.state, model.did) == ("gone", ["park", "unload"])


async def test_a_job_that_waits_for_its_own_room_is_told(
    arbiter_daemon: ArbiterProcess, spec: Spec, beside: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds in use what it would itself have to give up: that would never end. Another task of
    the process, and a wait with a limit of its own, are as any other."""
    monkeypatch.setattr(use_context, "WAIT_IN_USE_S", 0.2)
    async with AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client:
        job = await client.acquire(spec("job", 5))
        await job.ready()
        inside = anyio.Event()
        another = beside(asked_when(inside, client, spec("another request", 5)))
        async with job.use("render"):
            inside.set()
            with pytest.raises(WouldDeadlock) as told:
                await client.acquire(spec("llm", 5))
            assert told.value.details["uses"] == [f"use 'render' of {job.lease_id}"]
            assert told.value.details["waited"]["why"]["consumer"] == "llm"
            with pytest.raises(WaitTimeout):
                await client.acquire(spec("llm", 5), 0.1)
            prefetch = beside(client.acquire(spec("next", 5), PATIENCE_S))
        await job.give_up()
        assert (await another).state == "loading"
        await (await another).give_up()
        assert (await prefetch).state == "loading"


async def asked_when(happens: anyio.Event, client: AsyncClient, spec: LeaseSpec) -> AsyncLease:
    await happens.wait()
    return await client.acquire(spec, PATIENCE_S)
