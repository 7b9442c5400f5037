"""One connection of a client: its socket, its protocol, its background tasks, its leases.

It joins the sans-IO protocol (`clients._protocol.protocol`: what to say) to a socket
(`clients.net.dealer`: how) and to leases (`clients.lease`: what the holder sees). Renewal,
reconnect, reattachment, acknowledgement and fencing are tasks of its task group. It must not know
how callers ask for things; that is `clients.client`.
"""

import contextlib
import logging
import os
import time
import uuid
from collections.abc import AsyncGenerator, Awaitable, Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self, cast

import anyio
from anyio.abc import TaskGroup
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream

from vram_arbiter.clients import use_context
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.clients.handlers import Handlers
from vram_arbiter.clients.lease import AsyncForeignUse, AsyncLease
from vram_arbiter.clients.net.answer import Answer
from vram_arbiter.clients.net.dealer import Dealer, Transport
from vram_arbiter.clients.net.diagnose import START, obstacle
from vram_arbiter.schemas.errors import ArbiterUnreachable, BadState, VramError
from vram_arbiter.schemas.ids import LeaseId, Token, UseId
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.spec import LeaseSpec

log = logging.getLogger(__name__)

type _Events = tuple[MemoryObjectSendStream[JsonMap], MemoryObjectReceiveStream[JsonMap]]

BYE_TIMEOUT_S: Final = 1.0
LEAVE_TIMEOUT_S: Final = 30.0  # as long as the arbiter's own ladder gives a holder
REOPEN_S: Final = (
    0.05  # between two sockets, so that a server that hangs up at once is not hammered
)
SUBSCRIBER_QUEUE_MAX: Final = 10_000  # events; a subscriber that does not read loses the oldest


@dataclass(frozen=True, slots=True)
class _Wait:
    """A lease that is waited for."""

    granted: Answer[AsyncLease]
    spec: LeaseSpec
    handlers: Handlers[AsyncLease]


