"""Residency of one model: what the wire asks of it, in step with its lease.

A request makes the model resident: the lease is acquired, or called back from standby (`standby`),
and the model is loaded (`gpu_copy`) from its weights in host RAM (`host_copy`). One model, one
lease at a time. The lease's own protocol (revoke, quiesce, release, fencing) is the client
library's, which calls `GpuCopy.unload` or `park` when the bytes must go, and `_restore` when a
parked lease or one on standby is granted again. Must not know sockets, wires or processes.

The arbiter grants the host RAM of parked weights (`park_bytes`).
"""

import asyncio
import logging
import time

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.errors import (
    Evicted,
    FrameStale,
    LeaseExpired,
    LeaseLost,
    LeaseRevoking,
    SidecarUnavailable,
    StaleToken,
    UnknownLease,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.sidecars.gpu_copy import GpuCopy, State, unwanted
from vram_arbiter.sidecars.host_copy import HostCopy
from vram_arbiter.sidecars.model_process import ModelProcess
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.standby import AWAY, Recall, left_s, still
from vram_arbiter.sidecars.uses import Uses
from vram_arbiter.sidecars.weights_keeper import ModelProcesses

Token = tuple[int, int]
_GONE = (LeaseRevoking, LeaseLost, LeaseExpired, StaleToken, UnknownLease, Evicted)
_log = logging.getLogger("sidecars")


class Residency:
    """One model on or off one GPU.

    `client` None: no arbiter, so the model is loaded without a lease and stays.
    """

    def __init__(
        self, settings: Settings, models: ModelProcesses, client: AsyncClient | None
    ) -> None:
        self._settings = settings
        self._models = models
        self._client = client
        self._turn = asyncio.Lock()  # one attempt to become resident at a time
        self._prepared: asyncio.Task[None] | None = None
        self._host = HostCopy(models, client, settings.footprint.steady_bytes)
        self._gpu = GpuCopy(settings, models, self._host, self._died)
        self._recall = Recall(settings.name, self._host, self._gpu)
        self._uses = Uses(client)
        self._ending: VramError | None = None  # what later requests are told
        self._obtaining: asyncio.Task[AsyncLease | None] | None = None
        self._unloads = 0  # number of unload requests: earlier waits for the model end
        self.lease: AsyncLease | None = None
        self.last_error: VramError | None = None

    @property
    def state(self) -> State:
        return self._gpu.state

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
        self._read_ahead()

    def _read_ahead(self) -> None:
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
            raise still(self._settings.name, self.state) from None
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
                await self._gpu.end_model(at_once=True)  # the load undoes itself
            async with self._turn:
                if self.state == "resident":
                    await self._gpu.unload()

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
            lease, model = self.lease, self._gpu.model
            try:
                async with self._uses.use(lease, label, handed=token is not None):
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
                    await self._recall.until_left(lease, deadline)  # then it is asked for again

    def token(self) -> Token | None:
        """Token of the lease under which the model is resident now."""
        return self.lease.token if self.lease is not None and self.state == "resident" else None

    @property
    def on_standby(self) -> bool:
        """Whether the model is evicted and returns by itself."""
        return self.lease is not None and self.lease.state in AWAY and self._settings.standby

    @property
    def wanted(self) -> bool:
        """Whether a request waits for the model, or its lease is being called back; `unload` ends
        both."""
        return self._turn.locked() or self._recall.under_way

    async def leave(self, cause: VramError | None = None) -> None:
        """End of the program: after the op in progress, free everything.

        Requests that wait, or come yet, get the `cause`.
        """
        self._ending = cause or SidecarUnavailable(
            f"{self._settings.name} is ending", hint="start it again"
        )
        lease = self.lease
        if self._prepared is not None and not self._prepared.done():
            self._prepared.cancel()
            await asyncio.wait({self._prepared})
        await self._host.stop()
        self._unloads += 1  # a load in progress is not wanted anymore
        try:
            await self._gpu.unload()
        finally:
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
            since_s = self._gpu.resident_since_s
            stays_until = max(
                max(self._uses.last_s, since_s) + idle_s,
                since_s + self._settings.min_residency_s,
            )
            left = stays_until - time.monotonic()
            if self.state == "resident" and not self._uses.in_flight and left <= 0:
                if await self._uses.by_others(self.lease):
                    _log.debug("in use by another process: not idle")
                    self._uses.last_s = time.monotonic()
                else:
                    _log.info("idle for %.1f s: leaving the GPU", idle_s)
                    await self._leave_the_gpu()
            await asyncio.sleep(max(left, 0.05, idle_s / 10))

    # -- loading
    async def _load_in_turn(self, deadline: float | None) -> bool:
        if self.state == "resident" and (self.lease is None or self.lease.state == "held"):
            return False
        unloads = self._unloads
        if self.lease is not None and await self._recall.until_held(self.lease, deadline):
            return True
        self._refuse_if_ending()
        if unloads != self._unloads:
            raise self._unwanted()
        self._gpu.to("waiting")
        self._obtaining = asyncio.create_task(self._obtain(deadline), name="obtain")
        try:
            lease = await self._obtaining
            self._gpu.to("loading")
            self.lease = lease
            if unloads != self._unloads:  # an unload came in the moment of the grant
                if lease is not None:
                    await lease.release()
                raise self._unwanted()
            await self._load(lease)
        except BaseException as error:
            self._gpu.not_loaded()
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
        if self._ending is not None:
            raise self._ending

    def _unwanted(self) -> VramError:
        return self._ending or unwanted(self._settings.name)

    async def _restore(self, lease: AsyncLease) -> None:
        """Load after a grant, by itself or because it was called back.

        A load that fails ends the lease; the next request starts a new one.
        """
        if self._ending:
            return  # `leave` releases it
        _log.info("back from %s: loading", "parking" if self.state == "parked" else "standby")
        self._gpu.to("loading")
        try:
            await self._load(lease)
        except BaseException as error:
            self._gpu.not_loaded()
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
        wait_s = left_s(deadline)
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
            unload=self._gpu.unload,
            park=self._gpu.park,
            restore=self._restore,
            on_lost=self._on_lost,
        )

    async def _load(self, lease: AsyncLease | None) -> None:
        unloads = self._unloads

        def given_up() -> bool:
            return unloads != self._unloads if lease is None else lease.given_up

        await self._gpu.load(lease, given_up)

    # -- leaving the GPU
    async def _leave_the_gpu(self) -> None:
        """Park where the arbiter has host RAM for the weights, else unload."""
        if self.lease is not None and self.lease.spec.park_bytes:
            await self.lease.park()
        else:
            await self.unload()

    async def _on_lost(self, lease: AsyncLease, error: VramError) -> None:
        self.last_error = error
        _log.warning("lease %s is lost: %s", lease.lease_id, error)

    def _died(self, error: VramError) -> None:
        """Keep the weights for the next request, which need not read them again.

        Where their keeper died as well, it is started again and reads them: that takes as long as
        at the start, so the lease is not asked for before.
        """
        self.last_error = error
        if self._ending is None:
            self._host.size_bytes = None
            self._read_ahead()

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

    def _begins(self, model: ModelProcess, came_s: float, fresh_s: float | None) -> None:
        """Check that no unload came between, and that the picture is not too old."""
        if model is not self._gpu.model or self.state != "resident":
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
