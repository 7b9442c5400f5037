"""The arbiter's client for async programs, on asyncio or trio.

    async with AsyncClient("detector") as arbiter:
        async with arbiter.lease(vram="5.3GB", model="owlv2", unload=model.unload) as lease:
            await model.load()
            await lease.ready(model.allocated_bytes())
            async with lease.use("detect"):
                ...

The connection and its background tasks are `clients._session`. The module must not know models or
robots.
"""

import os
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace
from types import TracebackType
from typing import Any, Concatenate, Final, Self

import anyio

from vram_arbiter.clients import use_context
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.clients._session import LEAVE_TIMEOUT_S, Session
from vram_arbiter.clients._spec import Vram, lease_spec
from vram_arbiter.clients.handlers import Handler, Handlers, with_signature_of
from vram_arbiter.clients.lease import AsyncForeignUse, AsyncLease
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.ids import LeaseId, Token
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import (
    HistoryReply,
    PingReply,
    PrepareReply,
    StatusReply,
)
from vram_arbiter.schemas.wire.spec import LeaseSpec

CONNECT_TIMEOUT_S: Final = 5.0


def _block[C, **P](
    acquire: Callable[Concatenate[C, P], Awaitable[AsyncLease]],
) -> Callable[Concatenate[C, P], AbstractAsyncContextManager[AsyncLease]]:
    @asynccontextmanager
    async def lease(
        client: C, /, *arguments: P.args, **options: P.kwargs
    ) -> AsyncIterator[AsyncLease]:
        """`acquire` as a block, with the same parameters; at its end, also when it raises: unload
        and release."""
        granted = await acquire(client, *arguments, **options)
        try:
            yield granted
        finally:
            try:
                await granted.give_up()
            except anyio.get_cancelled_exc_class():
                with anyio.move_on_after(LEAVE_TIMEOUT_S, shield=True):
                    await granted.give_up()
                raise

    return with_signature_of(acquire, lease)