class Session:
    """Open inside `async with`, for one event loop and one process (`clients.eviction.Driver`)."""

    def __init__(self, name: str, endpoint: str, role: w.Role, connect_timeout_s: float) -> None:
        self.endpoint = endpoint
        self.protocol = ClientProtocol(
            name=name, instance=f"{os.getpid()}-{uuid.uuid4().hex[:8]}", role=role
        )
        self.on_prepare: Callable[[str], object] | None = None
        self._waits: dict[str, _Wait] = {}
        self._leases: dict[str, AsyncLease] = {}
        self._foreign_uses: dict[str, AsyncForeignUse] = {}
        self._subscribers: list[_Events] = []
        self._connect_timeout_s = connect_timeout_s
        self._open = False
        self._closing = False
        self._tasks: TaskGroup | None = None
        self._spawned: dict[int, anyio.CancelScope] = {}  # in the order of their beginning
        self._serial = 0
        self._dealer: Transport | None = None
        self._contact_lost = anyio.Event()
        self._greeted: Answer[None] = Answer()
        self._alarm_at = float("inf")
        self._alarm_moved = anyio.Event()
        self._replies: dict[int, Answer[AnyReply] | Answer[AnyReply | None]] = {}
        self._until_loss: dict[int, Answer[AnyReply | None]] = {}
        self._lost = False
        self._distrusted = False  # since the last contact

    async def __aenter__(self) -> Self:
        if self._open:
            raise BadState("this client is open already", hint="make another one")
        self._tasks = anyio.create_task_group()
        await self._tasks.__aenter__()
        self._open, self._closing, self._greeted = True, False, Answer()
        self._tasks.start_soon(self._stay_connected, name="arbiter connection")
        self._tasks.start_soon(self._keep_time, name="arbiter deadlines")
        try:
            await self._greeted.within(self._connect_timeout_s)
        except TimeoutError:
            await self._shut()
            silent = f"no arbiter answers at {self.endpoint} within {self._connect_timeout_s:g} s"
            message, hint = obstacle(self.endpoint) or (silent, START)
            raise ArbiterUnreachable(
                message, hint=hint, details={"endpoint": self.endpoint}
            ) from None
        except BaseException:
            await self._shut()
            raise
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give up every lease (at its safe point, running its `unload`), say bye, close the socket.

        A lease that other processes still use after 30 s ends with the connection.
        """
        self._closing = True
        try:
            with anyio.move_on_after(LEAVE_TIMEOUT_S, shield=True):
                await self._give_up_all()
            if self.held:
                log.warning("closing although leases are still in use: %s", self.held)
            if self.connected:
                with contextlib.suppress(VramError), anyio.CancelScope(shield=True):
                    await self.ask(w.Bye(), BYE_TIMEOUT_S)
        finally:
            await self._shut()

    @property
    def connected(self) -> bool:
        """Whether the arbiter answered this connection's hello."""
        return self.protocol.connection.phase == "up"

    @property
    def held(self) -> tuple[AsyncLease, ...]:
        return tuple(lease for lease in self._leases.values() if lease.state != "gone")

    # -- for the client
    async def acquire(
        self,
        spec: LeaseSpec,
        handlers: Handlers[AsyncLease],
        wait_timeout_s: float | None,
        traceparent: str | None,
    ) -> AsyncLease:
        """Wait for a lease; canceling gives the place in the queue, or the lease, back."""
        self.check_open()
        nonce = self.new_id()
        granted: Answer[AsyncLease] = Answer()
        self._waits[nonce] = _Wait(granted, spec, handlers)
        self.protocol.waits.acquire(
            nonce,
            spec,
            self.now(),
            wait_timeout_s=wait_timeout_s,
            traceparent=traceparent or traces.present(),
        )
        self.pump()
        try:
            return await granted.wait()
        except anyio.get_cancelled_exc_class():
            self._turn_away(nonce, granted)
            raise
        finally:
            self._waits.pop(nonce, None)

    async def begin_use(
        self, lease_id: LeaseId, token: Token, label: str, timeout_s: float
    ) -> AsyncForeignUse:
        self.check_open()
        use_id = UseId(f"{self.protocol.connection.instance}/{self.new_id()}")
        request = w.UseBegin(lease_id, token, use_id, label)
        use = AsyncForeignUse(self, request)
        asked = self.protocol.foreign_uses.begin(request, self.now(), timeout_s, traces.present())
        self._foreign_uses[use_id] = use
        try:
            await self.reply(asked)
        except BaseException:
            await use.end()
            raise
        use_context.enter(use_id, use.name)
        return use

    async def ask[R](
        self, request: w.Request[R], timeout_s: float, traceparent: str | None = None
    ) -> R:
        """Send a request and return its reply."""
        connection = self.protocol.connection
        asked = connection.ask(request, self.now(), timeout_s, traceparent=traceparent)
        return cast("R", await self.reply(asked))  # the type that the request names

    async def events(self) -> AsyncGenerator[JsonMap]:
        """Yield history events from now on."""
        unread = anyio.create_memory_object_stream[JsonMap](SUBSCRIBER_QUEUE_MAX)
        put, read = unread
        self._subscribers.append(unread)
        try:
            with put, read:
                await self.reply(self.protocol.subscribe(self.now()))
                async for event in read:
                    yield event
                raise closed()
        finally:
            if unread in self._subscribers:
                self._subscribers.remove(unread)

    # -- for leases (`clients.eviction.Driver`)
    def check_open(self) -> None:
        if not self._open:
            raise ArbiterUnreachable("this client is closed", hint="use it inside `async with`")

    def now(self) -> float:
        return time.monotonic()

    def new_id(self) -> str:
        return uuid.uuid4().hex

    async def reply(self, request_id: int) -> AnyReply:
        self.check_open()
        answer: Answer[AnyReply] = Answer()
        self._replies[request_id] = answer
        try:
            self.pump()
            return await answer.wait()
        finally:
            if self._replies.pop(request_id, None) is not None and not answer.done:
                self.protocol.connection.forget(request_id)

    async def told(self, request_id: int) -> None:
        self.check_open()
        answer: Answer[AnyReply | None] = Answer()
        self._replies[request_id] = self._until_loss[request_id] = answer
        try:
            self.pump()
            if self.connected:
                await answer.wait()
        finally:
            self._replies.pop(request_id, None)
            self._until_loss.pop(request_id, None)
            self.protocol.connection.forget(request_id)

    def forget_use(self, use_id: str) -> None:
        self._foreign_uses.pop(use_id, None)

    def pump(self) -> None:
        """Do what the protocol wants: send, tell, move the alarm. Call it after every change."""
        if not self._open:
            return
        connection = self.protocol.connection
        while True:
            outgoing, connection.outgoing = connection.outgoing, []
            for message in outgoing:
                if self._dealer is None or not self._dealer.send(message):
                    connection.contact_lost("the socket takes no more messages")
                    break
            events, connection.events = connection.events, []
            if not events:
                break
            for event in events:
                self._tell(event)
        deadline = self.protocol.next_deadline()
        if deadline is not None and deadline < self._alarm_at:
            self._alarm_moved.set()

    def spawn(
        self, work: Callable[..., Awaitable[None]], *arguments: object, name: str
    ) -> anyio.CancelScope:
        """Run work that outlives the caller, until the client ends; what it raises is logged."""
        self.check_open()
        assert self._tasks is not None
        self._serial += 1
        serial, scope = self._serial, anyio.CancelScope()
        self._spawned[serial] = scope

        async def run() -> None:
            try:
                with scope:
                    await work(*arguments)
            except VramError as error:
                log.warning("%s: %s", name, error)
            except Exception:
                log.exception("%s failed", name)
            finally:
                self._spawned.pop(serial, None)

        self._tasks.start_soon(run, name=name)
        return scope

    # -- tasks
    async def _stay_connected(self) -> None:
        """Serve one socket after the other, each until contact is lost."""
        while True:
            self._contact_lost = anyio.Event()
            self._dealer = dealer = self._new_dealer()
            self.protocol.connection.connected(self.now())
            self.pump()
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(dealer.run, name="arbiter socket")
                await self._contact_lost.wait()
                tasks.cancel_scope.cancel()
            await anyio.sleep(REOPEN_S)

    def _new_dealer(self) -> Transport:
        return Dealer(
            self.endpoint, self._received, self._hung_up, self._refused, program="arbiter"
        )

    async def _keep_time(self) -> None:
        """Let the protocol do what is due, when it is due."""
        while True:
            self._alarm_moved = anyio.Event()
            deadline = self.protocol.next_deadline()
            self._alarm_at = float("inf") if deadline is None else deadline
            with anyio.move_on_after(max(0.0, self._alarm_at - self.now())):
                await self._alarm_moved.wait()
                continue
            self.protocol.tick(self.now())
            self.pump()

    # -- steps
    async def _give_up_all(self) -> None:
        async def give_up(lease: AsyncLease) -> None:
            try:
                await lease.give_up()
            except VramError as error:
                log.warning("giving up %s: %s", lease.lease_id, error)

        async with anyio.create_task_group() as tasks:
            for lease in tuple(self._leases.values()):
                tasks.start_soon(give_up, lease, name=f"give up {lease.lease_id}")

    async def _shut(self) -> None:
        """Close the socket, end the tasks; a caller that still waits gets ArbiterUnreachable."""
        self._open = False
        self.protocol.connection.contact_lost("closed")
        self.protocol.connection.events.clear()
        for answer in self._replies.values():
            answer.fail(closed())
        for wait in self._waits.values():
            wait.granted.fail(closed())
        subscribers, self._subscribers = self._subscribers, []
        for put, _ in subscribers:
            put.close()
        for scope in tuple(self._spawned.values()):  # one by one, in order: a simulation repeats
            scope.cancel()
        tasks, self._tasks = self._tasks, None
        assert tasks is not None
        tasks.cancel_scope.cancel()
        try:
            await tasks.__aexit__(None, None, None)
        finally:
            for lease in self._leases.values():
                lease._closed(closed())
            self._leases.clear()

    def _turn_away(self, nonce: str, granted: Answer[AsyncLease]) -> None:
        """Give back the place in the queue of a caller that was canceled, or its lease."""
        if not self._open:
            return
        if granted.done and not granted.failed:  # nothing was loaded yet
            self.spawn(granted.result().release, name=f"canceled acquire {nonce}")
        else:
            self.protocol.waits.cancel(nonce, self.now())
            self.pump()

    def _received(self, message: Message) -> None:
        self.protocol.connection.receive(message, self.now())
        self.pump()

    def _hung_up(self) -> None:
        self.protocol.connection.contact_lost("the arbiter hung up")
        self.pump()

    def _refused(self, error: VramError) -> None:
        """Another user's process listens there. It was told nothing; the deadline of the hello
        leads to the next attempt."""
        if not self._greeted.done:
            self._greeted.fail(error)
        elif not self._distrusted:
            log.error("%s", error)
        self._distrusted = True

    def _tell(self, event: r.Event) -> None:
        match event:
            case r.Up():
                self._lost = self._distrusted = False
                if self._greeted.done:
                    log.info("back in contact with the arbiter (epoch %s)", event.epoch)
                self._greeted.set(None)
            case r.ContactLost():
                self._note_lost_contact(event.reason)
            case r.GreetingRefused():
                if self._greeted.done:
                    log.warning("the arbiter refuses this client: %s", event.error)
                self._greeted.fail(event.error)
            case r.Replied():
                if answer := self._replies.get(event.request_id):
                    answer.set(event.body)
            case r.Failed():
                if answer := self._replies.get(event.request_id):
                    answer.fail(event.error)
            case r.Granted():
                self._granted(event)
            case r.Denied():
                if wait := self._waits.get(event.nonce):
                    wait.granted.fail(event.error)
            case r.RevokeAsked():
                if lease := self._leases.get(event.record.lease_id):
                    lease._revoke_asked(event.push)
            case r.RevokeWithdrawn():
                if lease := self._leases.get(event.record.lease_id):
                    lease._revoke_withdrawn()
            case r.Gone():
                if lease := self._leases.get(event.record.lease_id):
                    lease._lost(event.error, event.fenced)
            case r.Returned():
                if lease := self._leases.get(event.record.lease_id):
                    lease._returned()
            case r.UseLost():
                if use := self._foreign_uses.get(event.use_id):
                    use._lost = event.error
            case r.HistoryEvent():
                for put, read in self._subscribers:
                    if put.statistics().current_buffer_used == SUBSCRIBER_QUEUE_MAX:
                        read.receive_nowait()
                    put.send_nowait(event.event)
            case r.PrepareAsked():
                if self.on_prepare is not None:
                    self.on_prepare(event.by)

    def _note_lost_contact(self, reason: str) -> None:
        """Log it once, however often a reconnect fails. Before the first contact, entering
        raises."""
        if not self._closing:
            quiet = self._lost or not self._greeted.done
            log.log(
                logging.DEBUG if quiet else logging.WARNING,
                "contact to the arbiter lost: %s",
                reason,
            )
        self._lost = True
        self._contact_lost.set()
        for answer in self._until_loss.values():
            answer.set(None)

    def _granted(self, event: r.Granted) -> None:
        wait = self._waits.get(event.nonce)
        if wait is None or wait.granted.done:  # the caller was canceled in this very moment
            self.protocol.holdings.release(event.record, False, self.now(), REQUEST_TIMEOUT_S)
            return
        lease = AsyncLease(self, event.record, wait.spec, wait.handlers)
        kept = (one for one in self._leases.values() if not one._departure.over)
        self._leases = {one.lease_id: one for one in kept}
        self._leases[event.record.lease_id] = lease
        wait.granted.set(lease)


def closed() -> ArbiterUnreachable:
    return ArbiterUnreachable("the client was closed", hint="keep it open while leases are needed")
