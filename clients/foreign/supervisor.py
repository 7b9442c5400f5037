"""One program under one lease after another, from its start to its end.

A program cannot unload, it can only end or be made to free. So it counts as one long use, unless
any request may have its room, and what a revoke does is decided here: `RunSpec.on_revoke` says for
which requests the program makes room, `RunSpec.on_evict` how.
"""

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable, Coroutine
from functools import partial
from http import HTTPStatus
from typing import Final, Protocol

import anyio
import anyio.to_thread

from vram_arbiter.clients import cuda
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.records import Eviction
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.foreign.actions import Action, Deadline
from vram_arbiter.clients.foreign.control import REST, WANT, Control
from vram_arbiter.clients.foreign.http import Request, answer
from vram_arbiter.clients.foreign.peak import Peak
from vram_arbiter.clients.foreign.program import STDERR, ForeignProgram, Program
from vram_arbiter.clients.foreign.run_spec import RunSpec, lease_spec
from vram_arbiter.clients.foreign.say import say
from vram_arbiter.clients.foreign.service import ServiceProgram
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.errors import ActionFailed, CalibrationFailed, VramError
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import Status

log = logging.getLogger(__name__)

PATIENCE_S: Final = 1.0
FIRST_LOOK_S, LOOK_S = 0.2, 1.0  # the arbiter reads the GPU once a second
BUSY_POLL_S: Final = 0.5
HEALTH_POLL_S, HEALTH_TIMEOUT_S = 0.1, 5.0
SUSPENDED_GRACE_S: Final = 5.0
ABANDONED_GRACE_S: Final = 5.0
UNTIL_ENDED: Final = "until it ends"
"""Label of the use of a program that does not come back: a waiter reads in `why` what it is for."""
NO_LEASE: Final = "its lease is over"


class Forwards(Protocol):
    """Passes signals on (`clients.cli.signals.Forwarding`)."""

    def to(self, program: Program) -> None: ...


