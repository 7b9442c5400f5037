"""The arbiter's client for programs with threads: the same surface as `clients.client`, blocking, with `with`.

    with Client(name="detector") as client:
        with client.lease(spec, unload=model.unload) as lease:
            model.load()
            lease.ready(model.allocated_bytes())
            with lease.use("detect"):
                ...

One background thread runs the asyncio client, so that renewals and revocations are answered whatever the program does. Callbacks
run in worker threads, never on that loop. Any thread may call; not across a fork.
"""

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Self, TypeVar

from vram_arbiter.clients import use_context as inside
from vram_arbiter.clients._protocol.records import Eviction
from vram_arbiter.clients.client import CONNECT_TIMEOUT_S, AsyncClient
from vram_arbiter.clients.lease import (
    AsyncForeignUse,
    AsyncLease,
    AsyncUse,
    LeaseState,
    SafePointEta,
)
from vram_arbiter.schemas.errors import BadState, VramError
from vram_arbiter.schemas.wire.requests import Footprint, LeaseSpec

T = TypeVar("T")
Message = dict[str, Any]
SyncUnload = Callable[[], None]
SyncOnRevoke = Callable[["Lease", Mapping[str, Any]], None]
SyncOnReturn = Callable[["Lease"], None]
SyncOnLost = Callable[["Lease", VramError], None]

CLOSE_TIMEOUT_S = 10.0  # the thread's own end, after leases are given up


class Lease:
    """A granted lease for threads; see `clients.lease.AsyncLease`."""

    def __init__(self, client: "Client", lease: AsyncLease) -> None:
        self._client = client
        self._lease = lease

    @property
    def lease_id(self) -> str:
        return self._lease.lease_id

    @property
    def token(self) -> tuple[int, int]:
        return self._lease.token

    @property
    def spec(self) -> LeaseSpec:
        return self._lease.spec

    @property
    def view(self) -> Mapping[str, Any]:
        return self._lease.view

    @property
    def gpu(self) -> str:
        return self._lease.gpu

    @property
    def state(self) -> LeaseState:
        return self._lease.state

    @property
    def revoking(self) -> bool:
        return self._lease.revoking

    @property
    def evicted(self) -> Eviction | None:
        """Who made it leave, and why; see `clients.lease.AsyncLease.evicted`."""
        return self._lease.evicted

    @property
    def error(self) -> VramError | None:
        """Why the lease is gone, if it was not we who ended it."""
        return self._lease.error

    def __repr__(self) -> str:
        return repr(self._lease)

    def ready(self, measured_bytes: int | None = None) -> None:
        self._client.run(self._lease.ready(measured_bytes))

    @contextmanager
    def use(self, label: str = "") -> Iterator["Use"]:
        """A busy interval. Raises LeaseRevoking or LeaseLost before it begins."""
        interval = self._lease.use(label)
        use = self._client.run(interval.__aenter__())
        inside.enter(use.use_id)  # the loop's thread entered it for itself only
        try:
            yield Use(self._client, use)
        finally:
            self._client.run(interval.__aexit__(None, None, None))

    def oom(self, requested_bytes: int, allocated_bytes: int | None = None) -> None:
        self._client.run(self._lease.oom(requested_bytes, allocated_bytes))

    def resize(self, footprint: Footprint, wait_timeout_s: float | None = None) -> None:
        self._client.run(self._lease.resize(footprint, wait_timeout_s))

    def park(self) -> None:
        self._client.run(self._lease.park())

    def reacquire(self, wait_timeout_s: float | None = None) -> None:
        self._client.run(self._lease.reacquire(wait_timeout_s))

    def wait_returned(self) -> None:
        self._client.run(self._lease.wait_returned())

    def release(self, *, exiting: bool = False) -> None:
        self._client.run(self._lease.release(exiting=exiting))

    def give_up(self) -> None:
        self._client.run(self._lease.give_up())

    def wait_gone(self) -> None:
        self._client.run(self._lease.wait_gone())


class Use:
    """A use on one's own lease; see `clients.lease.AsyncUse`."""

    def __init__(self, client: "Client", use: AsyncUse) -> None:
        self._client = client
        self._use = use

    @contextmanager
    def yielded(self) -> Iterator[None]:
        """Inside, the use does not keep the lease. Raises LeaseRevoking or LeaseLost at the end if it has left meanwhile."""
        interval = self._use.yielded()
        self._client.run(interval.__aenter__())
        try:
            yield
        finally:
            self._client.run(interval.__aexit__(None, None, None))
            inside.enter(self._use.use_id)


