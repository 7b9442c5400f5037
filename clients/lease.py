"""The lease as its holder sees it: what he may do with it, and what he hears of it. asyncio; made by `clients.client`, never by hand.

It owns no socket: everything that goes over the wire goes through the `Driver`. How it leaves the card, whoever wants it to, is
`clients.eviction`.
"""

import inspect
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Literal

from vram_arbiter.clients import use_context as inside
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.records import Eviction, LeaseRecord, TokenPair
from vram_arbiter.clients.eviction import Driver, Leaving, Unload
from vram_arbiter.schemas.errors import BadState, LeaseLost, LeaseRevoking, VramError
from vram_arbiter.schemas.wire.requests import Footprint, LeaseSpec

log = logging.getLogger(__name__)

LeaseState = Literal["loading", "held", "revoking", "unloading", "standby", "parked", "gone"]
OnRevoke = Callable[["AsyncLease", Mapping[str, Any]], Awaitable[None] | None]
OnLost = Callable[["AsyncLease", VramError], Awaitable[None] | None]
OnReturn = Callable[["AsyncLease"], Awaitable[None] | None]
SafePointEta = Callable[[], float | None]


@dataclass(frozen=True, slots=True)
class Callbacks:
    """What the holder does when the arbiter wants something.

    `unload` frees the bytes; it runs at a safe point, at most once a grant. `park` frees them too, but keeps the weights in host RAM: it
    runs in its place where the spec has `park_bytes` and the arbiter has room for them. `on_return` loads again after an eviction.
    """

    unload: Unload | None = None
    park: Unload | None = None
    on_return: OnReturn | None = None
    on_revoke: OnRevoke | None = None
    on_lost: OnLost | None = None
    safe_point_eta_s: SafePointEta | None = None


