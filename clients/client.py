"""The arbiter's client for asyncio programs.

    async with AsyncClient(name="detector") as client:
        async with client.lease(spec, unload=model.unload) as lease:
            await model.load()
            await lease.ready(model.allocated_bytes())
            async with lease.use("detect"):
                ...

It joins `clients._protocol.protocol` (what to say) to a socket (how) and to `clients.lease` (what the holder sees). Everything runs on
the loop of `connect`; reading is draining libzmq's file descriptor, as the daemon does. Renewals, reconnects, re-attachment,
acknowledgements and fencing happen by themselves in the background. It must not know models or robots.
"""

import asyncio
import contextlib
import logging
import os
import time
import uuid
from collections.abc import AsyncIterator, Awaitable, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, Self

from vram_arbiter.clients import use_context as inside
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.clients.eviction import Unload
from vram_arbiter.clients.lease import (
    AsyncForeignUse,
    AsyncLease,
    Callbacks,
    OnLost,
    OnReturn,
    OnRevoke,
    SafePointEta,
)
from vram_arbiter.clients.net.dealer import Transport
from vram_arbiter.clients.net.diagnose import START, obstacle
from vram_arbiter.clients.net.timeouts import answered
from vram_arbiter.schemas.errors import ArbiterUnreachable, VramError
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.wire.requests import Gang, LeaseSpec

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 5.0
BYE_TIMEOUT_S = 1.0
LEAVE_TIMEOUT_S = 30.0  # as long as the arbiter's own ladder gives a holder
REOPEN_S = 0.05  # between two sockets, so that a server that hangs up at once is not hammered
SUBSCRIBER_QUEUE_MAX = 10_000  # events; a subscriber that does not read loses the oldest


