"""A lease as its holder sees it, for async programs; made by `clients.client`.

It owns no socket: everything that goes over the wire goes through the `Driver`. How a lease leaves
the GPU is `clients.eviction`.
"""

import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from contextvars import ContextVar
from typing import Final, Literal

import anyio.lowlevel

from vram_arbiter.clients import use_context
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.records import Eviction, LeaseRecord
from vram_arbiter.clients.eviction import Departure, Driver
from vram_arbiter.clients.handlers import Handlers, call
from vram_arbiter.schemas.defaults import NAME_MAX_CHARS
from vram_arbiter.schemas.errors import BadRequest, BadState, LeaseLost, LeaseRevoking, VramError
from vram_arbiter.schemas.ids import Token, UseId
from vram_arbiter.schemas.wire.pushes import RevokePush
from vram_arbiter.schemas.wire.requests import Oom, RevokeAck, UseBegin, UseEnd
from vram_arbiter.schemas.wire.spec import LeaseSpec

log = logging.getLogger(__name__)

PAUSE_S: Final = 0.02
"""A use so long after the one before begins ahead of the arbiter's answer. Uses in a row wait for
it, so that they are never told faster than the arbiter hears."""

LeaseState = Literal["loading", "held", "revoking", "unloading", "standby", "parked", "gone"]

_restored_here: ContextVar["AsyncLease | None"] = ContextVar("restored_here", default=None)
"""The lease whose `restore` handler the caller is part of: a use there does not wait for its end.
"""


