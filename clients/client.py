"""The arbiter's client for async programs, on asyncio or trio.

    async with AsyncClient("detector") as arbiter:
        async with arbiter.lease(vram="5.3GB", model="owlv2", unload=model.unload) as lease:
            await model.load()
            await lease.ready(model.allocated_bytes())
            async with lease.use("detect"):
                ...

It joins the sans-IO protocol (`clients._protocol.protocol`: what to say) to a socket
(`clients.net.dealer`: how) and to leases (`clients.lease`: what the holder sees). Renewal, reconnect,
reattachment, acknowledgement and fencing are background tasks of the client's task group. The module
must not know models or robots.
"""

import contextlib
import logging
import os
import time
import uuid
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Self

import anyio
from anyio.abc import TaskGroup

from vram_arbiter.clients import use_context
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.clients._spec import Vram, lease_spec
from vram_arbiter.clients.handlers import Handler, Handlers
from vram_arbiter.clients.lease import AsyncForeignUse, AsyncLease
from vram_arbiter.clients.net.answer import Answer
from vram_arbiter.clients.net.dealer import Dealer
from vram_arbiter.clients.net.diagnose import START, obstacle
from vram_arbiter.schemas.errors import ArbiterUnreachable, BadState, VramError
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.wire.requests import Gang, LeaseSpec

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S: Final = 5.0
BYE_TIMEOUT_S: Final = 1.0
LEAVE_TIMEOUT_S: Final = 30.0  # as long as the arbiter's own ladder gives a holder
REOPEN_S: Final = (
    0.05  # between two sockets, so that a server that hangs up at once is not hammered
)
SUBSCRIBER_QUEUE_MAX: Final = 10_000  # events; a subscriber that does not read loses the oldest


@dataclass(frozen=True, slots=True)
class _Acquire:
    """A lease that is waited for."""

    granted: Answer[AsyncLease]
    spec: LeaseSpec
    handlers: Handlers[AsyncLease]


class _Subscriber:
    """Events that a subscriber has not read yet."""

    def __init__(self) -> None:
        self._events: deque[r.Message] = deque(maxlen=SUBSCRIBER_QUEUE_MAX)
        self._arrived = anyio.Event()
        self._closed = False

    def close(self) -> None:
        self._closed = True
        self._arrived.set()

    def put(self, event: r.Message) -> None:
        self._events.append(event)
        self._arrived.set()

    async def get(self) -> r.Message:
        while not self._events:
            self._arrived = anyio.Event()
            if self._closed:
                raise _closed()
            await self._arrived.wait()
        return self._events.popleft()