class Supervisor:
    """Holds the lease, starts the program, and makes room when the arbiter asks."""

    def __init__(self, spec: RunSpec, client: AsyncClient, path: str) -> None:
        self._spec = spec
        self._client = client
        self._path = path
        self._program: Program | None = None
        self._lease: AsyncLease | None = None
        self.peak = Peak(spec.vram_bytes)
        self._signals: Forwards | None = None
        self._over: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._tasks: set[asyncio.Task[None]] = set()
        self._wake = asyncio.Event()
        self._leave = asyncio.Event()  # the program is to make room, and comes back
        self._away = False  # its action has freed its memory
        self._ending = False  # it is made to end for good
        self._abandoned = False  # the program that controls it has ended
        self._reason = NO_LEASE  # said when the program is made to leave
        self._told: set[str] = set()  # waiters that were named to the user

    async def acquire(self) -> None:
        """Wait for the first lease. Raises the typed error of one that was not granted."""
        if self._spec.control is not None:
            self._spawn(self._obey(self._spec.control))
        self._lease = await self._acquire(self._spec.wait_timeout_s)

    async def still_wanted(self) -> bool:
        """Return whether to start the program. A service that another program controls, and does
        not want, is only adopted: where it has ended, its lease is released."""
        service, control = self._spec.service, self._spec.control
        if service is None or control is None:
            return True
        place, _ = await _in_thread(service.look)
        if place or control.wanted.is_set():
            return True
        say(f"{service.name} has ended, and is not wanted")
        await self.lease.release(exiting=True)
        self._tell("gone", self.lease)
        return False

    async def start(self, signals: Forwards) -> None:
        """Start the program. Raises OSError, and what its record raises, with the lease
        released."""
        self._signals = signals
        try:
            if self._spec.record is not None:
                self._spec.record.begin()
            await self._start()
        except (OSError, VramError):
            await self.lease.release()
            raise

    async def until_ended(self) -> int:
        """Keep the program and its lease together. Return the program's exit code. Raises what its
        record raises."""
        self._spawn(self._follow())
        self._spawn(self._watch())
        if self._spec.limit_s is not None:
            self._spawn(self._expire(self._spec.limit_s))
        code = await self._over
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._program is not None:
            await self._program.end(self._grace_s)  # where it has not ended itself
            if self._spec.tends_orphans:
                await self._program.end_orphans()
        try:
            if self._spec.record is not None:
                self._check_undisturbed()
                self._spec.record.end()
        finally:
            say(self.peak.text())
            await self.lease.release(exiting=True)
        return code

    def _check_undisturbed(self) -> None:
        """Raises CalibrationFailed where the program did not have its lease until it ended."""
        if self._ending or self.lease.state == "gone":
            raise CalibrationFailed(
                f"the GPU is needed: {self._reason}",
                hint="nothing was written; calibrate again while the robot is idle",
            )

    def asked_to_end(self, number: signal.Signals) -> None:
        """Take a signal that asks the program to end: it is not started again, and not resumed."""
        program = self._program
        if program is not None and program.stopping:
            self._finish(-number)
        elif program is not None and self._suspended:
            self._spawn(self._end_suspended(program))
        elif program is not None and self._spec.service is not None:
            program.send_signal(number)  # a terminal does not reach it

    @property
    def lease(self) -> AsyncLease:
        assert self._lease is not None, "not acquired yet"
        return self._lease

    @property
    def _suspended(self) -> bool:
        """Whether the program waits in CUDA calls, where its own signal handlers may not run."""
        return self._spec.action is not None and self._spec.action.suspends and self._away

    @property
    def _grace_s(self) -> float | None:
        given = ABANDONED_GRACE_S if self._abandoned else self._spec.grace_s
        return SUSPENDED_GRACE_S if given is None and self._suspended else given

    # -- the program
    async def _start(self) -> None:
        if self._spec.service is not None:
            self._program = ServiceProgram(self._spec.service)
        else:
            environ = {**_environ(self.lease), **self._spec.environ}
            out = None if self._spec.record is None else STDERR
            arguments = self._spec.command[1:]
            self._program = await ForeignProgram.start(self._path, arguments, environ, out)
        assert self._signals is not None
        self._signals.to(self._program)
        self._spawn(self._until_exit(self._program))

    async def _until_exit(self, program: Program) -> None:
        code = await program.wait()
        if not program.stopping:
            self._finish(code)

    async def _end(self) -> None:
        """End the program, for good or until there is room again."""
        program = self._program
        if program is None or not program.running or program.stopping:
            return
        program.stopping = self._spec.comes_back
        say(f"{self._reason}; ending it")
        if await program.end(self._spec.grace_s):
            say(f"it did not end within {self._spec.grace_s:g} s and was killed")
        if self._spec.tends_orphans and (count := await program.end_orphans()):
            say(f"ended {count} of its processes that outlived it")

    async def _expire(self, limit_s: float) -> None:
        await asyncio.sleep(limit_s)
        assert self._program is not None
        self._program.stopping = True
        say(f"ending it after {limit_s:g} s")
        await self._program.end(self._spec.grace_s)
        await self._program.end_orphans()
        self._finish(0)

    async def _end_suspended(self, program: Program) -> None:
        grace_s = self._grace_s
        if await program.end(grace_s):
            say(f"it is suspended, did not end within {grace_s:g} s, and was killed")

    def _finish(self, code: int) -> None:
        if not self._over.done():
            self._over.set_result(code)

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        self._tasks.add(asyncio.create_task(work))

    # -- its lease
    async def _acquire(self, wait_timeout_s: float | None) -> AsyncLease:
        unload: dict[str, Callable[[], object] | None] = {
            "pin": None,
            "term": self._unload,
            "priority": self._unload if self._spec.comes_back else self._ended,
        }
        self._tell("queued")
        acquiring = self._client.acquire(
            lease_spec(self._spec),
            wait_timeout_s,
            unload=unload[self._spec.on_revoke],
            park=self._free if self._spec.park_bytes else None,
            on_revoke=self._revoke_asked,
            on_lost=self._lost,
        )
        lease = await _tell_why(self._client, asyncio.ensure_future(acquiring), self._spec.consumer)
        self._tell("loading", lease)
        return lease

    def _tell(self, state: str, lease: AsyncLease | None = None) -> None:
        if (control := self._spec.control) is None:
            return
        if lease is None:
            control.tell(state, "", (), "", "")
            return
        reason = lease.evicted.reason if lease.evicted is not None else ""
        control.tell(state, lease.lease_id, lease.token, lease.gpu, reason)

    async def _obey(self, control: Control) -> None:
        """Do what the program on the control socket says; end with it."""
        async for order in control.orders():
            if order == WANT:
                control.wanted.set()
            elif order == REST:
                control.wanted.clear()
                self._reason = "it is not wanted any more"
                self._spawn(self._rest())
        if self._lease is None:  # nothing was started
            signal.raise_signal(signal.SIGTERM)
        self._abandoned = True
        self._finish(-signal.SIGTERM)

    async def _rest(self) -> None:
        """Leave the GPU until wanted."""
        with contextlib.suppress(VramError):  # it leaves already
            if self._spec.park_bytes:
                await self.lease.park()
            else:
                await self.lease.give_up()

    async def _follow(self) -> None:
        """Hold the lease while the program is resident; get it back where it was evicted."""
        await self._resident()
        if not self._spec.comes_back:
            return
        try:
            while True:
                await self._regain()
                self._reason = NO_LEASE
                self._leave.clear()
                self._told.clear()
                if not await self._restore():
                    return
                await self._resident()
        except (VramError, OSError) as error:  # the program is away, and cannot return
            say(f"{self._spec.consumer} cannot return: {error}")
            self._finish(1)

    async def _resident(self) -> None:
        """Return when the program's bytes are freed: it is away, or its lease is over."""
        lease = self.lease
        holding = asyncio.create_task(self._hold(lease))
        try:
            if not self._spec.comes_back:
                await holding
            state = lease.state
            while state not in ("standby", "parked", "gone"):
                self._tell(state, lease)
                state = await lease.wait_change(state)
        finally:
            holding.cancel()
        if state == "gone":
            await lease.wait_gone()
        if self._spec.control is not None:
            self._spec.control.wanted.clear()
        self._tell(state, lease)

    async def _hold(self, lease: AsyncLease) -> None:
        """Count the program as one long use until it is to make room, unless any request may have
        that."""
        try:
            if not await self._serves():
                return
            await lease.ready()
            state = lease.state
            while self._spec.on_revoke != "term" and state == "held":
                async with lease.use("" if self._spec.comes_back else UNTIL_ENDED):
                    await self._leave.wait()
                self._leave.clear()
                state = await lease.wait_change("revoking")  # held again: it was withdrawn
        except VramError as error:
            log.warning("%s: %s", lease.lease_id, error)

    async def _serves(self) -> bool:
        """Wait until the program answers, if it says where. Return whether it does; else it is
        ended."""
        healthy = not self._spec.health
        try:
            async with asyncio.timeout(self._spec.start_s):
                while not healthy:
                    await asyncio.sleep(HEALTH_POLL_S)
                    healthy = await _in_thread(_healthy, self._spec.health)
        except TimeoutError:
            say(f"{self._spec.health} did not answer 200 within {self._spec.start_s:g} s")
            self._finish(1)
            return False
        return True

    async def _regain(self) -> None:
        """Wait until the program may return: by itself from standby, else as a new waiter."""
        lease, evicted = self.lease, self.lease.evicted
        asked = evicted is not None and evicted.cause == "operator"
        if (control := self._spec.control) is not None:
            await control.wanted.wait()
            asked = True
        if lease.state == "parked" and asked:  # it would not return by itself
            self._tell("queued")
            await lease.reacquire()
            self._tell("loading", lease)
            return
        if lease.state != "gone":
            with contextlib.suppress(VramError):  # lost meanwhile
                await lease.wait_returned()
                return
        self._lease = await self._acquire(None)

    async def _restore(self) -> bool:
        """Bring the program back under its lease. Return whether it holds one."""
        if self._program is None or self._program.stopping:
            say("there is room again: starting it")
            await self._start()
            return True
        assert self._spec.action is not None
        try:
            await _in_thread(self._spec.action.restore, self._program.tree())
        except VramError as error:
            say(f"{error}; its lease is released, and the program continues without one")
            await self.lease.release()
            return False
        self._away = False
        say("there is room again: restored")
        return True

    # -- revoke
    async def _revoke_asked(self, lease: AsyncLease, eviction: Eviction) -> None:
        self._reason = eviction.reason
        self._wake.set()

    async def _lost(self, lease: AsyncLease, error: VramError) -> None:
        say(f"{lease.lease_id} was lost: {error}")

    async def _ended(self) -> None:
        if self._program is not None:
            await self._program.wait()

    async def _unload(self) -> None:
        """Make room without host RAM: it has none for this program, or the lease was lost."""
        evicted = self._lease is not None and self._lease.state != "gone"
        if self._spec.action is None:
            await self._end()
        elif self._spec.park_bytes and evicted:
            wanted = format_bytes(self._spec.park_bytes)
            self._reason += f"; the arbiter has no {wanted} of host RAM for its weights"
            await self._end()
        else:
            await self._free()

    async def _free(self) -> None:
        """Let the program free its memory, after its requests in progress."""
        program, action = self._program, self._spec.action
        assert action is not None
        if program is None or not program.running:
            return
        await self._quiesce(action)
        say(f"{self._reason}; freeing by {action.name}")
        try:
            self._away = True
            await _in_thread(action.free, program.tree())
        except VramError as error:
            self._away = False
            say(f"{error}; the arbiter measures what the program retains: vramctl status")

    async def _quiesce(self, action: Action) -> None:
        """Wait until no request is in progress, where the program says so, or the grace is over."""
        told = False
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._spec.grace_s):
                while count := await _in_thread(action.busy):
                    if not told:
                        say(f"{self._reason}; waiting for {count} requests in progress")
                    told = True
                    await asyncio.sleep(BUSY_POLL_S)
                return
        say(f"requests are still in progress after {self._spec.grace_s:g} s")

    # -- what the arbiter sees
    async def _watch(self) -> None:
        """Measure the peak, and see which requests the program keeps waiting."""
        pause_s = FIRST_LOOK_S
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), pause_s)
            self._wake.clear()
            self._decide(None)
            with contextlib.suppress(VramError):
                status = await self._client.ask(Status())  # its first page has all queues' heads
                self.peak.measure(status, self.lease.lease_id)
                self._decide(status)
            if self._program is not None and self._program.running and self._spec.tends_orphans:
                # not while its successor is started, whose status it could take
                self._program.reap()
            pause_s = LOOK_S

    def _decide(self, status: StatusReply | None) -> None:
        """Leave where a revoke is for a higher priority, or for an equal one where the program
        comes back. A request that came after the revoke is seen in `status`."""
        lease, spec = self.lease, self._spec
        eviction = lease.evicted
        if eviction is None or self._ending or self._leave.is_set() or spec.on_revoke != "priority":
            return
        waiting = [
            (view.consumer, view.priority)
            for view in (() if status is None else status.leases)
            if view.state == "queued" and view.gpu in (None, lease.gpu)
        ]
        asked_by = spec.priority + 1 if eviction.priority is None else eviction.priority
        waiting.append((eviction.by, asked_by))
        consumer, priority = max(waiting, key=lambda one: one[1])
        # equals take turns where both come back; a program that would be ended for good stays
        if priority > spec.priority or (spec.comes_back and priority == spec.priority):
            self._reason = (
                eviction.reason if consumer == eviction.by else f"{consumer} needs the room"
            )
            if spec.comes_back:
                self._leave.set()
            elif not self._ending:  # it stays in use until it has ended
                self._ending = True
                self._spawn(self._end())
        elif consumer not in self._told:
            self._told.add(consumer)
            say(
                f"{consumer} waits for its room (priority {priority}): it gets it when the program "
                "ends"
            )