class AsyncLease:
    """A granted lease. `give_up` runs the `unload` handler; `release` reports bytes that the holder
    freed itself."""

    def __init__(
        self,
        driver: Driver,
        record: LeaseRecord,
        spec: LeaseSpec,
        handlers: "Handlers[AsyncLease]",
    ) -> None:
        self._spec = spec
        self._error: VramError | None = None
        self._driver = driver
        self._record = record
        self._handlers = handlers
        self._departure = Departure(driver, record, spec, handlers.unload, handlers.park)
        self._restoring = False
        self._ahead_from = 0.0  # when a use may begin ahead of the arbiter's answer

    # -- what it is --------------------------------------------------------------------------------
    @property
    def lease_id(self) -> str:
        return self._record.lease_id

    @property
    def token(self) -> Token:
        """Fencing token (epoch, serial). A process that has it and the lease id can mark uses."""
        return self._record.token

    @property
    def spec(self) -> LeaseSpec:
        """What was asked for."""
        return self._spec

    @property
    def gpu(self) -> str:
        """UUID of the GPU that was granted."""
        return str(self._record.view.gpu)

    @property
    def state(self) -> LeaseState:
        if self._departure.gone:
            return "gone"
        if self._record.asleep:
            return "parked" if self._record.asleep == "parked" else "standby"
        if self._departure.unloading:
            return "unloading"
        if self._departure.asked:
            return "revoking"
        return "held" if self._record.held else "loading"

    @property
    def uses(self) -> int:
        """Number of in-flight uses of this holder."""
        return len(self._departure.uses)

    @property
    def revoking(self) -> bool:
        """Whether the lease is on its way out, or away."""
        return self._departure.asked and not self._departure.gone

    @property
    def evicted(self) -> Eviction | None:
        """Why the arbiter revoked the lease, from the first `revoke` on, also when it is gone.
        None: it did not."""
        return None if self._record.revoke is None else Eviction.of(self._record.revoke)

    @property
    def given_up(self) -> bool:
        """Whether the holder itself ended the lease (`give_up`)."""
        return self._departure.own_will

    @property
    def error(self) -> VramError | None:
        """Why the lease is gone, if its holder did not end it."""
        return self._error

    def __repr__(self) -> str:
        return f"<Lease {self.lease_id} {self.spec.consumer} {self.state}>"

    # -- the holder's part -------------------------------------------------------------------------
    async def ready(self, measured_bytes: int | None = None) -> None:
        """Report that the model is loaded. `measured_bytes`: what the holder sees of its
        allocation.

        Raises: LeaseLost, BadState.
        """
        self._raise_if_gone()
        await self._driver.reply(
            self._driver.protocol.holdings.ready(self._record, measured_bytes, self._driver.now())
        )
        self._departure.progress.changed()

    @asynccontextmanager
    async def use(self, label: str = "") -> AsyncIterator["AsyncUse"]:
        """Mark a busy interval: the holder is not evicted inside it.

        The first use marks the lease ready, if `ready` was not called. A use after a pause does not
        wait for the arbiter: a `revoke` that is on its way waits for its end. A lease can be *lost*
        within a use (expired, fenced): check `state` in a long one.

        Raises: LeaseRevoking or LeaseLost before the block begins.
        """
        use = AsyncUse(self, label)
        await anyio.lowlevel.checkpoint()  # uses without an `await` must not hide a `revoke`
        try:
            if use._begin_ahead():
                use._tell(begun=True)
            else:
                await use._begin()
            use_context.enter(use.use_id, use.name)
            yield use
        finally:
            use._end()

    async def oom(self, requested_bytes: int, allocated_bytes: int | None = None) -> None:
        """Report an allocation that failed: the arbiter raises the model's learned footprint."""
        record, driver = self._record, self._driver
        request = Oom(record.lease_id, record.token, requested_bytes, allocated_bytes)
        await driver.reply(driver.protocol.holdings.ask(record, request, driver.now()))

    async def park(self) -> None:
        """Leave the GPU at the safe point and keep the weights in host RAM; `reacquire` returns.

        Where the arbiter has no host RAM to give, the lease ends as by `give_up` (see `state`).
        Raises: BadState.
        """
        if self._handlers.park is None or not self.spec.park_bytes:
            raise BadState(
                f"{self.lease_id} cannot park", hint="give a `park` handler and park_bytes"
            )
        self._raise_if_gone()
        await self._departure.park()

    async def reacquire(self, wait_timeout_s: float | None = None) -> None:
        """Come back from `standby` or `parked` as a waiter like any other. The `restore` handler
        has begun when this returns.

        Raises: WaitTimeout, WouldDeadlock, VramInsufficient: the lease is over then.
        """
        self._raise_if_gone()
        with use_context.bounded(self.spec.consumer, wait_timeout_s) as timeout_s:
            await self._driver.reply(
                self._driver.protocol.holdings.reacquire(
                    self._record, timeout_s, self._driver.now(), traces.present()
                )
            )
            await self.wait_returned()

    async def wait_returned(self) -> None:
        """Wait until an evicted lease is granted again (no wait for any other). Raises what ended
        it."""
        while self._record.asleep and not self._departure.gone:
            await self._departure.progress.wait()
        self._raise_if_gone()

    async def release(self, *, exiting: bool = False) -> None:
        """Report that the bytes are freed (`exiting`: the process ends now). Idempotent.

        Without contact to the arbiter it returns after 5 s: the lease then ends by its TTL.
        """
        await self._departure.release(exiting=exiting)

    async def give_up(self) -> None:
        """Allow no new uses, wait for those in flight, then run `unload` and release. Idempotent.

        Before `ready` it means that the load failed or was given up: `unload` frees what there is.
        A lease on standby stops waiting for its return; a parked one runs `unload` to free its host
        RAM.
        """
        await self._departure.give_up()

    async def wait_change(self, seen: LeaseState) -> LeaseState:
        """Wait until `state` differs from `seen` (no wait if the lease is over), and return it.

        A state that lasts for a moment may be missed, the last one never.
        """
        while self.state == seen and not self._departure.over:
            await self._departure.progress.wait()
        return self.state

    async def wait_gone(self) -> None:
        """Wait until the lease has ended and its `unload`, if any, is done."""
        while not self._departure.over:
            await self._departure.progress.wait()

    # -- the arbiter's part (called by the client) -------------------------------------------------
    def _revoke_asked(self, push: RevokePush) -> None:
        if not self._departure.gone:
            eta, record = self._handlers.safe_point_eta_s, self._record
            ack = RevokeAck(record.lease_id, record.token, eta() if eta else None)
            self._driver.protocol.holdings.ask(record, ack, self._driver.now(), quiet=True)
            with traces.joined(push.traceparent):  # the trace of the request that needs room
                if not self._departure.asked:
                    self._notify(self._handlers.on_revoke, "on_revoke", Eviction.of(push))
                self._departure.start()
        self._departure.progress.changed()

    def _revoke_withdrawn(self) -> None:
        """Note that the lease may stay: uses begin again, unless the unloading has begun."""
        self._departure.stay_if_withdrawn()
        self._departure.progress.changed()

    def _returned(self) -> None:
        """Note that the lease is granted again under a new token. The model is to be loaded now."""
        self._departure.returned()
        if self._handlers.restore is not None:
            self._restoring = True
            with traces.joined(self._record.wanted_by):  # by itself it begins a trace of its own
                self._driver.spawn(self._restore, name=f"restore {self.lease_id}")
            self._record.wanted_by = None
        self._departure.progress.changed()

    def _lost(self, error: VramError, fenced: bool) -> None:
        """Note that the lease ended without the holder. The bytes go at the next safe point."""
        if self._departure.gone:
            return
        self._error = error
        self._departure.cut_off()
        with traces.joined(None):
            self._driver.spawn(self._after_loss, error, fenced, name=f"lost {self.lease_id}")
        self._departure.progress.changed()

    def _closed(self, error: VramError) -> None:
        """Note that the client ended before the lease did."""
        if not self._departure.over:
            self._error = self._error or error
            self._departure.end()

    # -- steps -------------------------------------------------------------------------------------
    def _raise_if_gone(self) -> None:
        if self._departure.gone:
            told = f"evicted: {gone.reason}" if (gone := self.evicted) else "released"
            raise self._error or LeaseLost(f"{self.lease_id} was {told}", hint="acquire again")

    def _raise_if_leaving(self) -> None:
        self._raise_if_gone()
        if self._departure.asked or self._record.asleep:
            told = f": {gone.reason}" if (gone := self.evicted) else ""
            raise LeaseRevoking(
                f"{self.lease_id} was revoked{told}",
                hint="wait until it is granted again, or acquire again",
                details={"state": self.state},
            )

    async def _until_loaded(self) -> None:
        """Before a first use: wait for the `restore` handler, and mark the lease ready."""
        while (
            self._restoring
            and not (self._record.held or self._departure.asked)
            and _restored_here.get() is not self
        ):
            await self._departure.progress.wait()
        self._raise_if_leaving()
        if not self._record.held:
            await self.ready()
            self._raise_if_leaving()

    async def _restore(self) -> None:
        """Run the `restore` handler; a load that failed gives the lease up."""
        handler, token = self._handlers.restore, self.token
        assert handler is not None
        _restored_here.set(self)
        try:
            await call(handler, self)
        except Exception:
            log.exception("restore of %s failed: the lease is given up", self.lease_id)
            if self.token == token:
                await self.give_up()
            return
        finally:
            self._restoring = False
            self._departure.progress.changed()
        if self.token == token and self.state == "loading":
            await self.ready()

    async def _after_loss(self, error: VramError, fenced: bool) -> None:
        await self._departure.free_what_was_lost(fenced)
        if self._handlers.on_lost is not None:
            await self._call(self._handlers.on_lost, "on_lost", error)
        self._departure.end()

    def _notify(self, handler: Callable[..., object] | None, what: str, *arguments: object) -> None:
        if handler is not None:
            name = f"{what} {self.lease_id}"
            self._driver.spawn(self._call, handler, what, *arguments, name=name)

    async def _call(self, handler: Callable[..., object], what: str, *arguments: object) -> None:
        try:
            await call(handler, self, *arguments)
        except Exception:
            log.exception("%s of %s failed", what, self.lease_id)