class AsyncClient:
    """One connection to the arbiter. `async with`, or `connect` and `close`. Use it on one loop, in one process.

    `name` is what `vramctl` shows. Raises ArbiterUnreachable from `connect` after `connect_timeout_s` without an answer, UntrustedServer;
    later losses of contact are ridden out.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        name: str,
        role: str = "client",
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self.endpoint = endpoint or arbiter_endpoint(os.environ, os.getuid())
        self.protocol = ClientProtocol(
            name=name, instance=f"{os.getpid()}-{uuid.uuid4().hex[:8]}", role=role
        )
        self._connect_timeout_s = connect_timeout_s
        self._transport: Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._greeted: asyncio.Future[None] | None = None
        self._replies: dict[int, asyncio.Future[r.Message]] = {}
        self._acquires: dict[str, tuple[asyncio.Future[AsyncLease], LeaseSpec, Callbacks]] = {}
        self._leases: dict[str, AsyncLease] = {}
        self._foreign: dict[str, AsyncForeignUse] = {}
        self._subscribers: set[asyncio.Queue[r.Message]] = set()
        self._tasks: dict[asyncio.Task[None], None] = {}  # in the order of their beginning
        self._closing = False
        self._lost = False
        self._distrusted = False  # of the present loss of contact

    # -- connection ------------------------------------------------------------------------------------------------
    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @property
    def connected(self) -> bool:
        return self.protocol.connection.phase == "up"

    @property
    def epoch(self) -> int | None:
        """Which start of the daemon this is; None before the first greeting."""
        return self.protocol.connection.epoch

    @property
    def leases(self) -> Sequence[AsyncLease]:
        """Leases that this client holds now."""
        return tuple(lease for lease in self._leases.values() if lease.state != "gone")

    async def connect(self) -> None:
        """Raises ArbiterUnreachable, UntrustedServer, or the arbiter's own refusal (VersionMismatch, NotPermitted, LimitExceeded)."""
        if self._transport is not None:
            return
        self._greeted = asyncio.get_running_loop().create_future()
        self._open()
        try:
            await answered(self._greeted, self._connect_timeout_s)
        except TimeoutError:
            self._shut()
            silent = f"no arbiter answers at {self.endpoint} within {self._connect_timeout_s:g} s"
            message, hint = obstacle(self.endpoint) or (silent, START)
            raise ArbiterUnreachable(
                message, hint=hint, details={"endpoint": self.endpoint}
            ) from None
        except BaseException:
            self._shut()
            raise

    async def close(self) -> None:
        """Give up every lease (at its safe point, running its `unload`), say bye, close the socket.

        A lease that others still use after 30 s is left to the arbiter: it goes with the connection.
        """
        if self._transport is None:
            return
        self._closing = True
        leaving = [asyncio.ensure_future(lease.give_up()) for lease in self._leases.values()]
        try:
            if leaving and (await asyncio.wait(leaving, timeout=LEAVE_TIMEOUT_S))[1]:
                log.warning("closing although leases are still in use: %s", self.leases)
            if self.connected:
                with contextlib.suppress(VramError):
                    await self.reply(
                        self.protocol.connection.request(
                            "bye", {}, self.now(), timeout_s=BYE_TIMEOUT_S
                        )
                    )
        finally:
            for leave in leaving:
                leave.cancel()
            self._shut()

    # -- leases ------------------------------------------------------------------------------------------------------
    async def acquire(
        self,
        spec: LeaseSpec,
        wait_timeout_s: float | None = None,
        *,
        unload: Unload | None = None,
        park: Unload | None = None,
        on_return: OnReturn | None = None,
        on_revoke: OnRevoke | None = None,
        on_lost: OnLost | None = None,
        safe_point_eta_s: SafePointEta | None = None,
        traceparent: str | None = None,
    ) -> AsyncLease:
        """Wait for a lease; returns when it is granted (state `loading`): load the model now, then `lease.ready()`.

        With `spec.standby` or `park` the lease may be evicted and come back under the same object: `on_return` loads then, as
        the caller does after this first grant. The arbiter's part of the wait joins the present trace, or the one of `traceparent`.

        Raises WaitTimeout (details.why: who blocked), VramInsufficient, UnknownGpu, HolderBusy, LimitExceeded; from inside a use also
        WouldDeadlock, if that use is in its own way (`clients.use_context`).
        Cancelling the caller gives the place in the queue, or the lease, back.
        """
        if not inside.a_use():
            spec = spec.model_copy(update={"independent": True})
        nonce = self.new_id()
        granted: asyncio.Future[AsyncLease] = asyncio.get_running_loop().create_future()
        callbacks = Callbacks(
            unload=unload,
            park=park,
            on_return=on_return,
            on_revoke=on_revoke,
            on_lost=on_lost,
            safe_point_eta_s=safe_point_eta_s,
        )
        self._acquires[nonce] = (granted, spec, callbacks)
        self.protocol.waits.acquire(
            nonce,
            spec.model_dump(mode="json"),
            self.now(),
            wait_timeout_s=wait_timeout_s,
            traceparent=traceparent or traces.present(),
        )
        self.pump()
        try:
            return await granted
        except asyncio.CancelledError:
            if granted.done() and not granted.cancelled() and granted.exception() is None:
                self.spawn(
                    granted.result().release(), f"cancelled acquire {nonce}"
                )  # nothing was loaded yet
            else:
                self.protocol.waits.cancel(nonce, self.now())
                self.pump()
            raise
        finally:
            self._acquires.pop(nonce, None)

    @asynccontextmanager
    async def lease(
        self,
        spec: LeaseSpec,
        wait_timeout_s: float | None = None,
        *,
        unload: Unload | None = None,
        park: Unload | None = None,
        on_return: OnReturn | None = None,
        on_revoke: OnRevoke | None = None,
        on_lost: OnLost | None = None,
        safe_point_eta_s: SafePointEta | None = None,
    ) -> AsyncIterator[AsyncLease]:
        """`acquire`, and at the end of the block: unload and release, also when the block raises."""
        lease = await self.acquire(
            spec,
            wait_timeout_s,
            unload=unload,
            park=park,
            on_return=on_return,
            on_revoke=on_revoke,
            on_lost=on_lost,
            safe_point_eta_s=safe_point_eta_s,
        )
        try:
            yield lease
        finally:
            await lease.give_up()

    async def gang(
        self, specs: Sequence[LeaseSpec], wait_timeout_s: float | None = None
    ) -> AsyncIterator[tuple[int, AsyncLease]]:
        """All of these leases or none: `async for index, lease in client.gang([policy, reward]): load, then await lease.ready()`.

        One is granted after the other, each as the one before is ready. Raises GangBroken, VramInsufficient, WaitTimeout; what was
        granted until then stays the caller's to give up.
        """
        gang = Gang(
            id=f"{self.protocol.connection.instance}/{uuid.uuid4().hex[:12]}", size=len(specs)
        )

        async def member(index: int, spec: LeaseSpec) -> tuple[int, AsyncLease]:
            return index, await self.acquire(spec.model_copy(update={"gang": gang}), wait_timeout_s)

        waiting = [asyncio.ensure_future(member(index, spec)) for index, spec in enumerate(specs)]
        taken: set[int] = set()
        try:
            for granted in asyncio.as_completed(waiting):
                index, lease = await granted
                taken.add(index)
                yield index, lease
        finally:
            for task in waiting:
                task.cancel()
            for found in await asyncio.gather(*waiting, return_exceptions=True):
                if not isinstance(found, BaseException) and found[0] not in taken:
                    await found[
                        1
                    ].release()  # granted while the caller turned away: nothing was loaded

    async def begin_use(
        self,
        lease_id: str,
        token: Sequence[int],
        label: str = "",
        *,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> AsyncForeignUse:
        """Begin a use on a lease of another process, whose token was handed to us. Raises LeaseRevoking, StaleToken, LeaseLost …"""
        pair = (int(token[0]), int(token[1]))
        use = AsyncForeignUse(
            self, lease_id, pair, f"{self.protocol.connection.instance}/{self.new_id()}"
        )
        request = self.protocol.foreign_uses.begin(
            lease_id,
            pair,
            use.use_id,
            label,
            self.now(),
            timeout_s=timeout_s,
            traceparent=traces.present(),
        )
        self._foreign[use.use_id] = use
        try:
            await self.reply(request)
        except BaseException:
            await use.end()
            raise
        inside.enter(use.use_id)
        return use

    @asynccontextmanager
    async def use(
        self, lease_id: str, token: Sequence[int], label: str = ""
    ) -> AsyncIterator[AsyncForeignUse]:
        """`begin_use` as a block: the lease's holder is not made to leave inside it."""
        use = await self.begin_use(lease_id, token, label)
        try:
            yield use
        finally:
            await use.end()

    # -- questions ---------------------------------------------------------------------------------------------------
    async def ask(
        self,
        op: str,
        fields: Mapping[str, Any] | None = None,
        *,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> r.Message:
        """Any request of `schemas.wire` that has no method here."""
        return await self.reply(
            self.protocol.connection.request(
                op, traces.along(fields), self.now(), timeout_s=timeout_s
            )
        )

    async def status(self) -> r.Message:
        """`schemas.wire.StatusReply`, with the leases of all its pages. Leases that move meanwhile are listed once, or not at all."""
        shown = await self.ask("status")
        leases = {lease["lease_id"]: lease for lease in shown["leases"]}
        after = shown.pop("next", None)
        while after is not None:
            page = await self.ask("status", {"after": after})
            leases |= {lease["lease_id"]: lease for lease in page["leases"]}
            after = page.get("next")
        return {**shown, "leases": list(leases.values())}

    async def why(self, consumer: str) -> r.Message:
        """`schemas.wire.WhyReply`: who blocks this consumer, how many bytes, on which condition, what happens next."""
        return await self.ask("why", {"consumer": consumer})

    async def history(
        self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()
    ) -> r.Message:
        """Events after sequence number `after`, oldest first."""
        return await self.ask("history", {"after": after, "limit": limit, "kinds": list(kinds)})

    async def ping(self, *, timeout_s: float = 2.0) -> r.Message:
        return await self.ask("ping", timeout_s=timeout_s)

    async def subscribe(self) -> AsyncIterator[r.Message]:
        """History events from now on, also across restarts of the arbiter. One that does not read loses the oldest."""
        queue: asyncio.Queue[r.Message] = asyncio.Queue(SUBSCRIBER_QUEUE_MAX)
        self._subscribers.add(queue)
        try:
            await self.reply(self.protocol.subscribe(self.now()))
            while True:
                yield await queue.get()
        finally:
            self._subscribers.discard(queue)

    # -- for leases (`clients.eviction.Driver`) -----------------------------------------------------------------------
    def now(self) -> float:
        return time.monotonic()

    def new_id(self) -> str:
        return uuid.uuid4().hex

    async def reply(self, request_id: int) -> r.Message:
        if self._transport is None:
            raise ArbiterUnreachable("this client is closed", hint="use it inside `async with`")
        answer: asyncio.Future[r.Message] = asyncio.get_running_loop().create_future()
        self._replies[request_id] = answer
        try:
            self.pump()
            return await answer
        finally:
            if self._replies.pop(request_id, None) is not None and not answer.done():
                self.protocol.connection.forget(request_id)

    def spawn(self, work: Awaitable[None], name: str) -> asyncio.Task[None]:
        async def run() -> None:
            try:
                await work
            except VramError as error:
                log.warning("%s: %s", name, error)

        task = asyncio.get_running_loop().create_task(run(), name=name)
        self._tasks[task] = None
        task.add_done_callback(lambda done: self._tasks.pop(done, None))
        return task

    def pump(self) -> None:
        """Perform what the protocol wants: send, tell, re-arm the timer. Called after whatever may have changed it."""
        transport = self._transport
        if transport is None:
            return
        while True:
            for message in self.protocol.connection.take_outgoing():
                if not transport.send(message):
                    self.protocol.connection.contact_lost("the socket takes no more messages")
                    break
            events = self.protocol.connection.take_events()
            if not events:
                break
            for event in events:
                self._tell(event)
            if self._transport is not transport:
                return
        self._arm()

    # -- steps -------------------------------------------------------------------------------------------------------
    def _open(self) -> None:
        loop = asyncio.get_running_loop()
        if self._transport is not None:
            self._transport.close()
        self._transport = self._new_transport(loop)
        self.protocol.connection.connected(self.now())
        self.pump()

    def _new_transport(self, loop: asyncio.AbstractEventLoop) -> Transport:
        return Transport(
            self.endpoint, loop, self._received, self._hung_up, self._refused, program="arbiter"
        )

    def _shut(self) -> None:
        """Close the socket; whoever still waits is told."""
        if self._timer is not None:
            self._timer.cancel()
        if self._transport is not None:
            self._transport.close()
        self._transport = self._timer = None
        self.protocol.connection.contact_lost("closed")
        self.protocol.connection.take_events()
        closed = ArbiterUnreachable(
            "the client was closed", hint="keep it open while leases are wanted"
        )
        for answer in self._replies.values():
            if not answer.done():
                answer.set_exception(closed)
        for granted, _, _ in self._acquires.values():
            if not granted.done():
                granted.set_exception(closed)
        for task in self._tasks:
            task.cancel()

    def _received(self, message: r.Message) -> None:
        self.protocol.connection.receive(message, self.now())
        if self._transport is not None:
            self.pump()

    def _hung_up(self) -> None:
        self.protocol.connection.contact_lost("the arbiter hung up")
        if self._transport is not None:
            self.pump()

    def _refused(self, error: VramError) -> None:
        """Another user's process listens there. It was told nothing; the greeting's own deadline leads to the next try."""
        if self._greeted is not None and not self._greeted.done():
            self._greeted.set_exception(error)
        elif not self._distrusted:
            log.error("%s", error)
        self._distrusted = True

    def _ticked(self) -> None:
        self._timer = None
        if self._transport is not None:
            self.protocol.tick(self.now())
            self.pump()

    def _reopen(self) -> None:
        if self._transport is not None and self.protocol.connection.phase == "down":
            self._open()

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        deadline = self.protocol.next_deadline()
        if deadline is not None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(max(0.0, deadline - self.now()), self._ticked)

    def _tell(self, event: r.Event) -> None:
        match event:
            case r.Up():
                self._lost = self._distrusted = False
                if self._greeted is not None and not self._greeted.done():
                    self._greeted.set_result(None)
                else:
                    log.info("back in contact with the arbiter (epoch %s)", event.epoch)
            case r.ContactLost():
                if not self._closing:  # said once, however often a reconnect fails; `connect` says it before the first contact
                    greeting = self._greeted is not None and not self._greeted.done()
                    level = logging.DEBUG if self._lost or greeting else logging.WARNING
                    log.log(level, "contact to the arbiter lost: %s", event.reason)
                self._lost = True
                asyncio.get_running_loop().call_later(REOPEN_S, self._reopen)
            case r.Refused():
                if self._greeted is not None and not self._greeted.done():
                    self._greeted.set_exception(event.error)
                else:
                    log.warning("the arbiter refuses this client: %s", event.error)
            case r.Replied():
                if answer := self._waiting(event.request_id):
                    answer.set_result(event.body)
            case r.Failed():
                if answer := self._waiting(event.request_id):
                    answer.set_exception(event.error)
            case r.Granted():
                self._granted(event)
            case r.Denied():
                if (entry := self._acquires.get(event.nonce)) and not entry[0].done():
                    entry[0].set_exception(event.error)
            case r.RevokeAsked():
                if lease := self._leases.get(event.record.lease_id):
                    lease.revoke_asked(event.push, event.first)
            case r.Gone():
                if lease := self._leases.get(event.record.lease_id):
                    lease.lost(event.error, event.fenced)
            case r.Returned():
                if lease := self._leases.get(event.record.lease_id):
                    lease.returned()
            case r.Resized():
                if lease := self._leases.get(event.record.lease_id):
                    lease.resized(event.error)
            case r.UseLost():
                if use := self._foreign.get(event.use_id):
                    use.lost = event.error
            case r.HistoryEvent():
                for queue in self._subscribers:
                    if queue.full():
                        queue.get_nowait()
                    queue.put_nowait(event.event)

    def _waiting(self, request_id: int) -> asyncio.Future[r.Message] | None:
        answer = self._replies.get(request_id)
        return answer if answer is not None and not answer.done() else None

    def _granted(self, event: r.Granted) -> None:
        entry = self._acquires.get(event.nonce)
        if entry is None or entry[0].done():  # the caller was cancelled in this very moment
            self.protocol.holdings.release(event.record, False, self.now(), REQUEST_TIMEOUT_S)
            return
        granted, spec, callbacks = entry
        lease = AsyncLease(self, event.record, spec, callbacks)
        self._leases[lease.lease_id] = lease
        self.spawn(self._forget_when_over(lease), f"life of {lease.lease_id}")
        granted.set_result(lease)

    async def _forget_when_over(self, lease: AsyncLease) -> None:
        await lease.wait_gone()
        self._leases.pop(lease.lease_id, None)