def _healthy(url: str) -> bool:
    try:
        return answer(Request(url, "GET"), Deadline(HEALTH_TIMEOUT_S)).status == HTTPStatus.OK
    except ActionFailed:
        return False


async def _in_thread[T](work: Callable[..., T], *arguments: object) -> T:
    """Run what blocks; canceled, it is left to itself."""
    own_thread = anyio.CapacityLimiter(1)
    return await anyio.to_thread.run_sync(
        partial(work, *arguments), abandon_on_cancel=True, limiter=own_thread
    )


async def _tell_why(
    client: AsyncClient, acquiring: asyncio.Future[AsyncLease], consumer: str
) -> AsyncLease:
    """Return the lease. Say once, on stderr, what a long wait is for."""
    try:
        done, _ = await asyncio.wait({acquiring}, timeout=PATIENCE_S)
        if not done:
            for entry in (await client.why(consumer)).leases:
                if entry.state == "queued":
                    say(f"waiting: {entry.text}")
        return await acquiring
    finally:
        acquiring.cancel()


def _environ(lease: AsyncLease) -> dict[str, str]:
    return {
        **os.environ,
        **traces.environ(),
        **cuda.visible(lease.gpu, os.environ),
        "VRAM_LEASE_ID": lease.lease_id,
        "VRAM_LEASE_TOKEN": f"{lease.token[0]}.{lease.token[1]}",
        "VRAM_LEASE_GPU": lease.gpu,
    }
