"""How a lease leaves the GPU: never inside a use, whether the arbiter revokes it, its holder gives
it up, or it is lost.

One `Departure` for each lease, made by `clients.lease`. A background task (`_leave`) waits for the
safe point, lets the holder free its bytes and tells the arbiter, through the `Driver`. The module
must not know what a holder may do with its lease meanwhile.
"""

import logging
from collections.abc import Awaitable, Callable
from typing import Final, Protocol

import anyio

from vram_arbiter.clients._protocol.leases import GONE_CODES
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.clients._protocol.records import LeaseRecord
from vram_arbiter.clients.handlers import Handler, call
from vram_arbiter.schemas.errors import ArbiterUnreachable, BadState, VramError
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.requests import Unloading
from vram_arbiter.schemas.wire.spec import LeaseSpec

log = logging.getLogger(__name__)

RETRY_UNLOADING_S: Final = 0.25
"""While another process uses the lease: the arbiter pushes when that ends; this covers a lost push.
"""
ANNOUNCE_TIMEOUT_S: Final = 5.0
RELEASE_TIMEOUT_S: Final = 5.0
"""How long a holder waits until the arbiter heard its release. A lease that left for good ends by
its TTL then; the release of one that is to come back is repeated (`clients._protocol.leases`)."""


class Driver(Protocol):
    """What a lease needs of its client."""

    protocol: ClientProtocol

    @property
    def connected(self) -> bool: ...

    def now(self) -> float: ...

    def new_id(self) -> str:
        """Return a unique name, short enough for a use id."""
        ...

    async def reply(self, request_id: int) -> AnyReply:
        """Send what is queued and wait for the answer to a request. Raises its typed error."""
        ...

    async def told(self, request_id: int) -> None:
        """Send what is queued and wait for the answer to a request, or for the loss of contact: it
        is sent again when the arbiter is back. Raises its typed error."""
        ...

    def forget_use(self, use_id: str) -> None:
        """Drop a use on the lease of another process: it has ended."""
        ...

    def pump(self) -> None:
        """Send what is queued, without waiting for an answer."""
        ...

    def spawn(self, work: Callable[..., Awaitable[None]], *arguments: object, name: str) -> object:
        """Run work that outlives the caller; the client cancels it at its own end."""
        ...


class Progress:
    """Wakes the tasks that wait for a change of a lease."""

    def __init__(self) -> None:
        self._event = anyio.Event()

    def changed(self) -> None:
        event, self._event = self._event, anyio.Event()
        event.set()

    async def wait(self, timeout_s: float | None = None) -> None:
        """Return at the next change, or after `timeout_s`."""
        with anyio.move_on_after(timeout_s):
            await self._event.wait()