class AsyncLease:
    """A granted lease. Free it by `give_up` (runs `unload`) or by `release` (you freed the bytes yourself)."""

    def __init__(
        self, driver: Driver, record: LeaseRecord, spec: LeaseSpec, callbacks: Callbacks
    ) -> None:
        self.spec = spec
        self.error: VramError | None = None
        self._driver = driver
        self._record = record
        self._callbacks = callbacks
        self._leaving = Leaving(driver, record, spec, callbacks.unload, callbacks.park)
        self._resizing = False
        self._resize_error: VramError | None = None

    # -- what it is ------------------------------------------------------------------------------------------------
    @property
    def lease_id(self) -> str:
        return self._record.lease_id

    @property
    def token(self) -> TokenPair:
        """Fencing token (epoch, serial): hand it with the lease id to whoever marks uses of its own on this lease."""
        return self._record.token

    @property
    def view(self) -> Mapping[str, Any]:
        """`schemas.wire.LeaseView` as it was at the grant."""
        return self._record.view

    @property
    def gpu(self) -> str:
        return str(self._record.view.get("gpu"))

    @property
    def uses(self) -> int:
        """Uses that this holder began and has not ended."""
        return len(self._leaving.uses)

    @property
    def revoking(self) -> bool:
        return self._leaving.asked and not self._leaving.gone

    @property
    def revoke(self) -> Mapping[str, Any] | None:
        """`schemas.wire.RevokePush` as the arbiter sent it last; None unless it asks for this lease."""
        return self._record.revoke

    @property
    def evicted(self) -> Eviction | None:
        """Who made it leave, and why: from the first `revoke` on, and still when the lease is gone. None: nobody did."""
        return None if self._record.revoke is None else Eviction.of(self._record.revoke)

    @property
    def given_up(self) -> bool:
        """The holder itself turned away from it (`give_up`)."""
        return self._leaving.own_will

    @property
    def state(self) -> LeaseState:
        if self._leaving.gone:
            return "gone"
        if self._record.asleep:
            return "parked" if self._record.asleep == "parked" else "standby"
        if self._leaving.unloading:
            return "unloading"
        if self._leaving.asked:
            return "revoking"
        return "held" if self._record.held else "loading"

    def __repr__(self) -> str:
        return f"<Lease {self.lease_id} {self.spec.consumer} {self.state}>"

    # -- the holder's part -----------------------------------------------------------------------------------------
    async def ready(self, measured_bytes: int | None = None) -> None:
        """The model is loaded: `measured_bytes` is what the holder sees of its own allocation. Raises LeaseLost, BadState."""
        self._raise_if_gone()
        await self._driver.reply(
            self._driver.protocol.holdings.ready(self._record, measured_bytes, self._driver.now())
        )
        self._leaving.progress.changed()

    @asynccontextmanager
    async def use(self, label: str = "") -> AsyncIterator["AsyncUse"]:
        """Mark a busy interval: nobody makes the holder leave inside it. Raises LeaseRevoking or LeaseLost before it begins.

        A lease can be *lost* within a use (expired, fenced): look at `state` where a use is long. A use that has to wait for
        somebody who may need this very room lets go of it meanwhile: `async with use.yielded(): …`.
        """
        self._raise_if_leaving()
        use = AsyncUse(self, f"{self.lease_id}/{self._driver.new_id()}", label)
        try:
            await use.begin()
            yield use
        finally:
            inside.leave(use.use_id)
            self._leaving.uses.discard(use.use_id)
            self._driver.protocol.holdings.use_end(self._record, use.use_id, self._driver.now())
            self._driver.pump()
            self._leaving.progress.changed()

    async def oom(self, requested_bytes: int, allocated_bytes: int | None = None) -> None:
        """Tell the arbiter that an allocation failed: it raises the footprint that it knows of this model."""
        await self._driver.reply(
            self._driver.protocol.holdings.oom(
                self._record, requested_bytes, allocated_bytes, self._driver.now()
            )
        )

    async def resize(self, footprint: Footprint, wait_timeout_s: float | None = None) -> None:
        """Hold more (returns once there is room for it: allocate then) or less (free first; returns once it is measured gone).

        Raises VramInsufficient, WaitTimeout, WouldDeadlock, LeaseLost; the lease then keeps the size that it had. LeaseRevoking: it left meanwhile.
        """
        self._raise_if_leaving()
        self._resize_error = None
        request = self._driver.protocol.holdings.resize(
            self._record, footprint.model_dump(mode="json"), wait_timeout_s, self._driver.now()
        )
        self._resizing = True
        reply = await self._driver.reply(request)
        if reply["state"] == "held":
            self._resizing = False
        while self._resizing and not self._leaving.gone:
            await self._leaving.progress.wait()
        self._raise_if_gone()
        if self._resize_error is not None:
            raise self._resize_error
        self.spec = self.spec.model_copy(update={"footprint": footprint})

    async def park(self) -> None:
        """Leave the card of our own will, at the safe point, and keep the weights in host RAM: `reacquire` brings the lease back.

        Where the arbiter has no host RAM to give, the lease ends as by `give_up` (see `state`).
        """
        if self._callbacks.park is None or not self.spec.park_bytes:
            raise BadState(
                f"{self.lease_id} cannot park", hint="give a `park` callback and park_bytes"
            )
        self._raise_if_gone()
        await self._leaving.park()

    async def reacquire(self, wait_timeout_s: float | None = None) -> None:
        """Come back from `standby` or `parked` as a waiter like any other; `on_return` has begun to load when this returns.

        Raises WaitTimeout, VramInsufficient: the lease is over then.
        """
        self._raise_if_gone()
        await self._driver.reply(
            self._driver.protocol.holdings.reacquire(
                self._record, wait_timeout_s, self._driver.now(), traces.present()
            )
        )
        await self.wait_returned()

    async def wait_returned(self) -> None:
        """Until a lease that was evicted is granted again (at once for one that was not). Raises what ended it."""
        while self._record.asleep and not self._leaving.gone:
            await self._leaving.progress.wait()
        self._raise_if_gone()

    async def release(self, *, exiting: bool = False) -> None:
        """The bytes are freed already (`exiting`: the process ends now). Idempotent; a lease that is gone is released.

        Without the arbiter it gives up after 5 s: the lease then ends by its ttl. (One that was evicted and wants to come back is not
        released by its holder: it goes on telling the arbiter, however long that is away.)
        """
        await self._leaving.release(exiting=exiting)

    async def give_up(self) -> None:
        """Leave of our own will: no new uses, wait for those that run, then `unload` and release. Idempotent.

        Before `ready` it means that the load failed or was given up: `unload` frees what there is. A lease that was evicted and
        waits to come back waits no longer; one that is parked runs `unload` to free its host RAM.
        """
        await self._leaving.give_up()

    async def wait_change(self, seen: LeaseState) -> LeaseState:
        """Until its `state` is another than the one that the caller saw last (at once where it is over); says which.

        A state that lasts for a moment may be missed, but never the one that it ends in.
        """
        while self.state == seen and not self._leaving.over:
            await self._leaving.progress.wait()
        return self.state

    async def wait_gone(self) -> None:
        """Until the lease has ended and its `unload`, if any, is done."""
        while not self._leaving.over:
            await self._leaving.progress.wait()

    # -- the arbiter's part (called by the client) --------------------------------------------------------------------
    def revoke_asked(self, push: Mapping[str, Any], first: bool) -> None:
        if first and not self._leaving.gone:
            eta = self._callbacks.safe_point_eta_s
            self._driver.protocol.holdings.revoke_ack(
                self._record, eta() if eta else None, self._driver.now()
            )
            with traces.joined(
                push.get("traceparent")
            ):  # leaving is part of whose room it is to be
                if not self._leaving.asked and self._callbacks.on_revoke is not None:
                    self._driver.spawn(
                        self._call(self._callbacks.on_revoke, push), f"on_revoke {self.lease_id}"
                    )
                self._leaving.start()
        self._leaving.progress.changed()

    def returned(self) -> None:
        """Granted again under a new token. The model is to be loaded now."""
        self._leaving.returned()
        if self._callbacks.on_return is not None:
            with traces.joined(
                self._record.wanted_by
            ):  # coming back by itself it begins a trace of its own
                self._driver.spawn(
                    self._call(self._callbacks.on_return), f"on_return {self.lease_id}"
                )
            self._record.wanted_by = None
        self._leaving.progress.changed()

    def resized(self, error: VramError | None) -> None:
        """A resize that had to wait came to its end."""
        self._resizing, self._resize_error = False, error
        self._leaving.progress.changed()

    def lost(self, error: VramError, fenced: bool) -> None:
        """The lease ended without us. The bytes must go all the same, at the next safe point."""
        if self._leaving.gone:
            return
        self.error = error
        self._leaving.cut_off()
        with traces.joined(None):
            self._driver.spawn(self._after_loss(error, fenced), f"lost {self.lease_id}")
        self._leaving.progress.changed()

    # -- steps -------------------------------------------------------------------------------------------------------
    def _raise_if_gone(self) -> None:
        if self._leaving.gone:
            told = f"evicted: {gone.reason}" if (gone := self.evicted) else "released"
            raise self.error or LeaseLost(f"{self.lease_id} was {told}", hint="acquire again")

    def _raise_if_leaving(self) -> None:
        self._raise_if_gone()
        if self._leaving.asked or self._record.asleep:
            told = f": {gone.reason}" if (gone := self.evicted) else ""
            raise LeaseRevoking(
                f"{self.lease_id} was asked to leave{told}",
                hint="wait until it is granted again, or acquire again",
                details={"state": self.state},
            )

    async def _after_loss(self, error: VramError, fenced: bool) -> None:
        await self._leaving.free_what_was_lost(fenced)
        if self._callbacks.on_lost is not None:
            await self._call(self._callbacks.on_lost, error)
        self._leaving.end()

    async def _call(
        self, callback: Callable[..., Awaitable[None] | None], *arguments: object
    ) -> None:
        try:
            result = callback(self, *arguments)
            if inspect.isawaitable(result):
                await result
        except Exception:
            log.exception("callback of %s failed", self.lease_id)