class AsyncUse:
    """A use on the holder's own lease; made by `AsyncLease.use`."""

    def __init__(self, lease: AsyncLease, label: str) -> None:
        if len(label) > NAME_MAX_CHARS:
            raise BadRequest(
                f"expected a label of at most {NAME_MAX_CHARS} characters, got {len(label)}",
                hint="shorten it",
            )
        self._use_id = UseId(f"{lease.lease_id}/{lease._driver.new_id()}")
        self._lease = lease
        self._label = label
        self.name = use_context.named(label, lease.lease_id)

    @property
    def use_id(self) -> UseId:
        return self._use_id

    def _begin_ahead(self) -> bool:
        """Begin the use of a lease that cannot have ended: from here on it does not leave, and
        `_tell` has to follow. False: ask (`_begin`). Any thread may call."""
        lease, driver = self._lease, self._lease._driver
        now, ahead_from = driver.now(), lease._ahead_from
        lease._ahead_from = now + PAUSE_S
        return (
            now >= ahead_from
            and lease._departure.enter(self.use_id)
            # last: a lease that was away in between is not held before it is loaded
            and driver.protocol.holdings.is_certain(lease._record, now)
        )

    def _tell(self, *, begun: bool = False) -> int:
        """Tell the arbiter; return the request. A use that has begun counts there too if the lease
        was revoked in that moment."""
        lease, driver = self._lease, self._lease._driver
        request = driver.protocol.holdings.use_begin(
            lease._record, self.use_id, self._label, driver.now(), begun=begun
        )
        driver.pump()
        return request

    async def _begin(self) -> None:
        """Begin the use as the arbiter answers. Raises LeaseRevoking or LeaseLost if the lease
        leaves."""
        lease, driver = self._lease, self._lease._driver
        lease._raise_if_leaving()
        await lease._until_loaded()
        lease._departure.uses.add(self.use_id)
        if lease._record.held:
            await driver.told(self._tell())
        else:  # the answer lets the next model load
            await driver.reply(self._tell())

    def _end(self) -> None:
        """End the use, or what has begun of it, without waiting for the arbiter."""
        lease, driver = self._lease, self._lease._driver
        use_context.leave(self.use_id)
        lease._departure.uses.discard(self.use_id)
        driver.protocol.holdings.use_end(lease._record, self.use_id, driver.now())
        driver.pump()
        lease._departure.progress.changed()


class AsyncForeignUse:
    """A use on the lease of another process, begun with its token. It ends with the client at the
    latest."""

    def __init__(self, driver: Driver, request: UseBegin) -> None:
        self.name = use_context.named(request.label, request.lease_id)
        self._driver = driver
        self._request = request
        self._lost: VramError | None = None
        self._ended = False

    @property
    def lease_id(self) -> str:
        return self._request.lease_id

    @property
    def token(self) -> Token:
        return self._request.token

    @property
    def use_id(self) -> str:
        return self._request.use_id

    @property
    def lost(self) -> VramError | None:
        """Why the use ended early (the lease was gone after a restart of the arbiter), or None."""
        return self._lost

    async def end(self) -> None:
        """End the use; does not wait for the arbiter's answer. Idempotent."""
        if self._ended:
            return
        self._ended = True
        use_context.leave(self.use_id)
        self._driver.forget_use(self.use_id)
        begun = self._request
        request = UseEnd(begun.lease_id, begun.token, begun.use_id)
        self._driver.protocol.foreign_uses.end(request, self._driver.now())
        self._driver.pump()
