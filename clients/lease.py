"""The lease as its holder sees it: uses, the way out, and why it ended. asyncio; made by `clients.aio`, never by hand.

It owns no socket: everything that goes over the wire goes through the `Driver`. The way out is one task per lease
(`_leave`), whoever starts it: a `revoke`, `give_up`, or the loss of the lease. It waits for the safe point, never cuts a use short.
"""

import asyncio
import inspect
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from clients import inside, traces
from clients.holdings import GONE_CODES
from clients.protocol import ClientProtocol
from clients.records import LeaseRecord, TokenPair
from schemas.errors import (
    ArbiterUnreachable,
    BadState,
    LeaseLost,
    LeaseRevoking,
    VramError,
)
from schemas.wire import Footprint, LeaseSpec

log = logging.getLogger(__name__)

LeaseState = Literal["loading", "held", "revoking", "unloading", "standby", "parked", "gone"]
Unload = Callable[[], Awaitable[None]]
OnRevoke = Callable[["Lease", Mapping[str, Any]], Awaitable[None] | None]
OnLost = Callable[["Lease", VramError], Awaitable[None] | None]
OnReturn = Callable[["Lease"], Awaitable[None] | None]
SafePointEta = Callable[[], float | None]

RETRY_UNLOADING_S = 0.25
"""Somebody else's use is still on the lease: the arbiter pushes when it ends; this only covers a lost push."""
ANNOUNCE_TIMEOUT_S = 5.0
RELEASE_TIMEOUT_S = 5.0
"""A holder does not wait longer for the arbiter to hear that it let go. Who left for good ends by ttl there; who wants to come back goes
on telling it (`clients.holdings`)."""


class Driver(Protocol):
    """What a lease needs of its client."""

    protocol: ClientProtocol

    @property
    def connected(self) -> bool: ...

    def now(self) -> float: ...

    def new_id(self) -> str:
        """A name that nobody else uses; short enough for a use id."""
        ...

    async def reply(self, request_id: int) -> dict[str, Any]:
        """Send what is to be sent and wait for that answer. Raises its typed error."""
        ...

    def pump(self) -> None:
        """Send what is to be sent; nobody waits."""
        ...

    def spawn(self, work: Awaitable[None], name: str) -> "asyncio.Task[None]":
        """Run work that outlives the caller; the client waits for it at its end."""
        ...


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


@dataclass(slots=True)
class _Progress:
    """Wakes whoever waits for a change of a lease."""

    waiters: dict["asyncio.Future[None]", None] = field(default_factory=dict)  # in the order of their coming

    def changed(self) -> None:
        for waiter in self.waiters:
            if not waiter.done():
                waiter.set_result(None)
        self.waiters.clear()

    async def wait(self, timeout_s: float | None = None) -> None:
        waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.waiters[waiter] = None
        try:
            await asyncio.wait_for(waiter, timeout_s)
        except TimeoutError:
            pass
        finally:
            self.waiters.pop(waiter, None)


