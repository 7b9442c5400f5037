"""The model on the GPU: its state, the process that owns its bytes, loading, unloading, parking.

States: unloaded → waiting (for the lease) → loading → resident → unloading → unloaded, or parking →
parked: off the GPU, with the weights in host RAM. One process for each residency
(`model_process`), whose end returns all of its memory on the GPU. Must not know sockets, wires or
how a lease is obtained.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Mapping
from typing import Final, Literal

from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.errors import ModelError, NotResident, OutOfMemory, VramError
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.sidecars.host_copy import HostCopy
from vram_arbiter.sidecars.model_process import ModelProcess
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights_keeper import ModelProcesses

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
_log = logging.getLogger("sidecars")


class GpuCopy:
    """One model on or off one GPU. `died`: told when its process ended while it was resident."""

    def __init__(
        self,
        settings: Settings,
        models: ModelProcesses,
        host: HostCopy,
        died: Callable[[VramError], None],
    ) -> None:
        self._settings = settings
        self._models = models
        self._host = host
        self._died = died
        self._left = asyncio.Event()  # the unload or parking in progress is over
        self._called_off = asyncio.Event()  # the load in progress is not wanted any more
        self._watching: asyncio.Task[None] | None = None  # the process's end
        self.model: ModelProcess | None = None
        self.state: State = "unloaded"
        self.resident_since_s = time.monotonic()  # the last time that it became resident

    def to(self, state: State) -> None:
        """Go to another state; the only place that writes it."""
        assert state in TRANSITIONS[self.state], f"{self.state} → {state}"
        self.state = state

    def not_loaded(self) -> None:
        """Leave the states before `resident`; an unload in progress leaves them itself."""
        if self.state in ("waiting", "loading"):
            self.to("unloaded")

    # -- loading
    async def load(self, lease: AsyncLease | None, given_up: Callable[[], bool]) -> None:
        """Load the model; `given_up` says whether it is not wanted any more.

        On failure everything is undone before the lease is released. Raises NotResident where it
        was given up, else what ended the load.
        """
        attributes = self._labels()
        if lease is not None:
            attributes[telemetry.ATTR_LEASE] = lease.lease_id
        began = time.monotonic()
        labels = {telemetry.ATTR_MODEL: self._settings.manifest.name}
        with tracing.span(telemetry.SPAN_SIDECAR_LOAD, attributes=attributes):
            try:
                model, used_bytes = await self._to_the_gpu(lease, given_up)
            except BaseException as error:
                await self._undo_load(lease, error)
                if given_up():
                    _log.info("the load was undone")
                    raise unwanted(self._settings.name) from None
                _log.error("loading failed: %s", error)
                if isinstance(error, Exception):
                    labels[telemetry.ATTR_ERROR_TYPE] = tracing.error_type(error)
                    meters.measure(telemetry.METRIC_SIDECAR_LOAD, time.monotonic() - began, labels)
                raise
            if used_bytes is not None:
                tracing.note({telemetry.ATTR_BYTES: used_bytes})
        meters.measure(telemetry.METRIC_SIDECAR_LOAD, time.monotonic() - began, labels)
        self.resident_since_s = time.monotonic()
        self.to("resident")
        self._watching = asyncio.create_task(self._watch(model, lease), name="watch the model")
        self._host.drop_if_too_large(lambda: self.state == "resident")
        _log.info(
            "resident after %.2f s: %s bytes on the GPU", time.monotonic() - began, used_bytes
        )

    async def _to_the_gpu(
        self, lease: AsyncLease | None, given_up: Callable[[], bool]
    ) -> tuple[ModelProcess, int | None]:
        """Read the weights, start a process and copy them. Return it and its bytes on the GPU."""

        def need_wanted() -> None:
            if given_up() or (lease is not None and lease.state == "gone"):
                raise unwanted(self._settings.name)

        reading = self._host.fetch()
        self._called_off.clear()
        called_off = asyncio.create_task(self._called_off.wait(), name="called off")
        await asyncio.wait({reading, called_off}, return_when=asyncio.FIRST_COMPLETED)
        called_off.cancel()
        need_wanted()  # the weights may be read on, and are dropped then
        await self._host.fetched(reading)
        model = self.model = await self._models.start()
        need_wanted()  # before a byte was loaded
        used_bytes = await model.load("" if lease is None else lease.gpu)
        if lease is not None:
            charge = None if used_bytes is None else self._settings.steady_charge(used_bytes)
            await lease.ready(charge)
        if model is not self.model:  # it was unloaded while `ready` was sent
            raise unwanted(self._settings.name)
        need_wanted()
        return model, used_bytes

    async def _undo_load(self, lease: AsyncLease | None, error: BaseException) -> None:
        """Undo a failed load. Whatever else fails in it, the lease ends: it would be renewed for
        ever."""
        try:
            await self.end_model(at_once=True)
            self._host.drop()
            if lease is not None and isinstance(error, OutOfMemory) and not lease.given_up:
                requested = int(
                    error.details.get("requested_bytes") or self._settings.footprint.load_peak_bytes
                )
                await lease.oom(requested, error.details.get("allocated_bytes"))
        except VramError as failed:  # the arbiter measures what is left on the GPU
            _log.error("a failed load was not undone in order: %s", failed)
        finally:
            await _released(lease)

    async def _watch(self, model: ModelProcess, lease: AsyncLease | None) -> None:
        """Release the lease of a model whose process died: its bytes are free."""
        await model.ended.wait()
        if model is not self.model:
            return  # it was ended by this program
        self.model = None
        self.to("unloaded")
        error = ModelError(
            f"the process of {self._settings.name} ended while it was resident",
            hint="the next request loads it again; see the sidecar's log",
        )
        _log.error("%s", error)
        self._died(error)
        await _released(lease)

    # -- leaving the GPU
    async def unload(self) -> None:
        """Unload: called by the lease (revoked, lost, given up) or at the end of the program."""
        if self.state in ("unloading", "parking"):
            await self._left.wait()
        if self.state not in ("loading", "resident", "parked"):
            return
        began, loading = time.monotonic(), self.state == "loading"
        self._called_off.set()
        self.to("unloading")
        await self._end_to("unloaded", at_once=loading)
        _log.info("unloaded in %.2f s", time.monotonic() - began)
        self._host.drop()

    async def park(self) -> None:
        """Leave the GPU and keep the weights in host RAM: called by the lease."""
        if self.state != "resident":
            return
        began = time.monotonic()
        self.to("parking")
        await self._end_to("parked", at_once=False)
        _log.info("parked in %.2f s", time.monotonic() - began)

    async def _end_to(self, state: State, *, at_once: bool) -> None:
        self._left.clear()
        try:
            with tracing.span(telemetry.SPAN_SIDECAR_UNLOAD, attributes=self._labels()):
                await self.end_model(at_once=at_once)
        finally:
            self.to(state)
            self._left.set()

    async def end_model(self, *, at_once: bool) -> None:
        """End the model's process. `at_once`: also in the middle of a load."""
        model, self.model = self.model, None
        if model is not None:
            await model.end(at_once=at_once)

    def _labels(self) -> dict[str, str]:
        return {
            telemetry.ATTR_CONSUMER: self._settings.name,
            telemetry.ATTR_MODEL: self._settings.manifest.name,
        }


def unwanted(name: str) -> NotResident:
    """Return the refusal of a load that an unload overtook."""
    return NotResident(
        f"{name} was told to unload before it was resident", hint="ask again if it is wanted"
    )


async def _released(lease: AsyncLease | None) -> None:
    if lease is not None:
        try:
            await lease.release()
        except VramError as refused:
            _log.warning("the release of %s was refused: %s", lease.lease_id, refused)
