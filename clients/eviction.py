"""How a lease leaves the card: never in the middle of a use, whoever wants it to go: a `revoke`, its holder, or because it is lost.

asyncio; one `Leaving` for each lease, made by `clients.lease`. The way out is one task (`_leave`), which waits for the safe point, lets the
holder free its bytes and tells the arbiter, through the `Driver`. It must not know what a holder may do with its lease meanwhile.
"""

import asyncio
import inspect
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from vram_arbiter.clients._protocol.leases import GONE_CODES
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.clients._protocol.records import LeaseRecord
from vram_arbiter.schemas.errors import ArbiterUnreachable, BadState, VramError
from vram_arbiter.schemas.wire.requests import LeaseSpec

log = logging.getLogger(__name__)

Unload = Callable[[], Awaitable[None] | None]
"""A plain function, or a coroutine function. A plain one runs on the loop, so a long one holds up renewals."""

RETRY_UNLOADING_S = 0.25
"""Somebody else's use is still on the lease: the arbiter pushes when it ends; this only covers a lost push."""
ANNOUNCE_TIMEOUT_S = 5.0
RELEASE_TIMEOUT_S = 5.0
"""A holder does not wait longer for the arbiter to hear that it let go. Who left for good ends by ttl there; who wants to come back goes
on telling it (`clients._protocol.leases`)."""


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


@dataclass(slots=True)
class Progress:
    """Wakes whoever waits for a change of a lease."""

    waiters: dict["asyncio.Future[None]", None] = field(
        default_factory=dict
    )  # in the order of their coming

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


