"""The arbiter's client for programs with threads: `clients.client` with blocking methods.

    with Client("detector") as arbiter:
        with arbiter.lease(vram="5.3GB", model="owlv2", unload=model.unload) as lease:
            model.load()
            lease.ready(model.allocated_bytes())
            with lease.use("detect"):
                ...

An event loop in a background thread (anyio's blocking portal) runs the async client, so renewals
and revocations are answered whatever the program does. Any thread may call. A client does not
survive a fork. Every class has the methods of its async twin; a test compares them.
"""

import asyncio
import os
import warnings
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager
from functools import partial, wraps
from threading import Thread, current_thread, main_thread
from types import TracebackType
from typing import Any, Concatenate, Self

import anyio
from anyio import WouldBlock

from vram_arbiter.clients import use_context
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.clients._spec import Vram
from vram_arbiter.clients.client import CONNECT_TIMEOUT_S, AsyncClient
from vram_arbiter.clients.handlers import Handler, Handlers, with_signature_of
from vram_arbiter.clients.lease import AsyncForeignUse, AsyncLease, AsyncUse, LeaseState
from vram_arbiter.schemas.errors import BadState, VramError
from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.requests import Request, Role
from vram_arbiter.schemas.wire.spec import LeaseSpec


class _Portal:
    """The background thread of one client, whose event loop serves its connection while it is open.
    Raises BadState where it does not run."""

    def __init__(self, connection: AsyncClient) -> None:
        self._pid = os.getpid()
        self._connection = connection
        self._running: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event
        self._left: Future[None]
        self._thread: Thread

    @property
    def inherited(self) -> bool:
        """Whether this process is a fork of the one that made the client."""
        return os.getpid() != self._pid

    @property
    def _loop(self) -> asyncio.AbstractEventLoop:
        if self._running is None or self.inherited:
            what = "closed" if self._running is None else "made before a fork"
            raise BadState(
                f"this client was {what}", hint="make one in this process, and use it inside `with`"
            )
        return self._running

    def start(self) -> None:
        """Open the connection. Raises what that raises."""
        opened: Future[None] = Future()
        self._left = Future()
        self._thread = Thread(
            target=self._run, args=(opened,), name="vram-arbiter-client", daemon=True
        )
        self._thread.start()
        try:
            opened.result()
        except BaseException:
            opened.cancel()
            raise

    def _run(self, opened: Future[None]) -> None:
        async def serve() -> None:
            self._running, self._stop = asyncio.get_running_loop(), asyncio.Event()
            try:
                async with self._connection:
                    if opened.set_running_or_notify_cancel():
                        opened.set_result(None)
                        await self._stop.wait()
            finally:
                self._running = None

        try:
            anyio.run(serve)  # at its end calls of other threads end too
        except BaseException as error:  # noqa: BLE001  # of another thread
            ends = self._left if opened.done() else opened
            if ends.set_running_or_notify_cancel():
                ends.set_exception(error)
        else:
            self._left.set_result(None)

    def leave(self) -> None:
        """Close the connection, and end the thread. Raises what that raises."""
        self.soon(self._stop.set)
        self._left.result()
        self._thread.join()

    def dropped(self, name: str) -> None:
        """Leave for a client that was entered, and is gone without an exit: collected in any
        thread, or left to the end of the program."""
        if self.inherited:
            return
        warnings.warn(
            f"the client {name!r} was entered and never left; use it in a `with` block",
            RuntimeWarning,
            stacklevel=2,
        )
        self.abandon()

    def abandon(self) -> None:
        """Leave, in whatever thread, or at the end of the program."""
        if self.inherited or not main_thread().is_alive():
            return  # the program ends, and its leases with it: no handler could run any more
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            self.leave()
        else:  # a thread with a loop must not wait: it may be this client's, or another one's
            Thread(target=self.leave).start()

    def call[T](self, work: Callable[..., Awaitable[T]], *arguments: Any, **named: Any) -> T:
        """Run `work` in the background thread and wait for it. Ctrl-C cancels it there too."""

        loop = self._loop
        if self._thread is current_thread():
            raise BadState("this thread serves the client", hint="call it in another thread")

        async def run() -> T:
            return await work(*arguments, **named)

        future = asyncio.run_coroutine_threadsafe(run(), loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def soon(self, work: Callable[..., object], *arguments: Any) -> None:
        """Run `work` in the background thread, without waiting for it, before what is called
        later."""
        self._loop.call_soon_threadsafe(work, *arguments)


class _Blocking[Twin]:
    """What a thread sees of an object that lives in the background thread."""

    def __init__(self, portal: _Portal, twin: Twin) -> None:
        self._portal = portal
        self._twin = twin


def _blocking[Twin, **P, T](
    work: Callable[Concatenate[Twin, P], Awaitable[T]],
) -> Callable[Concatenate[_Blocking[Twin], P], T]:
    """Return the blocking method of an async one, with its parameters and its docstring."""

    @wraps(work)
    def method(self: _Blocking[Twin], /, *arguments: P.args, **named: P.kwargs) -> T:
        return self._portal.call(work, self._twin, *arguments, **named)

    return method


class Lease(_Blocking[AsyncLease]):
    """A granted lease. `give_up` runs the `unload` handler; `release` reports bytes that the holder
    freed itself."""

    ready = _blocking(AsyncLease.ready)
    oom = _blocking(AsyncLease.oom)
    park = _blocking(AsyncLease.park)
    reacquire = _blocking(AsyncLease.reacquire)
    wait_returned = _blocking(AsyncLease.wait_returned)
    release = _blocking(AsyncLease.release)
    give_up = _blocking(AsyncLease.give_up)
    wait_change = _blocking(AsyncLease.wait_change)
    wait_gone = _blocking(AsyncLease.wait_gone)

    @property
    def lease_id(self) -> str:
        return self._twin.lease_id

    @property
    def token(self) -> Token:
        """Fencing token (epoch, serial). A process that has it and the lease id can mark uses."""
        return self._twin.token

    @property
    def spec(self) -> LeaseSpec:
        """What was asked for."""
        return self._twin.spec

    @property
    def gpu(self) -> str:
        """UUID of the GPU that was granted."""
        return self._twin.gpu

    @property
    def state(self) -> LeaseState:
        return self._twin.state

    @property
    def uses(self) -> int:
        """Number of in-flight uses of this holder."""
        return self._twin.uses

    @property
    def revoking(self) -> bool:
        """Whether the lease is on its way out, or away."""
        return self._twin.revoking

    @property
    def evicted(self) -> r.Eviction | None:
        """Why the arbiter revoked the lease; None: it did not."""
        return self._twin.evicted

    @property
    def given_up(self) -> bool:
        """Whether the holder itself ended the lease (`give_up`)."""
        return self._twin.given_up

    @property
    def error(self) -> VramError | None:
        """Why the lease is gone, if its holder did not end it."""
        return self._twin.error

    def __repr__(self) -> str:
        return repr(self._twin)

    def use(self, label: str = "") -> AbstractContextManager["Use"]:
        """Mark a busy interval: the holder is not evicted inside it; see `AsyncLease.use`."""
        return self._use(label, wait=True)

    @contextmanager
    def _use(self, label: str, *, wait: bool) -> Iterator["Use"]:
        """`use`. Raises: WouldBlock without `wait`, where the arbiter has to answer first."""
        use = AsyncUse(self._twin, label)
        try:
            if use._begin_ahead():
                self._portal.soon(partial(use._tell, begun=True))
            elif wait:
                self._portal.call(use._begin)
            else:
                raise WouldBlock
            use_context.enter(use.use_id, use.name)
            yield Use(self._portal, use)
        finally:
            self._portal.soon(use._end)


class Use(_Blocking[AsyncUse]):
    """A use on the holder's own lease; made by `Lease.use`."""

    @property
    def use_id(self) -> str:
        return self._twin.use_id


class ForeignUse(_Blocking[AsyncForeignUse]):
    """A use on the lease of another process; see `AsyncForeignUse`."""

    end = _blocking(AsyncForeignUse.end)

    @property
    def lease_id(self) -> str:
        return self._twin.lease_id

    @property
    def token(self) -> Token:
        return self._twin.token

    @property
    def use_id(self) -> str:
        return self._twin.use_id

    @property
    def lost(self) -> VramError | None:
        """Why the use ended early, or None."""
        return self._twin.lost


def _block[C, **P](
    acquire: Callable[Concatenate[C, P], Lease],
) -> Callable[Concatenate[C, P], AbstractContextManager[Lease]]:
    @contextmanager
    def lease(client: C, /, *arguments: P.args, **options: P.kwargs) -> Iterator[Lease]:
        """`acquire` as a block, with the same parameters; at its end, also when it raises: unload
        and release."""
        granted = acquire(client, *arguments, **options)
        try:
            yield granted
        finally:
            granted.give_up()

    return with_signature_of(acquire, lease)


class Client(_Blocking[AsyncClient]):
    """One connection to the arbiter, open inside `with`. Raises as `clients.client.AsyncClient`.

    In a forked child it raises BadState, and leaving the block only forgets: the parent owns it.
    """

    def __init__(
        self,
        name: str,
        *,
        endpoint: str | None = None,
        role: Role = "client",
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        made = AsyncClient(name, endpoint=endpoint, role=role, connect_timeout_s=connect_timeout_s)
        super().__init__(_Portal(made), made)
        self._dropped: weakref.finalize[Any, Any]

    # -- connection --------------------------------------------------------------------------------
    def __enter__(self) -> Self:
        self._portal.start()
        self._dropped = weakref.finalize(self, self._portal.dropped, self.name)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._dropped.detach()
        if not self._portal.inherited:
            self._portal.leave()

    @property
    def name(self) -> str:
        return self._twin.name

    @property
    def endpoint(self) -> str:
        return self._twin.endpoint

    @property
    def connected(self) -> bool:
        """Whether the arbiter answered this connection's hello."""
        return self._twin.connected

    @property
    def epoch(self) -> int | None:
        """Number of the daemon's start; None before the first answer."""
        return self._twin.epoch

    @property
    def role(self) -> str | None:
        """The role that the arbiter gave, `guest` behind a tunnel; None before the first answer."""
        return self._twin.role

    @property
    def leases(self) -> Sequence[Lease]:
        """Leases that this client holds now."""
        return tuple(Lease(self._portal, lease) for lease in self._twin.leases)

    # -- leases ------------------------------------------------------------------------------------
    def acquire(
        self,
        /,
        spec: LeaseSpec | None = None,
        wait_timeout_s: float | None = None,
        *,
        vram: Vram | None = None,
        model: str | None = None,
        handlers: Handlers[Lease] | None = None,
        unload: Handler | None = None,
        park: Handler | None = None,
        restore: Callable[[Lease], object] | None = None,
        on_revoke: Callable[[Lease, r.Eviction], object] | None = None,
        on_lost: Callable[[Lease, VramError], object] | None = None,
        safe_point_eta_s: Callable[[], float | None] | None = None,
        traceparent: str | None = None,
        **fields: Any,
    ) -> Lease:
        """Block until granted; see `AsyncClient.acquire`."""
        merged = (handlers or Handlers[Lease]()).merged(
            unload=unload,
            park=park,
            restore=restore,
            on_revoke=on_revoke,
            on_lost=on_lost,
            safe_point_eta_s=safe_point_eta_s,
        )
        granted = self._portal.call(
            self._twin.acquire,
            spec,
            wait_timeout_s,
            vram=vram,
            model=model,
            handlers=self._adapted(merged),
            traceparent=traceparent,
            **fields,
        )
        return Lease(self._portal, granted)

    lease = _block(acquire)

    def begin_use(
        self,
        lease_id: str,
        token: Sequence[int],
        label: str = "",
        *,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> ForeignUse:
        """Begin a use on the lease of another process, by its token; `end` it."""
        use = self._portal.call(self._twin.begin_use, lease_id, token, label, timeout_s=timeout_s)
        use_context.enter(use.use_id, use.name)
        return ForeignUse(self._portal, use)

    @contextmanager
    def use(self, lease_id: str, token: Sequence[int], label: str = "") -> Iterator[ForeignUse]:
        """`begin_use` as a block: the lease's holder is not evicted inside it."""
        use = self.begin_use(lease_id, token, label)
        try:
            yield use
        finally:
            use.end()

    # -- questions ---------------------------------------------------------------------------------
    def ask[R](self, request: Request[R], *, timeout_s: float = REQUEST_TIMEOUT_S) -> R:
        """Send any request of `schemas.wire.requests`, and return its reply."""
        ask: Callable[..., Awaitable[R]] = self._twin.ask
        return self._portal.call(ask, request, timeout_s=timeout_s)

    status = _blocking(AsyncClient.status)
    why = _blocking(AsyncClient.why)
    history = _blocking(AsyncClient.history)
    prepare = _blocking(AsyncClient.prepare)
    demand = _blocking(AsyncClient.demand)

    def on_prepare(self, hinted: Callable[[str], object]) -> None:
        """Call `hinted`, on the client's own thread, when this consumer's model is wanted soon."""
        self._twin.on_prepare(hinted)

    ping = _blocking(AsyncClient.ping)

    def subscribe(self) -> Iterator[JsonMap]:
        """Yield history events from now on; blocks for the next one. Close the iterator to stop."""
        return self._iterate(self._twin.subscribe())

    # -- steps -------------------------------------------------------------------------------------
    def _iterate[T](self, found: AsyncIterator[T]) -> Iterator[T]:
        async def step() -> tuple[T] | None:
            try:
                return (await anext(found),)
            except StopAsyncIteration:
                return None

        try:
            while (item := self._portal.call(step)) is not None:
                yield item[0]
        finally:
            self._portal.call(found.aclose)  # type: ignore[attr-defined]  # an async generator

    def _adapted(self, handlers: Handlers[Lease]) -> Handlers[AsyncLease]:
        """Return the same handlers for the async client: they are given a `Lease`."""

        def adapt(handler: Callable[..., object] | None) -> Callable[..., object] | None:
            if handler is None:
                return None
            return lambda lease, *rest: handler(Lease(self._portal, lease), *rest)

        return Handlers(
            unload=handlers.unload,
            park=handlers.park,
            restore=adapt(handlers.restore),
            on_revoke=adapt(handlers.on_revoke),
            on_lost=adapt(handlers.on_lost),
            safe_point_eta_s=handlers.safe_point_eta_s,
        )