class AsyncClient:
    """One connection to the arbiter, open inside `async with`. For one event loop and one process.

    `name` is what `vramctl` shows, and the consumer of leases that name none. Entering raises
    ArbiterUnreachable after `connect_timeout_s` without an answer, UntrustedServer, or the
    arbiter's refusal (VersionMismatch, NotPermitted, LimitExceeded). A later loss of contact is
    ridden out.
    """

    def __init__(
        self,
        name: str,
        *,
        endpoint: str | None = None,
        role: w.Role = "client",
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self._name = name
        self._session = Session(
            name, endpoint or arbiter_endpoint(os.environ, os.getuid()), role, connect_timeout_s
        )

    # -- connection
    async def __aenter__(self) -> Self:
        await self._session.__aenter__()
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
        await self._session.__aexit__(kind, error, trace)

    @property
    def name(self) -> str:
        return self._name

    @property
    def endpoint(self) -> str:
        return self._session.endpoint

    @property
    def connected(self) -> bool:
        """Whether the arbiter answered this connection's hello."""
        return self._session.connected

    @property
    def epoch(self) -> int | None:
        """Number of the daemon's start; None before the first answer."""
        return self._session.protocol.connection.epoch

    @property
    def role(self) -> str | None:
        """The role that the arbiter gave, `guest` behind a tunnel; None before the first answer."""
        return self._session.protocol.connection.role

    @property
    def leases(self) -> Sequence[AsyncLease]:
        """Leases that this client holds now."""
        return self._session.held

    # -- leases
    async def acquire(
        self,
        /,
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
            wait_timeout_s: longest wait; None waits without limit, inside a use 30 s.
            vram: bytes, a text such as `5.3GB`, or a Footprint.
            model: model id, for the arbiter's statistics and learned footprints.
            handlers: what to do when the arbiter wants something (`clients.handlers.Handlers`);
                each of them can be given by name instead.
            traceparent: trace of the wait; None takes the current span's.
            fields: other fields of LeaseSpec, such as `priority`, `gpu` or `standby`.

        Raises:
            WaitTimeout: it was not granted in time; details.why says what blocked.
            VramInsufficient: it can never fit.
            WouldDeadlock: it waited 30 s inside a use, which may keep what it waits for.
            VramError: UnknownGpu, LimitExceeded or BadRequest.

        Canceling the caller gives the place in the queue, or the lease, back.
        """
        wanted = lease_spec(spec, self._name, vram, model, fields)
        merged = (handlers or Handlers[AsyncLease]()).merged(
            unload=unload,
            park=park,
            restore=restore,
            on_revoke=on_revoke,
            on_lost=on_lost,
            safe_point_eta_s=safe_point_eta_s,
        )
        with use_context.bounded(wanted.consumer, wait_timeout_s) as timeout_s:
            return await self._session.acquire(wanted, merged, timeout_s, traceparent)

    lease = _block(acquire)

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
        pair = Token(int(token[0]), int(token[1]))
        return await self._session.begin_use(LeaseId(lease_id), pair, label, timeout_s)

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

    # -- questions
    async def ask[R](self, request: w.Request[R], *, timeout_s: float = REQUEST_TIMEOUT_S) -> R:
        """Send any request of `schemas.wire.requests`, and return its reply."""
        return await self._session.ask(request, timeout_s, traces.present())

    async def status(self, *, details: bool = False) -> StatusReply:
        """Return the state of everything, with the leases of all pages. A lease that moves
        meanwhile is listed once, or not at all.

        `details`: with declared and measured bytes of each lease, and why each waiter waits.
        """
        first = page = await self.ask(w.Status(details))
        leases = {lease.lease_id: lease for lease in page.leases}
        told = {detail.lease_id: detail for detail in page.details}
        while page.next is not None:
            page = await self.ask(w.Status(details, after=page.next))
            leases |= {lease.lease_id: lease for lease in page.leases}
            told |= {detail.lease_id: detail for detail in page.details}
        return replace(
            first, leases=tuple(leases.values()), details=tuple(told.values()), next=None
        )

    async def why(self, consumer: str) -> WhyReply:
        """Return what blocks a consumer, by how many bytes, on which condition, and what
        is next."""
        return await self.ask(w.AskWhy(consumer))

    async def history(
        self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()
    ) -> HistoryReply:
        """Return events after sequence number `after`, oldest first."""
        return await self.ask(w.History(after, limit, tuple(kinds)))

    async def prepare(self, consumer: str) -> PrepareReply:
        """Tell a consumer that its model is wanted soon; it may read its weights into host RAM.
        Nothing is granted, and nothing evicted, for a hint."""
        return await self.ask(w.Prepare(consumer))

    async def demand(self, requests: Mapping[str, tuple[int, int]]) -> None:
        """Tell the arbiter of the consumers that this client serves, for `status`: how many
        requests are in flight at each, and how many wait for it. It replaces what was told before,
        and lasts until the client ends. Raises LimitExceeded."""
        told = tuple(w.ConsumerDemand(name, *counts) for name, counts in requests.items())
        session = self._session
        await session.reply(session.protocol.demand(w.Demand(told), session.now()))

    def on_prepare(self, hinted: Callable[[str], object]) -> None:
        """Call `hinted` with the name of a client that says that this consumer's model is wanted
        soon."""
        self._session.on_prepare = hinted

    async def ping(self, *, timeout_s: float = 2.0) -> PingReply:
        """Wait for a sign of life."""
        return await self.ask(w.Ping(), timeout_s=timeout_s)

    async def subscribe(self) -> AsyncIterator[JsonMap]:
        """Yield history events from now on, also across restarts of the arbiter. A subscriber that
        does not read loses the oldest."""
        events = self._session.events()
        try:
            async for event in events:
                yield event
        finally:
            await events.aclose()