class Departure:
    """The way of one lease from the GPU, and the tasks that wait for it.

    `unload` frees the bytes; `park` does too, but keeps the weights in host RAM.
    """

    def __init__(
        self,
        driver: Driver,
        record: LeaseRecord,
        spec: LeaseSpec,
        unload: Handler | None,
        park: Handler | None,
    ) -> None:
        self.uses: set[str] = set()
        """In-flight uses of the holder; there is no safe point before they have ended."""
        self.asked = False  # to leave: no new uses
        self.own_will = False  # the holder itself leaves, so it is not loading any more
        self.unloading = False
        self.gone = False  # the lease has ended
        self.over = False  # the lease has ended and the unload is done
        self.progress = Progress()
        self._driver = driver
        self._record = record
        self._spec = spec
        self._unload = unload
        self._park = park
        self._park_now = False  # the holder itself wants to park
        self._unloaded = False
        self._committed = False  # an `unloading` was sent and not refused: it may be heard
        self._left: anyio.Event | None = None  # set when `_leave` returns; None: it was not started

    def enter(self, use_id: str) -> bool:
        """Note a use. Returns whether it keeps the lease. Any thread may call: `asked` is read
        after the use is noted, and set before `_leave` looks for uses, so that one sees the other.
        """
        self.uses.add(use_id)
        return not self.asked

    # -- reasons to leave --------------------------------------------------------------------------
    def start(self) -> None:
        """Allow no new uses; leave at the next safe point."""
        self.asked = True
        if self._left is None and not self.gone:
            self._left = anyio.Event()
            self._driver.spawn(self._leave, self._left, name=f"leave {self._record.lease_id}")

    def stay_if_withdrawn(self) -> bool:
        """Allow uses again if the revoke was withdrawn; not where the arbiter may have heard that
        the unloading begins, nor where the holder itself leaves. Return whether the lease stays."""
        leaves = self.own_will or self._park_now or self.unloading or self.gone
        if not self._record.withdrawn or self._committed or leaves:
            return False
        self._record.stays()
        self.asked, self._left = False, None  # `_leave` ends
        self.progress.changed()
        return True

    async def park(self) -> None:
        """Leave on the holder's wish, to come back. Returns when the lease is asleep or over."""
        token, self._park_now = self._record.token, True
        self.start()
        while (
            not self.over
            and self._record.token == token
            and (self.unloading or not self._record.asleep)
        ):
            await self.progress.wait()

    async def give_up(self) -> None:
        """Leave on the holder's wish, for good. Returns when that is done. Idempotent."""
        while not self.over:
            if self._record.asleep and not self.gone:
                if not self.unloading:
                    await self._unload_once()
                    await self.release()
                    return
            elif not self.own_will:  # also where it slept and came back during this wait
                self.own_will = True
                self.start()
                self.progress.changed()
            await self.progress.wait()

    async def release(self, *, exiting: bool = False) -> None:
        """Report bytes that are freed already. Idempotent. Raises what the arbiter refuses with;
        the lease is over all the same."""
        self.asked = True
        if self.gone:
            return
        if self._record.asleep:
            self._driver.protocol.holdings.give_up_asleep(self._record, self._driver.now())
            self._driver.pump()
        else:
            self._unloaded = True
            try:
                await self._release(exiting=exiting)
            finally:  # whatever was answered: nothing is renewed from here on
                self.end()
            return
        self.end()

    def cut_off(self) -> None:
        """Note that the lease ended without the holder; `free_what_was_lost` has to follow."""
        self.gone = self.asked = True

    async def free_what_was_lost(self, fenced: bool) -> None:
        """Free the bytes at the next safe point. `fenced`: the client ended the lease, and the
        arbiter may not know."""
        while self.uses:
            await self.progress.wait()
        if self.unloading and self._left is not None:
            await self._left.wait()
        else:
            await self._unload_once()
        if fenced:  # the arbiter may live: tell it as soon as it can be reached
            self._driver.protocol.holdings.release(
                self._record, False, self._driver.now(), RELEASE_TIMEOUT_S
            )
            self._driver.pump()

    def returned(self) -> None:
        """Begin anew: the lease is granted again, and was not revoked since."""
        self.asked = self.own_will = self.unloading = self._unloaded = self._park_now = False
        self._committed, self._left = False, None

    def end(self) -> None:
        self.gone = self.over = self.asked = True
        self.progress.changed()

    # -- steps -------------------------------------------------------------------------------------
    async def _leave(self, left: anyio.Event) -> None:
        """1. Wait for the safe point: no use of the holder, not loading.
        2. Announce it, until no other process uses the lease. 3. Unload, or park. 4. Release.
        A lease that may come back is asleep then; any other is over. If the revoke is withdrawn
        before the unloading begins, the lease stays."""
        try:
            token = self._record.token
            while not self.gone and self._left is left and not self.stay_if_withdrawn():
                if self.uses or not (self._record.held or self.own_will):  # 1
                    await self.progress.wait()
                elif not self._record.held or await self._announced():  # 2
                    self.unloading = True
                    asleep = await self._clear_the_gpu()  # 3
                    if not self.gone:
                        try:
                            await self._release(exiting=False, asleep=asleep)  # 4
                        except VramError as error:  # nothing is held; its TTL ends the lease there
                            log.warning(
                                "%s: its release was refused: %s", self._record.lease_id, error
                            )
                    if self._record.token != token:
                        return  # granted again before this task saw the answer to its release
                    if self.gone or not self._record.asleep:
                        self.end()
                    self.unloading = False
                    self.progress.changed()
                    return
        finally:
            left.set()

    async def _clear_the_gpu(self) -> str:
        """Free the bytes. Returns how the lease waits for its return ("": it is over)."""
        push = self._record.revoke
        may_park = self._park_now or (push is not None and push.park)
        if may_park and self._park is not None and not self.own_will:
            await self._guarded(self._park, "park")
            return "parked"
        await self._unload_once()
        return "standby" if self._spec.standby and push is not None and not self.own_will else ""

    async def _announced(self) -> bool:
        """Report `unloading`. False: another process uses the lease, or contact is lost."""
        if self.own_will and not self._driver.connected:
            return True  # no arbiter, so no process can begin a use or be granted the room
        record, driver = self._record, self._driver
        unloading = Unloading(record.lease_id, record.token)
        asked = driver.protocol.holdings.ask(record, unloading, driver.now(), ANNOUNCE_TIMEOUT_S)
        self._committed = True
        try:
            await driver.reply(asked)
        except BadState as error:
            if error.details.get("uses"):
                self._committed = False
                await self.progress.wait(RETRY_UNLOADING_S)
                return False
        except ArbiterUnreachable:
            return False  # stay resident: back in contact or fenced, whichever comes first
        except VramError as error:
            self._committed = False
            if error.code not in GONE_CODES:  # else the protocol reports the loss
                log.warning(
                    "%s: its `unloading` was refused and is repeated: %s",
                    self._record.lease_id,
                    error,
                )
            await self.progress.wait(RETRY_UNLOADING_S)
            return False
        return True

    async def _unload_once(self) -> None:
        if self._unloaded:
            return
        self._unloaded = True
        if self._unload is not None:
            await self._guarded(self._unload, "unload")

    async def _guarded(self, handler: Handler, what: str) -> None:
        try:
            await call(handler)
        except Exception:
            log.exception(
                "%s of %s failed; the arbiter will measure what is left", what, self._spec.consumer
            )

    async def _release(self, *, exiting: bool, asleep: str = "") -> None:
        request = self._driver.protocol.holdings.release(
            self._record, exiting, self._driver.now(), RELEASE_TIMEOUT_S, asleep=asleep
        )
        if not self._driver.connected:
            log.warning("%s is released without contact to the arbiter", self._record.lease_id)
            self._driver.spawn(
                self._hear_of_release, request, name=f"release of {self._record.lease_id}"
            )
            return  # sent when contact comes back soon, else its TTL ends it
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
            log.info("%s is not parked: %s", self._record.lease_id, error)
            await self._unload_once()
            await self._release(exiting=exiting)

    async def _hear_of_release(self, request: int) -> None:
        """Wait for the answer: a lease that sleeps without the arbiter's word may be over."""
        try:
            await self._driver.reply(request)
        except ArbiterUnreachable:
            self._warn_unheard()
        finally:
            if self._record.released and not self._record.asleep and not self.over:
                self.end()

    def _warn_unheard(self) -> None:
        then = (
            "it is repeated, to let the lease come back"
            if self._record.asleep
            else "it ends by its ttl"
        )
        log.warning("the arbiter did not hear the release of %s; %s", self._record.lease_id, then)
