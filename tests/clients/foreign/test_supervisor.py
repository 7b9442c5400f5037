"""A program and its leases, with an action that only takes notes."""

import asyncio
import signal
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

import pytest

from tests.support.grants_at_once import GrantsAtOnce
from tests.support.leases import Spec, Until
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.foreign.program import Program
from vram_arbiter.clients.foreign.run_spec import OnRevoke, RunSpec
from vram_arbiter.clients.foreign.supervisor import Supervisor

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]


class Notes:
    """An action that does nothing to the program. `work`: answers of the next looks at its
    requests, then 0."""

    name = "notes"
    keeps_context = parks = False

    def __init__(self, suspends: bool = False) -> None:
        self.suspends = suspends
        self.did: list[str] = []
        self.work: list[int] = []

    def check(self) -> None: ...

    def busy(self) -> int:
        self.did.append("look")
        return self.work.pop(0) if self.work else 0

    def free(self, pids: Sequence[int]) -> None:
        self.did.append(f"free {len(pids)}")

    def restore(self, pids: Sequence[int]) -> None:
        self.did.append(f"restore {len(pids)}")


class Signals:
    """Signals that nobody sends."""

    program: Program

    def to(self, program: Program) -> None:
        self.program = program


@asynccontextmanager
async def supervised(
    client: AsyncClient,
    action: Notes,
    on_revoke: OnRevoke = "term",
    grace_s: float | None = None,
    code: int = -signal.SIGKILL,
) -> AsyncIterator[Supervisor]:
    """A program of 5 GiB, deaf to SIGTERM, until the block ends."""
    command = ["sh", "-c", "trap '' TERM; exec sleep 1000"]
    spec = RunSpec(
        command, "job", 5 << 30, "any", 40, None, False, on_revoke, grace_s, action=action
    )
    supervisor, signals = Supervisor(spec, client, "/bin/sh"), Signals()
    await supervisor.acquire()
    await supervisor.start(signals)
    ended = asyncio.create_task(supervisor.until_ended())
    try:
        yield supervisor
    finally:
        if code < 0:
            signals.program.send_signal(signal.SIGKILL)
        assert await ended == code
        assert not signals.program.running


async def test_requests_in_progress_are_waited_for(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until, capfd: pytest.CaptureFixture[str]
) -> None:
    action = Notes()
    action.work = [2, 1]
    async with (
        asyncio.timeout(PATIENCE_S),
        AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client,
        supervised(client, action) as run,
    ):
        await until(lambda: run.lease.state == "held")
        other = await client.acquire(spec("b", 5), PATIENCE_S)
        assert action.did == ["look", "look", "look", "free 1"]
        assert run.lease.state == "standby"
        await other.release()
        await until(lambda: run.lease.state == "held")
        assert action.did[-1] == "restore 1"
    assert "waiting for 2 requests in progress" in capfd.readouterr().err


async def test_requests_that_never_end_are_waited_for_during_the_grace(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until, capfd: pytest.CaptureFixture[str]
) -> None:
    """Under a steady load there is no moment without requests: its room would never be free.
    Equals that come back take turns: with `priority` the second one waited for ever."""
    action = Notes()
    action.work = [1] * 1000
    async with (
        asyncio.timeout(PATIENCE_S),
        AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client,
        supervised(client, action, "priority", 0.1) as run,
    ):
        for turn in (1, 2):
            await until(lambda: run.lease.state == "held" and run.lease.uses == 1)
            equal = await client.acquire(spec("a", 5, priority=40), PATIENCE_S)
            assert action.did.count("free 1") == turn
            await equal.release()
    assert "requests are still in progress after 0.1 s" in capfd.readouterr().err


async def test_a_lease_that_was_lost_is_replaced(until: Until) -> None:
    """The memory is freed, as for every lease that is lost, and the program is not left without
    for ever."""
    action = Notes()
    arbiter = GrantsAtOnce(ready="ok")
    async with (
        asyncio.timeout(PATIENCE_S),
        arbiter.serving() as endpoint,
        AsyncClient("t", endpoint=endpoint) as client,
        supervised(client, action) as run,
    ):
        await until(lambda: run.lease.state == "held")
        await arbiter.lose()
        await until(lambda: arbiter.grants == 2 and run.lease.state == "held")
        assert action.did == ["look", "free 1", "restore 1"]
        assert run.lease.lease_id == "L1-2"


async def test_a_suspended_program_that_does_not_react_is_ended(
    arbiter_daemon: ArbiterProcess, spec: Spec, until: Until, capfd: pytest.CaptureFixture[str]
) -> None:
    """It waits in a CUDA call, and Ctrl-C would have to wait for room on the GPU."""
    action = Notes(suspends=True)
    async with (
        asyncio.timeout(PATIENCE_S),
        AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client,
        supervised(client, action, grace_s=0.1) as run,
    ):
        await until(lambda: run.lease.state == "held")
        run.asked_to_end(signal.SIGTERM)  # the program hears that itself
        await client.acquire(spec("b", 5), PATIENCE_S)
        run.asked_to_end(signal.SIGTERM)
        await until(lambda: run.lease.state == "gone")
    assert "it is suspended, did not end within 0.1 s" in capfd.readouterr().err


async def test_a_program_that_can_never_return_is_ended(capfd: pytest.CaptureFixture[str]) -> None:
    """Suspended, it would stay for ever: its lease was lost, and a new one is denied."""
    arbiter = GrantsAtOnce(ready="ok")
    arbiter.grants_max = 1
    async with (
        asyncio.timeout(PATIENCE_S),
        arbiter.serving() as endpoint,
        AsyncClient("t", endpoint=endpoint) as client,
        supervised(client, Notes(suspends=True), grace_s=0.1, code=1),
    ):
        await arbiter.lose()
    assert "job cannot return: too large" in capfd.readouterr().err
