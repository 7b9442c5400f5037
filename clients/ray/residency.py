"""The model of one object on the GPU: its lease is acquired with the first call, and again after an
eviction. It does not know Ray.

A use costs an exchange with the arbiter. Calls that begin within SHARE_S of a use's beginning run
inside that use, so that short calls pay a fraction of it. The use ends with the last of them, and
no call joins it once the lease is revoked.
"""

import asyncio
import contextlib
import os
import threading
import time
import weakref
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Protocol

from anyio import WouldBlock

from vram_arbiter.clients import use_context
from vram_arbiter.clients.sync import Client, Lease, Use
from vram_arbiter.schemas.errors import (
    LeaseExpired,
    LeaseLost,
    LeaseRevoking,
    StaleToken,
    TransientError,
    UnknownLease,
    VramError,
)
from vram_arbiter.schemas.wire.spec import LeaseSpec

SHARE_S: Final = 0.02
"""Within a pause as short as this an eviction is not worth a reload; it may be as late as this."""

LEFT: Final = (LeaseRevoking, LeaseLost, LeaseExpired, StaleToken, UnknownLease)
"""Refusals of a use whose lease leaves, or has left: a call acquires again."""

_within: ContextVar[frozenset[int]] = ContextVar("residencies_within", default=frozenset())
"""Ids of the residencies that the running code has loaded, or is about to load."""


class Refused(TransientError):
    """The box has no room within the wait, or no arbiter: place the actor on another box."""


class Owner(Protocol):
    """What a leased object has. `lease` is set before `load`, which runs in the thread of a call;
    `unload` runs in a thread of the client."""

    lease: Lease

    def load(self) -> object: ...

    def unload(self) -> object: ...


@dataclass(slots=True, eq=False)
class Interval:
    """A use that several calls share; `open` while more may join, which counts as a call."""

    use: AbstractContextManager[Use]
    use_id: str
    name: str
    calls: int = 2
    open: bool = True


class Residency:
    """Lease and uses of one `owner`, which it does not keep alive. Any thread may call."""

    def __init__(self, owner: Owner, spec: LeaseSpec, wait_s: float) -> None:
        self._owner = weakref.ref(owner)
        self._name = f"{spec.consumer}-{os.getpid()}"
        self._spec = replace(spec, consumer=self._name)
        self._wait_s = wait_s
        self._client: Client | None = None
        self._lease: Lease | None = None
        self._refused: Refused | None = None
        self._refused_at = 0.0
        self._entering = threading.Lock()
        self._thread = ThreadPoolExecutor(1)  # of coroutines' calls
        self._interval: Interval | None = None
        self._counting = threading.Lock()  # of calls; held for a moment

    @property
    def within(self) -> bool:
        """Whether the caller is inside one of its calls, or inside `load`."""
        return id(self) in _within.get()

    @contextlib.contextmanager
    def call(self, label: str) -> Iterator[None]:
        """Run a block inside a use, loaded. Raises Refused, and what `load` raises."""
        with self._inside(self._join() or self._enter(label, time.monotonic())):
            yield

    @contextlib.asynccontextmanager
    async def acall(self, label: str) -> AsyncIterator[None]:
        """`call` for coroutines, on any event loop."""
        with self._inside(self._join() or self._entered_now(label) or await self._entered(label)):
            yield

    # -- steps
    def _entered_now(self, label: str) -> Interval | None:
        """`_enter` where nothing has to be waited for."""
        if self._lease is None or not self._entering.acquire(blocking=False):
            return None
        try:
            return self._join() or self._begin(self._lease, label, wait=False)
        except WouldBlock:
            return None
        finally:
            self._entering.release()

    async def _entered(self, label: str) -> Interval:
        """`_enter` in a thread. Where the caller is canceled, what it begins is ended."""
        entering = self._thread.submit(self._enter, label, time.monotonic())
        try:
            return await asyncio.wrap_future(entering)
        except asyncio.CancelledError:
            entering.add_done_callback(self._abandon)
            raise

    def _abandon(self, entered: Future[Interval]) -> None:
        if not entered.cancelled() and entered.exception() is None:
            self._leave(entered.result())

    @contextlib.contextmanager
    def _inside(self, interval: Interval) -> Iterator[None]:
        outside = _within.set(_within.get() | {id(self)})
        use_context.enter(interval.use_id, interval.name)
        try:
            yield
        finally:
            _within.reset(outside)
            self._leave(interval)

    def _join(self) -> Interval | None:
        """Join the use of another call, if there is one that may be joined."""
        with self._counting:
            interval, lease = self._interval, self._lease
            if interval is None or not interval.open or lease is None or lease.state != "held":
                return None
            interval.calls += 1
            return interval

    def _enter(self, label: str, since: float) -> Interval:
        """Begin a use, loaded, which others may join; they wait for it here, or for its refusal.
        The lease may be revoked at any moment before."""
        with self._entering:
            if self._refused is not None and self._refused_at > since:
                raise self._refused
            while (joined := self._join()) is None:
                lease = self._loaded()
                try:
                    return self._begin(lease, label, wait=True)
                except LEFT:
                    continue
            return joined

    def _begin(self, lease: Lease, label: str, *, wait: bool) -> Interval:
        use, name = lease._use(label, wait=wait), use_context.named(label, lease.lease_id)
        self._interval = interval = Interval(use, use.__enter__().use_id, name)
        lease._portal.soon(self._share, interval)
        return interval

    def _share(self, interval: Interval) -> None:
        """Let calls join for SHARE_S. Runs on the client's loop."""
        asyncio.get_running_loop().call_later(SHARE_S, self._close, interval)

    def _close(self, interval: Interval) -> None:
        interval.open = False
        self._leave(interval)

    def _leave(self, interval: Interval) -> None:
        with self._counting:
            interval.calls -= 1
            over = not interval.calls
        if over:
            interval.use.__exit__(None, None, None)

    def _loaded(self) -> Lease:
        lease = self._lease
        while lease is not None and lease.revoking:  # which may be withdrawn
            lease.wait_change(lease.state)
        if lease is not None and lease.state == "gone":
            lease.wait_gone()  # and for its unload
            lease = None
        self._lease = lease or self._load()
        return self._lease

    def _load(self) -> Lease:
        owner = self._owner()
        assert owner is not None, "its method runs"
        owner.lease = lease = self._granted()
        outside = _within.set(_within.get() | {id(self)})
        try:
            owner.load()
        except BaseException:
            lease.give_up()
            raise
        finally:
            _within.reset(outside)
        with contextlib.suppress(*LEFT):  # lost meanwhile: the use says so
            lease.ready()
        return lease

    def _granted(self) -> Lease:
        try:
            if self._client is None:
                self._client = _connected(self._name)
            unload = partial(_unload, self._owner)
            return self._client.acquire(self._spec, self._wait_s, unload=unload)
        except VramError as error:
            self._refused_at = time.monotonic()
            self._refused = Refused(
                f"{self._name} is not granted here: {error.message}",
                hint="place it on another box, or raise wait_s",
                details={"code": error.code, **error.details},
            )
            raise self._refused from None


def _connected(name: str) -> Client:
    """A client that is left, with its leases, when it is collected."""
    client = Client(name).__enter__()
    client._dropped.detach()  # which would warn
    weakref.finalize(client, client._portal.abandon)
    return client


def _unload(owner: weakref.ref[Owner]) -> None:
    if (alive := owner()) is not None:
        alive.unload()
