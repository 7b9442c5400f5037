"""Residency of one model: acquire, load, use, unload, in step with the lease.

States: unloaded → waiting (for the lease) → loading → resident → unloading → unloaded, or parking →
parked: off the GPU, with the weights in host RAM. One model, one lease at a time, and one process
for each residency (`model_process`), whose end returns all of its memory on the GPU. The lease's
own protocol (revoke, quiesce, release, fencing) is the client library's, which calls `_unload` or
`_park` when the bytes must go. A lease that is parked or on standby is not over: a request calls it
back as a waiter, and the arbiter grants one on standby again when there is room (`_restore` loads
then). Must not know sockets, wires or processes.

Weights are in host RAM (`host_copy`) while the model is wanted, resident or parked. The arbiter
grants the room for parked ones (`park_bytes`).
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Mapping
from typing import Final, Literal

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.errors import (
    BadState,
    Evicted,
    FrameStale,
    LeaseExpired,
    LeaseLost,
    LeaseRevoking,
    Loading,
    ModelError,
    NotResident,
    OutOfMemory,
    SidecarUnavailable,
    StaleToken,
    UnknownLease,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.sidecars.host_copy import HostCopy
from vram_arbiter.sidecars.model_process import Model, Models
from vram_arbiter.sidecars.settings import Settings

State = Literal["unloaded", "waiting", "loading", "resident", "parking", "parked", "unloading"]
TRANSITIONS: Final[Mapping[State, frozenset[State]]] = {
    "unloaded": frozenset({"waiting", "loading"}),  # loading: its lease came back by itself
    "waiting": frozenset({"loading", "unloaded"}),
    "loading": frozenset({"resident", "unloading", "unloaded"}),  # unloaded: its process died
    "resident": frozenset({"parking", "unloading", "unloaded"}),
    "parking": frozenset({"parked", "unloaded"}),
    "parked": frozenset({"waiting", "loading", "unloading"}),
    "unloading": frozenset({"unloaded"}),
}
"""State → states that may follow."""
Token = tuple[int, int]
_GONE = (LeaseRevoking, LeaseLost, LeaseExpired, StaleToken, UnknownLease, Evicted)
_LEAVING = ("revoking", "unloading")
_AWAY = ("standby", "parked")
_log = logging.getLogger("sidecars")


class Residency:
    """One model on or off one GPU.

    `client` None: no arbiter, so the model is loaded without a lease and stays.
    """

    def __init__(
        self,
        settings: Settings,
        models: Models,
        client: AsyncClient | None,
    ) -> None:
        self._settings = settings
        self._models = models
        self._client = client
        self._turn = asyncio.Lock()  # one attempt to become resident at a time
        self._model: Model | None = None
        self._prepared: asyncio.Task[None] | None = None
        self._host = HostCopy(models, client, settings.footprint.steady_bytes)
        self._left = asyncio.Event()  # the unload or parking in progress is over
        self._called_off = asyncio.Event()  # the load in progress is not wanted any more
        self._ending = False
        self._running = 0
        self._last_use_s = time.monotonic()
        self._resident_since_s = self._last_use_s
        self._obtaining: asyncio.Task[AsyncLease | None] | None = None
        self._unloads = 0  # number of unload requests: earlier waits for the model end
        # the call that brings a standby lease back
        self._calling: asyncio.Task[VramError | None] | None = None
        self._watching: asyncio.Task[None] | None = None  # the process's end
        self.lease: AsyncLease | None = None
        self.state: State = "unloaded"
        self.last_error: VramError | None = None

    # -- what the wire asks
    def prepare(self) -> None:
        """Begin the work (imports, processors) that needs neither weights nor a lease. Repeats only
        after a failure, or where the process has died since."""
        if self._prepared is None or self._prepared.done():
            self._prepared = asyncio.create_task(self._models.prepare(), name="prepare")

    def announce(self, by: str) -> None:
        """Read the weights into host RAM ahead of a request that `by` foresees.

        Only where the arbiter's budget of host RAM has room for them beside what is parked. They
        are dropped where no request comes for minutes. No lease is asked for.
        """
        if self._client is None or self._ending or self.state != "unloaded":
            return  # else they are in host RAM already, or on their way
        _log.info("%s says that the model is wanted soon", by)
        self._host.read_ahead(self.prepared, lambda: self.state != "unloaded" or self.wanted)

    async def prepared(self) -> None:
        """Wait for the work that `prepare` began. Raises what ended it."""
        if self._prepared is not None:
            await asyncio.shield(self._prepared)

    async def load(self, timeout_s: float | None = None) -> bool:
        """Make the model resident; return False if it was.

        `timeout_s` bounds the wait for the lease, not imports and loading. Raises the arbiter's
        refusal (WaitTimeout, VramInsufficient …), OutOfMemory, ModelError.
        """
        self._refuse_if_ending()
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                await self._turn.acquire()
        except TimeoutError:
            raise Loading(
                f"{self._settings.name} is still {self.state}", hint="ask again, or wait longer"
            ) from None
        try:
            return await self._load_in_turn(deadline)
        except VramError as error:
            self.last_error = error
            raise
        finally:
            self._turn.release()

    async def unload(self) -> None:
        """Give up the lease at the next safe point, or the wait for it: its waiters get
        NotResident.

        Otherwise do nothing.
        """
        self._unloads += 1
        if self._obtaining is not None and not self._obtaining.done():
            self._obtaining.cancel()
        elif self.lease is not None:
            await self.lease.give_up()
        elif self._client is None:
            if self.state == "loading":
                await self._end_model(at_once=True)  # the load undoes itself
            async with self._turn:
                if self.state == "resident":
                    await self._unload()

    async def run(
        self,
        label: str,
        token: Token | None,
        call: Message,
        *,
        fresh_s: float | None = None,
    ) -> Message:
        """Answer one request of the model's wire as a use of the lease.

        With a `token` the caller protects the lease by a use of its own: any other token than the
        current one raises Evicted. Without, the model is made resident first, also if it was
        evicted a moment ago. Raises FrameStale when the work could not begin within `fresh_s`: the
        model is resident by then, for a request with a newer picture.

        The use does not outlive the request's time. Work that has not begun by then never does
        (WaitTimeout). Work that does not end is ended with its process, and the lease is released
        (ModelError).
        """
        came_s = time.monotonic()
        deadline = came_s + self._settings.wait_timeout_s
        while True:
            if token is None:
                await self.load(max(0.0, deadline - time.monotonic()))
            else:
                self._check(token)
            lease, model = self.lease, self._model
            try:
                async with self._use(lease, label, handed=token is not None):
                    if model is None:
                        raise self._evicted()
                    return await model.run(
                        call,
                        begin_s=max(0.0, deadline - time.monotonic()),
                        end_s=self._settings.request_timeout_s,
                        begins=lambda: self._begins(model, came_s, fresh_s),  # noqa: B023
                    )
            except _GONE as error:
                if token is not None:
                    raise self._evicted() from error
                if lease is not None:
                    await self._until_left(
                        lease, deadline
                    )  # then there is a lease to ask for again

    def token(self) -> Token | None:
        """Token of the lease under which the model is resident now."""
        return self.lease.token if self.lease is not None and self.state == "resident" else None

    @property
    def on_standby(self) -> bool:
        """Whether the model is evicted and returns by itself."""
        return self.lease is not None and self.lease.state in _AWAY and self._settings.standby

    @property
    def wanted(self) -> bool:
        """Whether a request waits for the model, or its lease is being called back; `unload` ends
        both."""
        return self._turn.locked() or (self._calling is not None and not self._calling.done())

    async def leave(self) -> None:
        """End of the program: after the op in progress, free everything."""
        self._ending = True
        lease = self.lease
        if self._prepared is not None and not self._prepared.done():
            self._prepared.cancel()
            await asyncio.wait({self._prepared})
        await self._host.stop()
        await self._unload()
        await self._models.end()
        if lease is not None:
            await lease.release(exiting=True)

    async def release_when_idle(self, idle_s: float) -> None:
        """Release a model that was not used for `idle_s`, at the latest after twice as long.

        Runs beside the host. It never releases within the minimum residency, in which the request
        that had the model loaded begins to use it. A goal is a use that another process marks at
        the arbiter, and it may send no request for a while (its arm goes to the start pose): the
        arbiter is asked before the release. If it cannot be reached, the model stays.
        """
        while True:
            stays_until = max(
                self._last_use_s + idle_s, self._resident_since_s + self._settings.min_residency_s
            )
            left = stays_until - time.monotonic()
            if self.state == "resident" and not self._running and left <= 0:
                if await self._used_by_others():
                    _log.debug("in use by another process: not idle")
                    self._last_use_s = time.monotonic()
                else:
                    _log.info("idle for %.1f s: leaving the GPU", idle_s)
                    await self._leave_the_gpu()
            await asyncio.sleep(max(left, 0.05, idle_s / 10))

    async def _used_by_others(self) -> bool:
        if self._client is None or self.lease is None:
            return False
        try:
            status = await self._client.status()
        except VramError as error:
            _log.info("uses of the lease are unknown (%s): staying", error.code)
            return True
        return any(view.lease_id == self.lease.lease_id and view.uses for view in status.leases)

    def _to(self, state: State) -> None:
        """Go to another state; the only place that writes it."""
        assert state in TRANSITIONS[self.state], f"{self.state} → {state}"
        self.state = state

    # -- loading
    async def _load_in_turn(self, deadline: float | None) -> bool:
        if self.state == "resident" and (self.lease is None or self.lease.state == "held"):
            return False
        unloads = self._unloads
        if self.lease is not None and await self._brought_back(self.lease, deadline):
            return True
        self._refuse_if_ending()
        if unloads != self._unloads:
            raise self._unwanted()
        self._to("waiting")
        self._obtaining = asyncio.create_task(self._obtain(deadline), name="obtain")
        try:
            lease = await self._obtaining
            self._to("loading")
            self.lease = lease
            if unloads != self._unloads:  # an unload came in the moment of the grant
                if lease is not None:
                    await lease.release()
                raise self._unwanted()
            await self._load(lease)
        except BaseException as error:
            if self.state != "unloaded":
                self._to("unloaded")
            if not isinstance(error, WaitTimeout):  # asked again, it need not read them again
                self._host.drop()
            if (
                isinstance(error, asyncio.CancelledError)
                and unloads != self._unloads
                and not _being_cancelled()
            ):
                raise self._unwanted() from None
            raise
        finally:
            self._obtaining = None
        self.last_error = None
        return True

    def _refuse_if_ending(self) -> None:
        if self._ending:
            raise SidecarUnavailable(f"{self._settings.name} is ending", hint="start it again")

    async def _until_left(self, lease: AsyncLease, deadline: float | None) -> None:
        """Wait until a lease that is leaving has left, its bytes unloaded.

        Raises Loading when the time is over.
        """
        try:
            async with asyncio.timeout(_left_s(deadline)):
                while (leaving := lease.state) in _LEAVING:
                    await lease.wait_change(leaving)
                if lease.state == "gone":
                    await lease.wait_gone()
        except TimeoutError:
            raise Loading(
                f"{self._settings.name} is still {self.state}", hint="ask again, or wait longer"
            ) from None

    # -- coming back from standby
    async def _brought_back(self, lease: AsyncLease, deadline: float | None) -> bool:
        """Follow a leaving lease until it is resident again, calling it back from standby.

        Returns False if it ended, its bytes unloaded. Raises Loading or WaitTimeout when the time
        is over, or the arbiter's refusal. A wait that ends so goes on in the background: the model
        was wanted, and returns as soon as it may.
        """
        while (seen := lease.state) not in ("held", "gone"):
            if seen == "loading":  # `_restore` loads, without a limit
                await lease.wait_change(seen)
                continue
            try:
                async with asyncio.timeout(_left_s(deadline)):
                    if seen not in _AWAY:
                        await lease.wait_change(seen)
                    elif (refused := await asyncio.shield(self._called_back(lease))) is not None:
                        raise refused
            except TimeoutError:
                if lease.state in _AWAY:
                    raise WaitTimeout(
                        f"{self._settings.name} is evicted ({lease.state}), and there was no room "
                        "for it in time",
                        hint=f"`vramctl why {self._settings.name}` names the holder; it returns as "
                        "soon as it may",
                    ) from None
                if lease.state in _LEAVING:
                    raise Loading(
                        f"{self._settings.name} is still {lease.state}",
                        hint="ask again, or wait longer",
                    ) from None
        if lease.state == "held":
            return True
        await self._until_left(lease, deadline)
        return False

    def _called_back(self, lease: AsyncLease) -> asyncio.Task[VramError | None]:
        """Ask for the lease as a waiter, once for all requests, and without a limit.

        Their own limits are shorter than a goal may be.
        """
        if self._calling is None or self._calling.done():
            self._calling = asyncio.create_task(self._call_back(lease), name="call back")
        return self._calling

    async def _call_back(self, lease: AsyncLease) -> VramError | None:
        """Wait until the lease is granted again or over.

        Returns the reason why the arbiter refuses even the wait.
        """
        away = lease.state
        _log.info("requested: calling the lease back from %s", away)
        self._host.fetch()
        try:
            await lease.reacquire()
        except BadState:  # it returns by itself in this moment
            await lease.wait_change(away)
        except VramError as error:
            if lease.state in _AWAY:
                return error
        return None

    async def _restore(self, lease: AsyncLease) -> None:
        """Load after a grant, by itself or because it was called back.

        A load that fails ends the lease; the next request starts a new one.
        """
        if self._ending:
            return  # `leave` releases it
        _log.info("back from %s: loading", "parking" if self.state == "parked" else "standby")
        self._to("loading")
        try:
            await self._load(lease)
        except BaseException as error:
            if self.state != "unloaded":
                self._to("unloaded")
            if not isinstance(error, VramError):
                raise
            self.last_error = error
        else:
            self.last_error = None

    async def _obtain(self, deadline: float | None) -> AsyncLease | None:
        """Wait for a lease; `unload` cancels it and leaves the queue.

        The first imports and the first read of the weights take half a minute and more on a busy
        machine; the lease is waited for from then on, for the time that was left before, and the
        arbiter is told how much host RAM they take. Later they are read meanwhile.
        """
        wait_s = _left_s(deadline)
        reading = self._host.fetch()
        weights_bytes = self._host.size_bytes
        if weights_bytes is None:
            weights_bytes = await self._host.fetched(reading)
        if self._client is None:
            return None
        if wait_s == 0.0:
            raise WaitTimeout(
                f"{self._settings.name}: no time left to wait for the lease", hint="wait longer"
            )
        return await self._client.acquire(
            self._settings.lease_spec(park_bytes=weights_bytes),
            wait_s,
            unload=self._unload,
            park=self._park,
            restore=self._restore,
            on_lost=self._on_lost,
        )

    def _unwanted(self) -> NotResident:
        return NotResident(
            f"{self._settings.name} was told to unload before it was resident",
            hint="ask again if it is wanted",
        )

    async def _load(self, lease: AsyncLease | None) -> None:
        """Load the model onto the GPU; on failure everything is undone before the lease is
        released."""
        attributes = self._labels() | (
            {telemetry.ATTR_LEASE: lease.lease_id} if lease is not None else {}
        )
        with tracing.span(telemetry.SPAN_SIDECAR_LOAD, attributes=attributes):
            await self._load_measured(lease)

    async def _load_measured(self, lease: AsyncLease | None) -> None:
        began, unloads = time.monotonic(), self._unloads
        labels = {telemetry.ATTR_MODEL: self._settings.manifest.name}

        def given_up() -> bool:
            return unloads != self._unloads if lease is None else lease.given_up

        try:
            reading = self._host.fetch()
            self._called_off.clear()
            called_off = asyncio.create_task(self._called_off.wait(), name="called off")
            await asyncio.wait({reading, called_off}, return_when=asyncio.FIRST_COMPLETED)
            called_off.cancel()
            if given_up() or (lease and lease.state == "gone"):
                raise self._unwanted()  # the weights may be read on, and are dropped then
            await self._host.fetched(reading)
            model = self._model = await self._models.start()
            if given_up() or (lease and lease.state == "gone"):
                raise self._unwanted()  # before a byte was loaded
            measured = await model.load("" if lease is None else lease.gpu)
            if lease is not None:
                charge = None if measured is None else self._settings.steady_charge(measured)
                await lease.ready(charge)
            if model is not self._model or given_up() or (lease and lease.state == "gone"):
                raise self._unwanted()  # it was unloaded while `ready` was sent
        except BaseException as error:
            await self._take_back(lease, error)
            if given_up():
                _log.info("the load was undone")
                raise self._unwanted() from None
            _log.error("loading failed: %s", error)
            if isinstance(error, Exception):
                labels[telemetry.ATTR_ERROR_TYPE] = tracing.error_type(error)
                meters.measure(telemetry.METRIC_SIDECAR_LOAD, time.monotonic() - began, labels)
            raise
        meters.measure(telemetry.METRIC_SIDECAR_LOAD, time.monotonic() - began, labels)
        if measured is not None:
            tracing.note({telemetry.ATTR_BYTES: measured})
        self._last_use_s = self._resident_since_s = time.monotonic()
        self._to("resident")
        self._watching = asyncio.create_task(self._watch(model, lease), name="watch the model")
        self._host.drop_if_too_large(lambda: self.state == "resident")
        _log.info("resident after %.2f s: %s bytes on the GPU", time.monotonic() - began, measured)

    async def _take_back(self, lease: AsyncLease | None, error: BaseException) -> None:
        """Undo a failed load. Whatever else fails in it, the lease ends: it would be renewed for
        ever."""
        try:
            await self._end_model(at_once=True)
            self._host.drop()
            if lease is not None and isinstance(error, OutOfMemory) and not lease.given_up:
                requested = int(
                    error.details.get("requested_bytes") or self._settings.footprint.load_peak_bytes
                )
                await lease.oom(requested, error.details.get("allocated_bytes"))
        except VramError as failed:  # the arbiter measures what is left on the GPU
            _log.error("a failed load was not undone in order: %s", failed)
        finally:
            if lease is not None:
                try:
                    await lease.release()
                except VramError as refused:
                    _log.warning("the release of %s was refused: %s", lease.lease_id, refused)

    # -- unloading
    async def _unload(self) -> None:
        """Unload: called by the lease (revoked, lost, given up) or at the end of the program."""
        if self.state in ("unloading", "parking"):
            await self._left.wait()
        if self.state not in ("loading", "resident", "parked"):
            return
        began, loading = time.monotonic(), self.state == "loading"
        self._called_off.set()
        self._to("unloading")
        self._left.clear()
        try:
            with tracing.span(telemetry.SPAN_SIDECAR_UNLOAD, attributes=self._labels()):
                await self._end_model(at_once=loading)
        finally:
            self._to("unloaded")
            self._left.set()
        _log.info("unloaded in %.2f s", time.monotonic() - began)
        self._host.drop()

    async def _park(self) -> None:
        """Leave the GPU and keep the weights in host RAM: called by the lease."""
        if self.state != "resident":
            return
        began = time.monotonic()
        self._to("parking")
        self._left.clear()
        try:
            with tracing.span(telemetry.SPAN_SIDECAR_UNLOAD, attributes=self._labels()):
                await self._end_model(at_once=False)
        finally:
            self._to("parked")
            self._left.set()
        _log.info("parked in %.2f s", time.monotonic() - began)

    async def _leave_the_gpu(self) -> None:
        """Park where the arbiter has host RAM for the weights, else unload."""
        if self.lease is not None and self.lease.spec.park_bytes:
            await self.lease.park()
        else:
            await self.unload()

    async def _end_model(self, *, at_once: bool) -> None:
        """End the model's process. `at_once`: also in the middle of a load."""
        model, self._model = self._model, None
        if model is not None:
            await model.end(at_once=at_once)

    async def _watch(self, model: Model, lease: AsyncLease | None) -> None:
        """Release the lease of a model whose process died: its bytes are free."""
        await model.ended.wait()
        if model is not self._model:
            return  # it was ended by this program
        self._model = None
        self._to("unloaded")
        self.last_error = ModelError(
            f"the process of {self._settings.name} ended while it was resident",
            hint="the next request loads it again; see the sidecar's log",
        )
        _log.error("%s", self.last_error)
        self._host.drop()
        if lease is not None:
            try:
                await lease.release()
            except VramError as refused:
                _log.warning("the release of %s was refused: %s", lease.lease_id, refused)

    async def _on_lost(self, lease: AsyncLease, error: VramError) -> None:
        self.last_error = error
        _log.warning("lease %s is lost: %s", lease.lease_id, error)

    def _labels(self) -> dict[str, str]:
        return {
            telemetry.ATTR_CONSUMER: self._settings.name,
            telemetry.ATTR_MODEL: self._settings.manifest.name,
        }

    # -- uses
    def _check(self, token: Token) -> None:
        if self.token() != tuple(token):
            raise self._evicted()

    def _evicted(self) -> Evicted:
        return Evicted(
            f"{self._settings.name} is not resident under this token (it is {self.state})",
            hint="load again and use the new token, or omit the token",
            details={"state": self.state},
        )

    @contextlib.asynccontextmanager
    async def _use(
        self, lease: AsyncLease | None, label: str, *, handed: bool
    ) -> AsyncIterator[None]:
        """Mark a use. Under a handed-over token the caller's own use protects the model, also while
        revoked."""
        self._running += 1
        try:
            async with contextlib.AsyncExitStack() as stack:
                if lease is not None:
                    try:
                        await stack.enter_async_context(lease.use(label))
                    except LeaseRevoking:
                        if not handed:
                            raise
                yield
        finally:
            self._running -= 1
            self._last_use_s = time.monotonic()

    def _begins(self, model: Model, came_s: float, fresh_s: float | None) -> None:
        """Check that no unload came between, and that the picture is not too old."""
        if model is not self._model or self.state != "resident":
            raise self._evicted()
        waited_s = time.monotonic() - came_s
        if fresh_s is not None and waited_s > fresh_s:
            raise FrameStale(
                f"the picture waited {waited_s:.1f} s for {self._settings.name}, {fresh_s:.1f} s "
                "are accepted",
                hint="ask again about a new one: the model is there now",
                details={"waited_s": waited_s},
            )


def _being_cancelled() -> bool:
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def _left_s(deadline: float | None) -> float | None:
    """Return the seconds until a moment of the monotonic clock; None: no limit."""
    return None if deadline is None else max(0.0, deadline - time.monotonic())