class Client:
    """`with`, or `connect` and `close`. Raises as `clients.client.AsyncClient`."""

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        name: str,
        role: str = "client",
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self._client = AsyncClient(
            endpoint, name=name, role=role, connect_timeout_s=connect_timeout_s
        )
        self._pid = os.getpid()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    # -- connection ------------------------------------------------------------------------------------------------
    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def connected(self) -> bool:
        return self._client.connected

    @property
    def epoch(self) -> int | None:
        return self._client.epoch

    @property
    def endpoint(self) -> str:
        return self._client.endpoint

    def connect(self) -> None:
        if self._loop is not None:
            return
        loop = asyncio.new_event_loop()
        self._thread = threading.Thread(
            target=_serve, args=(loop,), name="vram-arbiter-client", daemon=True
        )
        self._thread.start()
        self._loop = loop
        try:
            self.run(self._client.connect())
        except BaseException:
            self._end_thread()
            raise

    def close(self) -> None:
        """Give up all leases and end the background thread. In a forked child: only forget (the parent owns the socket)."""
        if self._loop is None or os.getpid() != self._pid:
            return
        try:
            self.run(self._client.close())
        finally:
            self._end_thread()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine on the client's loop and wait for it. Ctrl-C cancels it there too."""
        if self._loop is None or os.getpid() != self._pid:
            work.close()
            what = "closed" if self._loop is None else "made before a fork"
            raise BadState(
                f"this client was {what}", hint="make one in this process, use it inside `with`"
            )
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    # -- leases ------------------------------------------------------------------------------------------------------
    def acquire(
        self,
        spec: LeaseSpec,
        wait_timeout_s: float | None = None,
        *,
        unload: SyncUnload | None = None,
        park: SyncUnload | None = None,
        on_return: SyncOnReturn | None = None,
        on_revoke: SyncOnRevoke | None = None,
        on_lost: SyncOnLost | None = None,
        safe_point_eta_s: SafePointEta | None = None,
    ) -> Lease:
        """Block until granted. Raises WaitTimeout, VramInsufficient, UnknownGpu, HolderBusy, LimitExceeded."""

        async def revoked(lease: AsyncLease, push: Mapping[str, Any]) -> None:
            if on_revoke is not None:
                await asyncio.to_thread(on_revoke, Lease(self, lease), push)

        async def lost(lease: AsyncLease, error: VramError) -> None:
            if on_lost is not None:
                await asyncio.to_thread(on_lost, Lease(self, lease), error)

        async def returned(lease: AsyncLease) -> None:
            if on_return is not None:
                await asyncio.to_thread(on_return, Lease(self, lease))

        granted = self._client.acquire(
            spec,
            wait_timeout_s,
            unload=None if unload is None else partial(asyncio.to_thread, unload),
            park=None if park is None else partial(asyncio.to_thread, park),
            on_return=returned,
            on_revoke=revoked,
            on_lost=lost,
            safe_point_eta_s=safe_point_eta_s,
        )
        return Lease(self, self.run(granted))

    @contextmanager
    def lease(
        self,
        spec: LeaseSpec,
        wait_timeout_s: float | None = None,
        *,
        unload: SyncUnload | None = None,
        park: SyncUnload | None = None,
        on_return: SyncOnReturn | None = None,
        on_revoke: SyncOnRevoke | None = None,
        on_lost: SyncOnLost | None = None,
        safe_point_eta_s: SafePointEta | None = None,
    ) -> Iterator[Lease]:
        """`acquire`, and at the end of the block: unload and release, also when the block raises."""
        lease = self.acquire(
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
            lease.give_up()

    @contextmanager
    def use(
        self, lease_id: str, token: Sequence[int], label: str = ""
    ) -> Iterator[AsyncForeignUse]:
        """A use on a lease of another process, by its token."""
        use = self.run(self._client.begin_use(lease_id, token, label))
        inside.enter(use.use_id)
        try:
            yield use
        finally:
            self.run(use.end())

    # -- questions ---------------------------------------------------------------------------------------------------
    def status(self) -> Message:
        return self.run(self._client.status())

    def why(self, consumer: str) -> Message:
        return self.run(self._client.why(consumer))

    def history(self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()) -> Message:
        return self.run(self._client.history(after, limit, kinds))

    def ping(self) -> Message:
        return self.run(self._client.ping())

    def subscribe(self) -> Iterator[Message]:
        """History events from now on; blocks for the next one. Close the iterator to stop."""
        events = self._client.subscribe()
        try:
            while True:
                yield self.run(_next(events.__anext__))
        finally:
            self.run(_next(events.aclose))  # type: ignore[attr-defined]  # an async generator

    # -- steps -------------------------------------------------------------------------------------------------------
    def _end_thread(self) -> None:
        assert self._loop is not None
        assert self._thread is not None
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_TIMEOUT_S)
        self._loop = self._thread = None


async def _next(step: Callable[[], Any]) -> Any:
    return await step()


def _serve(loop: asyncio.AbstractEventLoop) -> None:
    asyncio.set_event_loop(loop)
    try:
        loop.run_forever()
    finally:
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()