class Leaving:
    """What a lease is on its way to, and who waits for it.

    `unload` frees the bytes, `park` too but keeps the weights in host RAM; `clients.lease.Callbacks` says when which of them runs.
    """

    def __init__(
        self,
        driver: Driver,
        record: LeaseRecord,
        spec: LeaseSpec,
        unload: Unload | None,
        park: Unload | None,
    ) -> None:
        self.uses: set[str] = set()
        """Of the holder, under way: there is no safe point before they have ended."""
        self.asked = False  # to leave: no new uses
        self.own_will = False  # the holder itself leaves, so it is not loading any more
        self.unloading = False
        self.gone = False  # the lease itself
        self.over = False  # lease gone and unload done
        self.progress = Progress()
        self._driver = driver
        self._record = record
        self._spec = spec
        self._unload = unload
        self._park = park
        self._park_now = False  # the holder itself wants to park
        self._unloaded = False
        self._task: asyncio.Task[None] | None = None

    # -- whoever wants it to go ---------------------------------------------------------------------------------------
    def start(self) -> None:
        """No new uses; it leaves at the next safe point."""
        self.asked = True
        if self._task is None and not self.gone:
            self._task = self._driver.spawn(self._leave(), f"leave {self._record.lease_id}")

    async def park(self) -> None:
        """Leave of the holder's own will, to come back; returns when the arbiter has said how: it sleeps, or is over."""
        token, self._park_now = self._record.token, True
        self.start()
        while (
            not self.over
            and self._record.token == token
            and (self.unloading or not self._record.asleep)
        ):
            await self.progress.wait()

    async def give_up(self) -> None:
        """Leave of the holder's own will, for good; returns when that is done. Idempotent."""
        while not self.over:
            if self._record.asleep and not self.gone:
                if not self.unloading:
                    await self._unload_once()
                    await self.release()
                    return
            elif (
                not self.own_will
            ):  # also where it went to sleep, and came back, while we waited for its end
                self.own_will = True
                self.start()
                self.progress.changed()
            await self.progress.wait()

    async def release(self, *, exiting: bool = False) -> None:
        """The bytes are freed already. Idempotent; what the arbiter refuses is raised, and the lease over all the same."""
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
        """The lease ended without us; `free_what_was_lost` has to follow."""
        self.gone = self.asked = True

    async def free_what_was_lost(self, fenced: bool) -> None:
        """Its bytes go at the next safe point. `fenced`: we ended it, the arbiter may not know."""
        while self.uses:
            await self.progress.wait()
        if self.unloading and self._task is not None:
            await asyncio.wait([self._task])
        else:
            await self._unload_once()
        if fenced:  # the arbiter may live: tell it as soon as it can be reached
            self._driver.protocol.holdings.release(
                self._record, False, self._driver.now(), RELEASE_TIMEOUT_S
            )
            self._driver.pump()

    def returned(self) -> None:
        """It is granted again: nobody has asked it to leave since."""
        self.asked = self.own_will = self.unloading = self._unloaded = self._park_now = False
        self._task = None

    def end(self) -> None:
        self.gone = self.over = self.asked = True
        self.progress.changed()

    # -- steps ---------------------------------------------------------------------------------------------------------
    async def _leave(self) -> None:
        """1. Wait for the safe point: no local use, not loading. 2. Announce, until no use of others is on it. 3. Unload, or park.
        4. Release. A lease that may come back sleeps then; any other is over."""
        token = self._record.token
        while not self.gone:
            if self.uses or not (self._record.held or self.own_will):  # 1
                await self.progress.wait()
            elif not self._record.held or await self._announced():  # 2
                self.unloading = True
                asleep = await self._clear_the_card()  # 3
                if not self.gone:
                    try:
                        await self._release(exiting=False, asleep=asleep)  # 4
                    except (
                        VramError
                    ) as error:  # nothing is held any more, and its ttl ends it there
                        log.warning("%s: its release was refused: %s", self._record.lease_id, error)
                if self._record.token != token:
                    return  # granted again before this task came to hear of its release
                if self.gone or not self._record.asleep:
                    self.end()
                self.unloading = False
                self.progress.changed()
                return

    async def _clear_the_card(self) -> str:
        """Free the bytes; says how the lease is to wait for its return ("" if it is over)."""
        push = self._record.revoke
        may_park = self._park_now or (push is not None and bool(push.get("park")))
        if may_park and self._park is not None and not self.own_will:
            await self._guarded(self._park, "park")
            return "parked"
        await self._unload_once()
        return "standby" if self._spec.standby and push is not None and not self.own_will else ""

    async def _announced(self) -> bool:
        """Say `unloading`. False: not now; somebody else's use is on the lease, or there is no contact."""
        if self.own_will and not self._driver.connected:
            return True  # nobody can refuse, nobody can be granted: whoever wants to go may go
        request = self._driver.protocol.holdings.unloading(
            self._record, self._driver.now(), ANNOUNCE_TIMEOUT_S
        )
        try:
            await self._driver.reply(request)
        except BadState as error:
            if error.details.get("uses"):
                await self.progress.wait(RETRY_UNLOADING_S)
                return False
        except ArbiterUnreachable:
            return False  # stay resident: back in contact or fenced, whichever comes first
        except VramError as error:
            if error.code not in GONE_CODES:  # else `lost` is told by the protocol
                log.warning(
                    "%s: its `unloading` was refused, it is said again: %s",
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

    async def _guarded(self, work: Unload, what: str) -> None:
        try:
            result = work()
            if inspect.isawaitable(result):
                await result
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
                self._hear_of_release(request), f"release of {self._record.lease_id}"
            )
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
            log.info("%s is not parked: %s", self._record.lease_id, error)
            await self._unload_once()
            await self._release(exiting=exiting)

    async def _hear_of_release(self, request: int) -> None:
        """A lease that sleeps without the arbiter's word may turn out to be over."""
        try:
            await self._driver.reply(request)
        except ArbiterUnreachable:
            self._warn_unheard()
        finally:
            if self._record.released and not self._record.asleep and not self.over:
                self.end()

    def _warn_unheard(self) -> None:
        then = (
            "it is told until it has, to let it come back"
            if self._record.asleep
            else "it ends by its ttl"
        )
        log.warning("the arbiter did not hear the release of %s; %s", self._record.lease_id, then)