class AsyncUse:
    """A use on one's own lease; made by `AsyncLease.use`."""

    def __init__(self, lease: AsyncLease, use_id: str, label: str) -> None:
        self.use_id = use_id
        self._lease = lease
        self._label = label

    async def begin(self) -> None:
        """Begin it, or take it up again. Raises LeaseRevoking or LeaseLost if the lease is on its way out or away."""
        lease = self._lease
        lease._raise_if_leaving()
        lease._leaving.uses.add(self.use_id)
        driver = lease._driver
        try:
            await driver.reply(
                driver.protocol.holdings.use_begin(
                    lease._record, self.use_id, self._label, driver.now()
                )
            )
        except BaseException:
            lease._leaving.uses.discard(self.use_id)
            raise
        inside.enter(self.use_id)

    @asynccontextmanager
    async def yielded(self) -> AsyncIterator[None]:
        """Inside, the use does not keep the lease: it may be evicted. At the end the use goes on, or begin's error is raised.

        For a job that asks in its middle for something that may need this very room (an LLM, say).
        """
        lease = self._lease
        driver = lease._driver
        await driver.reply(
            driver.protocol.holdings.use_yield(lease._record, self.use_id, driver.now())
        )
        inside.leave(self.use_id)
        lease._leaving.uses.discard(self.use_id)
        lease._leaving.progress.changed()
        try:
            yield
        finally:
            await self.begin()


class AsyncForeignUse:
    """A use on somebody else's lease, begun with its token. End it; a client that goes away ends it too."""

    def __init__(self, driver: Driver, lease_id: str, token: TokenPair, use_id: str) -> None:
        self.lease_id = lease_id
        self.token = token
        self.use_id = use_id
        self.lost: VramError | None = None
        """Why the use ended early (the lease was gone after a restart of the arbiter), or None."""
        self._driver = driver
        self._ended = False

    async def end(self) -> None:
        """Idempotent; does not wait for the arbiter's answer."""
        if self._ended:
            return
        self._ended = True
        inside.leave(self.use_id)
        self._driver.protocol.foreign_uses.end(
            self.lease_id, self.token, self.use_id, self._driver.now()
        )
        self._driver.pump()