class Lease:
    """A granted lease. Free it by `give_up` (runs `unload`) or by `release` (you freed the bytes yourself)."""

    def __init__(self, driver: Driver, record: LeaseRecord, spec: LeaseSpec, callbacks: Callbacks) -> None:
        self.spec = spec
        self.error: VramError | None = None
        self._driver = driver
        self._record = record
        self._callbacks = callbacks
        self._uses: set[str] = set()
        self._asked = False  # to leave: no new uses
        self._own_will = False  # the holder itself leaves, so it is not loading any more
        self._park_now = False  # the holder itself wants to park
        self._unloading = False
        self._unloaded = False
        self._gone = False  # the lease itself
        self._over = False  # lease gone and unload done
        self._progress = _Progress()
        self._leaving: asyncio.Task[None] | None = None
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
        return len(self._uses)

    @property
    def revoking(self) -> bool:
        return self._asked and not self._gone

    @property
    def given_up(self) -> bool:
        """The holder itself turned away from it (`give_up`)."""
        return self._own_will

    @property
    def state(self) -> LeaseState:
        if self._gone:
            return "gone"
        if self._record.asleep:
            return "parked" if self._record.asleep == "parked" else "standby"
        if self._unloading:
            return "unloading"
        if self._asked:
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
        self._progress.changed()

    @asynccontextmanager
    async def use(self, label: str = "") -> AsyncIterator["Use"]:
        """Mark a busy interval: nobody makes the holder leave inside it. Raises LeaseRevoking or LeaseLost before it begins.

        A lease can be *lost* within a use (expired, fenced): look at `state` where a use is long. A use that has to wait for
        somebody who may need this very room lets go of it meanwhile: `async with use.yielded(): …`.
        """
        self._raise_if_leaving()
        use = Use(self, f"{self.lease_id}/{self._driver.new_id()}", label)
        try:
            await use.begin()
            yield use
        finally:
            inside.leave(use.use_id)
            self._uses.discard(use.use_id)
            self._driver.protocol.holdings.use_end(self._record, use.use_id, self._driver.now())
            self._driver.pump()
            self._progress.changed()

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
        while self._resizing and not self._gone:
            await self._progress.wait()
        self._raise_if_gone()
        if self._resize_error is not None:
            raise self._resize_error
        self.spec = self.spec.model_copy(update={"footprint": footprint})

    async def park(self) -> None:
        """Leave the card of our own will, at the safe point, and keep the weights in host RAM: `reacquire` brings the lease back.

        Where the arbiter has no host RAM to give, the lease ends as by `give_up` (see `state`).
        """
        if self._callbacks.park is None or not self.spec.park_bytes:
            raise BadState(f"{self.lease_id} cannot park", hint="give a `park` callback and park_bytes")
        self._raise_if_gone()
        self._park_now = True
        self._start_leaving()
        while not (self._over or self._record.asleep):
            await self._progress.wait()

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
        while self._record.asleep and not self._gone:
            await self._progress.wait()
        self._raise_if_gone()

    async def release(self, *, exiting: bool = False) -> None:
        """The bytes are freed already (`exiting`: the process ends now). Idempotent; a lease that is gone is released.

        Without the arbiter it gives up after 5 s: the lease then ends by its ttl. (One that was evicted and wants to come back is not
        released by its holder: it goes on telling the arbiter, however long that is away.)
        """
        self._asked = True
        if self._gone:
            return
        if self._record.asleep:
            self._driver.protocol.holdings.give_up_asleep(self._record, self._driver.now())
            self._driver.pump()
        else:
            self._unloaded = True
            try:
                await self._release(exiting=exiting)
            finally:  # whatever was answered: nothing is renewed from here on
                self._end()
            return
        self._end()

    async def give_up(self) -> None:
        """Leave of our own will: no new uses, wait for those that run, then `unload` and release. Idempotent.

        Before `ready` it means that the load failed or was given up: `unload` frees what there is. A lease that was evicted and
        waits to come back waits no longer; one that is parked runs `unload` to free its host RAM.
        """
        while not self._over:
            if self._record.asleep and not self._gone:
                if not self._unloading:
                    await self._unload_once()
                    await self.release()
                    return
            elif (
                not self._own_will
            ):  # also where it went to sleep, and came back, while we waited for its end
                self._own_will = True
                self._start_leaving()
                self._progress.changed()
            await self._progress.wait()

    async def wait_change(self, seen: LeaseState) -> LeaseState:
        """Until its `state` is another than the one that the caller saw last (at once where it is over); says which.

        A state that lasts for a moment may be missed, but never the one that it ends in.
        """
        while self.state == seen and not self._over:
            await self._progress.wait()
        return self.state

    async def wait_gone(self) -> None:
        """Until the lease has ended and its `unload`, if any, is done."""
        while not self._over:
            await self._progress.wait()

    # -- the arbiter's part (called by the client) --------------------------------------------------------------------
    def revoke_asked(self, push: Mapping[str, Any], first: bool) -> None:
        if first and not self._gone:
            eta = self._callbacks.safe_point_eta_s
            self._driver.protocol.holdings.revoke_ack(
                self._record, eta() if eta else None, self._driver.now()
            )
            with traces.joined(push.get("traceparent")):  # leaving is part of whose room it is to be
                if not self._asked and self._callbacks.on_revoke is not None:
                    self._driver.spawn(
                        self._call(self._callbacks.on_revoke, push), f"on_revoke {self.lease_id}"
                    )
                self._start_leaving()
        self._progress.changed()

    def returned(self) -> None:
        """Granted again under a new token. The model is to be loaded now."""
        self._asked = self._own_will = self._unloading = self._unloaded = self._park_now = False
        self._leaving = None
        if self._callbacks.on_return is not None:
            with traces.joined(self._record.wanted_by):  # coming back by itself it begins a trace of its own
                self._driver.spawn(self._call(self._callbacks.on_return), f"on_return {self.lease_id}")
            self._record.wanted_by = None
        self._progress.changed()

    def resized(self, error: VramError | None) -> None:
        """A resize that had to wait came to its end."""
        self._resizing, self._resize_error = False, error
        self._progress.changed()

    def lost(self, error: VramError, fenced: bool) -> None:
        """The lease ended without us. The bytes must go all the same, at the next safe point."""
        if self._gone:
            return
        self._gone, self._asked, self.error = True, True, error
        with traces.joined(None):
            self._driver.spawn(self._after_loss(error, fenced), f"lost {self.lease_id}")
        self._progress.changed()

    # -- steps -------------------------------------------------------------------------------------------------------
    def _raise_if_gone(self) -> None:
        if self._gone:
            raise self.error or LeaseLost(f"{self.lease_id} was released", hint="acquire again")

    def _raise_if_leaving(self) -> None:
        self._raise_if_gone()
        if self._asked or self._record.asleep:
            raise LeaseRevoking(
                f"{self.lease_id} was asked to leave",
                hint="wait until it is granted again, or acquire again",
                details={"state": self.state},
            )

    def _start_leaving(self) -> None:
        self._asked = True
        if self._leaving is None and not self._gone:
            self._leaving = self._driver.spawn(self._leave(), f"leave {self.lease_id}")

    async def _leave(self) -> None:
        """1. Wait for the safe point: no local use, not loading. 2. Announce, until no use of others is on it. 3. Unload, or park.
        4. Release. A lease that may come back sleeps then; any other is over."""
        token = self._record.token
        while not self._gone:
            if self._uses or not (self._record.held or self._own_will):  # 1
                await self._progress.wait()
            elif not self._record.held or await self._announced():  # 2
                self._unloading = True
                asleep = await self._clear_the_card()  # 3
                if not self._gone:
                    try:
                        await self._release(exiting=False, asleep=asleep)  # 4
                    except (
                        VramError
                    ) as error:  # whatever it was: nothing is held any more, and its ttl ends it there
                        log.warning("%s: its release was refused: %s", self.lease_id, error)
                if self._record.token != token:
                    return  # granted again before this task came to hear of its release
                if self._gone or not self._record.asleep:
                    self._end()
                self._unloading = False
                self._progress.changed()
                return

    async def _clear_the_card(self) -> str:
        """Free the bytes; says how the lease is to wait for its return ("" if it is over)."""
        push = self._record.revoke
        may_park = self._park_now or (push is not None and bool(push.get("park")))
        if may_park and self._callbacks.park is not None and not self._own_will:
            await self._guarded(self._callbacks.park, "park")
            return "parked"
        await self._unload_once()
        return "standby" if self.spec.standby and push is not None and not self._own_will else ""

    async def _announced(self) -> bool:
        """Say `unloading`. False: not now; somebody else's use is on the lease, or there is no contact."""
        if self._own_will and not self._driver.connected:
            return True  # nobody can refuse, nobody can be granted: whoever wants to go may go
        request = self._driver.protocol.holdings.unloading(
            self._record, self._driver.now(), ANNOUNCE_TIMEOUT_S
        )
        try:
            await self._driver.reply(request)
        except BadState as error:
            if error.details.get("uses") or error.details.get("children"):
                await self._progress.wait(RETRY_UNLOADING_S)
                return False
        except ArbiterUnreachable:
            return False  # stay resident: back in contact or fenced, whichever comes first
        except VramError as error:
            if error.code not in GONE_CODES:  # else `lost` is told by the protocol
                log.warning("%s: its `unloading` was refused, it is said again: %s", self.lease_id, error)
            await self._progress.wait(RETRY_UNLOADING_S)
            return False
        return True

    async def _after_loss(self, error: VramError, fenced: bool) -> None:
        while self._uses:
            await self._progress.wait()
        if self._unloading and self._leaving is not None:
            await asyncio.wait([self._leaving])
        else:
            await self._unload_once()
        if fenced:  # the arbiter may live: tell it as soon as it can be reached
            self._driver.protocol.holdings.release(self._record, False, self._driver.now(), RELEASE_TIMEOUT_S)
            self._driver.pump()
        if self._callbacks.on_lost is not None:
            await self._call(self._callbacks.on_lost, error)
        self._end()

    async def _unload_once(self) -> None:
        if self._unloaded:
            return
        self._unloaded = True
        if self._callbacks.unload is not None:
            await self._guarded(self._callbacks.unload, "unload")

    async def _guarded(self, work: Unload, what: str) -> None:
        try:
            await work()
        except Exception:
            log.exception("%s of %s failed; the arbiter will measure what is left", what, self.spec.consumer)

    async def _release(self, *, exiting: bool, asleep: str = "") -> None:
        request = self._driver.protocol.holdings.release(
            self._record, exiting, self._driver.now(), RELEASE_TIMEOUT_S, asleep=asleep
        )
        if not self._driver.connected:
            log.warning("%s is released without contact to the arbiter", self.lease_id)
            self._driver.spawn(self._hear_of_release(request), f"release of {self.lease_id}")
            return  # said when contact comes back soon, else its ttl ends it
        try:
            await self._driver.reply(request)
        except ArbiterUnreachable:
            self._warn_unheard()
        except VramError as error:
            if error.code in GONE_CODES:
                return
            if asleep != "parked":
                raise
            # no host RAM is left, or the arbiter does not let this lease park: the weights go too
            log.info("%s is not parked: %s", self.lease_id, error)
            await self._unload_once()
            await self._release(exiting=exiting)

    async def _hear_of_release(self, request: int) -> None:
        """A lease that sleeps without the arbiter's word may turn out to be over."""
        try:
            await self._driver.reply(request)
        except ArbiterUnreachable:
            self._warn_unheard()
        finally:
            if self._record.released and not self._record.asleep and not self._over:
                self._end()

    def _warn_unheard(self) -> None:
        then = "it is told until it has, to let it come back" if self._record.asleep else "it ends by its ttl"
        log.warning("the arbiter did not hear the release of %s; %s", self.lease_id, then)

    async def _call(self, callback: Callable[..., Awaitable[None] | None], *arguments: object) -> None:
        try:
            result = callback(self, *arguments)
            if inspect.isawaitable(result):
                await result
        except Exception:
            log.exception("callback of %s failed", self.lease_id)

    def _end(self) -> None:
        self._gone = self._over = self._asked = True
        self._progress.changed()