class AsyncClient:
    """One connection to the arbiter, open inside `async with`. For one event loop and one process.

    `name` is what `vramctl` shows, and the consumer of leases that name none. Entering raises
    ArbiterUnreachable after `connect_timeout_s` without an answer, UntrustedServer, or the arbiter's
    refusal (VersionMismatch, NotPermitted, LimitExceeded). A later loss of contact is ridden out.
    """

    def __init__(
        self,
        name: str,
        *,
        endpoint: str | None = None,
        role: str = "client",
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self._name = name
        self._endpoint = endpoint or arbiter_endpoint(os.environ, os.getuid())
        self.protocol = ClientProtocol(
            name=name, instance=f"{os.getpid()}-{uuid.uuid4().hex[:8]}", role=role
        )
        self._connect_timeout_s = connect_timeout_s
        self._open = False
        self._closing = False
        self._tasks: TaskGroup | None = None
        self._spawned: dict[int, anyio.CancelScope] = {}  # in the order of their beginning
        self._serial = 0
        self._dealer: Dealer | None = None
        self._contact_lost = anyio.Event()
        self._greeted: Answer[None] = Answer()
        self._alarm_at = float("inf")
        self._alarm_moved = anyio.Event()
        self._replies: dict[int, Answer[r.Message]] = {}
        self._acquires: dict[str, _Acquire] = {}
        self._leases: dict[str, AsyncLease] = {}
        self._foreign: dict[str, AsyncForeignUse] = {}
        self._subscribers: list[_Subscriber] = []
        self._lost = False
        self._distrusted = False  # since the last contact

    # -- connection --------------------------------------------------------------------------------
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
            if self.leases:
                log.warning("closing although leases are still in use: %s", self.leases)
            if self.connected:
                with contextlib.suppress(VramError), anyio.CancelScope(shield=True):
                    await self.reply(
                        self.protocol.connection.request(
                            "bye", {}, self.now(), timeout_s=BYE_TIMEOUT_S
                        )
                    )
        finally:
            await self._shut()

    @property
    def name(self) -> str:
        return self._name

    @property
    def endpoint(self) -> str:
        return self._endpoint

    @property
    def connected(self) -> bool:
        """Whether the arbiter answered this connection's hello."""
        return self.protocol.connection.phase == "up"

    @property
    def epoch(self) -> int | None:
        """Number of the daemon's start; None before the first answer."""
        return self.protocol.connection.epoch

    @property
    def leases(self) -> Sequence[AsyncLease]:
        """Leases that this client holds now."""
        return tuple(lease for lease in self._leases.values() if lease.state != "gone")

    # -- leases ------------------------------------------------------------------------------------
    async def acquire(
        self,
        spec: LeaseSpec | None = None,
        wait_timeout_s: float | None = None,
        *,
        vram: Vram | None = None,
        model: str | None = None,
        handlers: Handlers[AsyncLease] | None = None,
        unload: Handler | None = None,
        park: Handler | None = None,
        restore: Callable[[AsyncLease], object] | None = None,
        on_revoke: Callable[[AsyncLease, r.Eviction], object] | None = None,
        on_lost: Callable[[AsyncLease, VramError], object] | None = None,
        safe_point_eta_s: Callable[[], float | None] | None = None,
        traceparent: str | None = None,
        **fields: Any,
    ) -> AsyncLease:
        """Wait for a lease; returns when it is granted (state `loading`): load the model now.

        Args:
            spec: what is needed; or `vram`, `model` and other fields of LeaseSpec by name.
            wait_timeout_s: longest wait; None waits without limit.
            vram: bytes, a text such as `5.3GB`, or a Footprint.
            model: model id, for the arbiter's statistics and learned footprints.
            handlers: what to do when the arbiter wants something (`clients.handlers.Handlers`);
                each of them can be given by name instead.
            traceparent: trace of the wait; None takes the current span's.
            fields: other fields of LeaseSpec, such as `priority`, `gpu` or `standby`.

        Raises: WaitTimeout (details.why: what blocked), VramInsufficient, UnknownGpu, HolderBusy,
            LimitExceeded, BadRequest; inside a use also WouldDeadlock (`clients.use_context`).
        Canceling the caller gives the place in the queue, or the lease, back.
        """
        self._check_open()
        wanted = lease_spec(spec, self._name, vram, model, fields)
        if not use_context.a_use():
            wanted = wanted.model_copy(update={"independent": True})
        merged = (handlers or Handlers[AsyncLease]()).merged(
            unload=unload,
            park=park,
            restore=restore,
            on_revoke=on_revoke,
            on_lost=on_lost,
            safe_point_eta_s=safe_point_eta_s,
        )
        nonce = self.new_id()
        granted: Answer[AsyncLease] = Answer()
        self._acquires[nonce] = _Acquire(granted, wanted, merged)
        self.protocol.waits.acquire(
            nonce,
            wanted.model_dump(mode="json"),
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
            self._acquires.pop(nonce, None)

    @asynccontextmanager
    async def lease(
        self,
        spec: LeaseSpec | None = None,
        wait_timeout_s: float | None = None,
        *,
        vram: Vram | None = None,
        model: str | None = None,
        handlers: Handlers[AsyncLease] | None = None,
        unload: Handler | None = None,
        park: Handler | None = None,
        restore: Callable[[AsyncLease], object] | None = None,
        on_revoke: Callable[[AsyncLease, r.Eviction], object] | None = None,
        on_lost: Callable[[AsyncLease, VramError], object] | None = None,
        safe_point_eta_s: Callable[[], float | None] | None = None,
        traceparent: str | None = None,
        **fields: Any,
    ) -> AsyncIterator[AsyncLease]:
        """`acquire` as a block; at its end, also when it raises: unload and release."""
        lease = await self.acquire(
            spec,
            wait_timeout_s,
            vram=vram,
            model=model,
            handlers=handlers,
            unload=unload,
            park=park,
            restore=restore,
            on_revoke=on_revoke,
            on_lost=on_lost,
            safe_point_eta_s=safe_point_eta_s,
            traceparent=traceparent,
            **fields,
        )
        try:
            yield lease
        finally:
            try:
                await lease.give_up()
            except anyio.get_cancelled_exc_class():
                with anyio.move_on_after(LEAVE_TIMEOUT_S, shield=True):
                    await lease.give_up()
                raise

    async def gang(
        self, specs: Sequence[LeaseSpec], wait_timeout_s: float | None = None
    ) -> AsyncIterator[tuple[int, AsyncLease]]:
        """Acquire all of these leases or none of them.

        `async for index, lease in client.gang([policy, reward])`: load, then `await lease.ready()`.
        The next one is granted when the one before is ready. What was granted is the caller's to
        give up.

        Raises: GangBroken, VramInsufficient, WaitTimeout.
        """
        gang = Gang(
            id=f"{self.protocol.connection.instance}/{uuid.uuid4().hex[:12]}", size=len(specs)
        )
        grants: deque[tuple[int, Answer[AsyncLease]]] = deque()
        arrived = [anyio.Event()]

        async def member(index: int, spec: LeaseSpec, end: Answer[AsyncLease]) -> None:
            try:
                end.set(await self.acquire(spec.model_copy(update={"gang": gang}), wait_timeout_s))
            except VramError as error:
                end.fail(error)
            finally:
                end.fail(_closed())  # where it is not over yet: the client ends
                grants.append((index, end))
                arrived[0].set()

        members = [
            self._spawn(member, index, spec, Answer[AsyncLease](), name=f"gang {gang.id} {index}")
            for index, spec in enumerate(specs)
        ]
        try:
            for _ in specs:
                while not grants:
                    arrived[0] = anyio.Event()
                    await arrived[0].wait()
                index, end = grants.popleft()
                yield index, end.result()
        finally:
            for scope in members:
                scope.cancel()
            for _, end in grants:  # granted while the caller turned away: nothing was loaded
                if end.done and not end.failed:
                    self.spawn(end.result().release, name=f"unwanted member of gang {gang.id}")

    async def begin_use(
        self,
        lease_id: str,
        token: Sequence[int],
        label: str = "",
        *,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> AsyncForeignUse:
        """Begin a use on the lease of another process, by its token; `end` it.

        Raises: LeaseRevoking, StaleToken, LeaseLost.
        """
        self._check_open()
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
        use_context.enter(use.use_id)
        return use

    @asynccontextmanager
    async def use(
        self, lease_id: str, token: Sequence[int], label: str = ""
    ) -> AsyncIterator[AsyncForeignUse]:
        """`begin_use` as a block: the lease's holder is not evicted inside it."""
        use = await self.begin_use(lease_id, token, label)
        try:
            yield use
        finally:
            await use.end()

    # -- questions ---------------------------------------------------------------------------------
    async def ask(
        self,
        op: str,
        fields: Mapping[str, Any] | None = None,
        *,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> r.Message:
        """Send any request of `schemas.wire.requests` that has no method here."""
        return await self.reply(
            self.protocol.connection.request(
                op, traces.along(fields), self.now(), timeout_s=timeout_s
            )
        )

    async def status(self) -> r.Message:
        """Return the state of everything, with the leases of all pages. A lease that moves meanwhile
        is listed once, or not at all."""
        shown = await self.ask("status")
        leases = {lease["lease_id"]: lease for lease in shown["leases"]}
        after = shown.pop("next", None)
        while after is not None:
            page = await self.ask("status", {"after": after})
            leases |= {lease["lease_id"]: lease for lease in page["leases"]}
            after = page.get("next")
        return {**shown, "leases": list(leases.values())}

    async def why(self, consumer: str) -> r.Message:
        """Return what blocks this consumer: by how many bytes, on which condition, what comes next."""
        return await self.ask("why", {"consumer": consumer})

    async def history(
        self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()
    ) -> r.Message:
        """Return events after sequence number `after`, oldest first."""
        return await self.ask("history", {"after": after, "limit": limit, "kinds": list(kinds)})

    async def ping(self, *, timeout_s: float = 2.0) -> r.Message:
        return await self.ask("ping", timeout_s=timeout_s)

    async def subscribe(self) -> AsyncIterator[r.Message]:
        """Yield history events from now on, also across restarts of the arbiter. A subscriber that
        does not read loses the oldest."""
        subscriber = _Subscriber()
        self._subscribers.append(subscriber)
        try:
            await self.reply(self.protocol.subscribe(self.now()))
            while True:
                yield await subscriber.get()
        finally:
            self._subscribers.remove(subscriber)

    # -- for leases (`clients.eviction.Driver`) ----------------------------------------------------
    def now(self) -> float:
        return time.monotonic()

    def new_id(self) -> str:
        return uuid.uuid4().hex

    async def reply(self, request_id: int) -> r.Message:
        self._check_open()
        answer: Answer[r.Message] = Answer()
        self._replies[request_id] = answer
        try:
            self.pump()
            return await answer.wait()
        finally:
            if self._replies.pop(request_id, None) is not None and not answer.done:
                self.protocol.connection.forget(request_id)

    def spawn(self, work: Callable[..., Awaitable[None]], *arguments: object, name: str) -> None:
        self._spawn(work, *arguments, name=name)

    def pump(self) -> None:
        """Perform what the protocol wants: send, tell, move the alarm. Call it after every change."""
        if not self._open:
            return
        connection = self.protocol.connection
        while True:
            for message in connection.take_outgoing():
                if self._dealer is None or not self._dealer.send(message):
                    connection.contact_lost("the socket takes no more messages")
                    break
            events = connection.take_events()
            if not events:
                break
            for event in events:
                self._tell(event)
        deadline = self.protocol.next_deadline()
        if deadline is not None and deadline < self._alarm_at:
            self._alarm_moved.set()

    # -- tasks -------------------------------------------------------------------------------------
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

    def _new_dealer(self) -> Dealer:
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

    def _spawn(
        self, work: Callable[..., Awaitable[None]], *arguments: object, name: str
    ) -> anyio.CancelScope:
        """Start background work; what it raises is logged."""
        self._check_open()
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

    # -- steps -------------------------------------------------------------------------------------
    def _check_open(self) -> None:
        if not self._open:
            raise ArbiterUnreachable("this client is closed", hint="use it inside `async with`")

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
        self.protocol.connection.take_events()
        for answer in self._replies.values():
            answer.fail(_closed())
        for wait in self._acquires.values():
            wait.granted.fail(_closed())
        for subscriber in self._subscribers:
            subscriber.close()
        for scope in tuple(self._spawned.values()):  # one by one, in order: a simulation repeats
            scope.cancel()
        tasks, self._tasks = self._tasks, None
        assert tasks is not None
        tasks.cancel_scope.cancel()
        try:
            await tasks.__aexit__(None, None, None)
        finally:
            for lease in self._leases.values():
                lease._closed(_closed())
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

    def _received(self, message: r.Message) -> None:
        self.protocol.connection.receive(message, self.now())
        self.pump()

    def _hung_up(self) -> None:
        self.protocol.connection.contact_lost("the arbiter hung up")
        self.pump()

    def _refused(self, error: VramError) -> None:
        """Another user's process listens there. It was told nothing; the deadline of the hello leads
        to the next attempt."""
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
            case r.Refused():
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
                if wait := self._acquires.get(event.nonce):
                    wait.granted.fail(event.error)
            case r.RevokeAsked():
                if lease := self._leases.get(event.record.lease_id):
                    lease._revoke_asked(event.push, event.first)
            case r.Gone():
                if lease := self._leases.get(event.record.lease_id):
                    lease._lost(event.error, event.fenced)
            case r.Returned():
                if lease := self._leases.get(event.record.lease_id):
                    lease._returned()
            case r.Resized():
                if lease := self._leases.get(event.record.lease_id):
                    lease._resized(event.error)
            case r.UseLost():
                if use := self._foreign.get(event.use_id):
                    use._lost = event.error
            case r.HistoryEvent():
                for subscriber in self._subscribers:
                    subscriber.put(event.event)

    def _note_lost_contact(self, reason: str) -> None:
        """Say it once, however often a reconnect fails; entering says it before the first contact."""
        if not self._closing:
            quiet = self._lost or not self._greeted.done
            log.log(
                logging.DEBUG if quiet else logging.WARNING,
                "contact to the arbiter lost: %s",
                reason,
            )
        self._lost = True
        self._contact_lost.set()

    def _granted(self, event: r.Granted) -> None:
        wait = self._acquires.get(event.nonce)
        if wait is None or wait.granted.done:  # the caller was canceled in this very moment
            self.protocol.holdings.release(event.record, False, self.now(), REQUEST_TIMEOUT_S)
            return
        lease = AsyncLease(self, event.record, wait.spec, wait.handlers)
        self._leases[lease.lease_id] = lease
        self.spawn(self._forget_when_over, lease, name=f"life of {lease.lease_id}")
        wait.granted.set(lease)

    async def _forget_when_over(self, lease: AsyncLease) -> None:
        await lease.wait_gone()
        self._leases.pop(lease.lease_id, None)


def _closed() -> ArbiterUnreachable:
    return ArbiterUnreachable("the client was closed", hint="keep it open while leases are wanted")