class Use:
    """A use on one's own lease; made by `Lease.use`."""

    def __init__(self, lease: Lease, use_id: str, label: str) -> None:
        self.use_id = use_id
        self._lease = lease
        self._label = label

    async def begin(self) -> None:
        """Begin it, or take it up again. Raises LeaseRevoking or LeaseLost if the lease is on its way out or away."""
        lease = self._lease
        lease._raise_if_leaving()
        lease._uses.add(self.use_id)
        driver = lease._driver
        try:
            await driver.reply(
                driver.protocol.holdings.use_begin(lease._record, self.use_id, self._label, driver.now())
            )
        except BaseException:
            lease._uses.discard(self.use_id)
            raise
        inside.enter(self.use_id)

    @asynccontextmanager
    async def yielded(self) -> AsyncIterator[None]:
        """Inside, the use does not keep the lease: it may be evicted. At the end the use goes on, or begin's error is raised.

        For a job that asks in its middle for something that may need this very room (an LLM, say).
        """
        lease = self._lease
        driver = lease._driver
        await driver.reply(driver.protocol.holdings.use_yield(lease._record, self.use_id, driver.now()))
        inside.leave(self.use_id)
        lease._uses.discard(self.use_id)
        lease._progress.changed()
        try:
            yield
        finally:
            await self.begin()


class ForeignUse:
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
        self._driver.protocol.foreign_uses.end(self.lease_id, self.token, self.use_id, self._driver.now())
        self._driver.pump()
