"""Host of one sidecar: a socket, a model, a lease. Starts the parts and stops them in order.

`prepare` runs from the start; `load` waits for the first request (or runs at once without an
arbiter). The model lives in another process, so `ping` and `revoke` are answered whatever it does.
"""

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable
from dataclasses import replace

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.server import RouterServer, path_of
from vram_arbiter.schemas.errors import NoGpu, VramError
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.device.capacity import leased_gpu
from vram_arbiter.sidecars.doors.open import opened
from vram_arbiter.sidecars.model_main import AdapterFor
from vram_arbiter.sidecars.port import on_port
from vram_arbiter.sidecars.residency import Residency
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights_keeper import ModelProcesses
from vram_arbiter.sidecars.wires import Wire, unread_reply

_log = logging.getLogger("sidecars")

# share of the time for the socket: a flood leaves the model's thread the interpreter
WORK_SHARE = 0.5


class SidecarHost:
    """Server of one model until `stop`, SIGTERM or SIGINT.

    Then it finishes the op in progress, unloads, releases and returns.
    """

    def __init__(
        self,
        settings: Settings,
        adapter_for: AdapterFor,
        set_up_log: Callable[[], None],
    ) -> None:
        """`set_up_log`: sets up the log of the model's processes; they can be told its name."""
        self._settings = settings
        self._adapter = adapter_for(settings.manifest, settings.weights)
        self._processes = ModelProcesses(settings, adapter_for, set_up_log)
        self._stopping = asyncio.Event()
        self._residency: Residency | None = None
        self._refused: NoGpu | None = None
        self._boot_id = procfs.boot_id()

    async def serve(self) -> None:
        """Serve until the end.

        Raises NoGpu, AlreadyRunning, ConfigError, ArbiterUnreachable at the start; later trouble is
        answered on the wire.
        """
        settings = self._settings
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.stop)
        async with contextlib.AsyncExitStack() as stack:
            client = None
            if settings.arbiter is not None:
                _log.info("waiting for the arbiter at %s", settings.arbiter)
                client = await stack.enter_async_context(
                    AsyncClient(settings.name, endpoint=settings.arbiter)
                )
                settings = replace(settings, gpu=settings.gpu or leased_gpu(settings.device))
            server = await stack.enter_async_context(
                RouterServer(
                    settings.endpoint,
                    unread_reply(self._adapter.ops),
                    work_share=WORK_SHARE,
                    closed_to=None,  # a robot's tunnel leads here
                )
            )
            if settings.port is not None:
                await stack.enter_async_context(on_port(settings.port, path_of(settings.endpoint)))
            if settings.door is not None:
                answer_s = settings.wait_timeout_s + settings.request_timeout_s
                await stack.enter_async_context(
                    opened(settings.door, settings.manifest, settings.endpoint, answer_s)
                )
            self._processes.preload(self._adapter.modules)
            residency = self._residency = Residency(settings, self._processes, client)
            if client is not None:
                client.on_prepare(residency.announce)
            residency.prepare()
            work = [server.serve(Wire(self, server.send).handle), self._stop_without_gpu(residency)]
            if client is None:
                work.append(self._load_at_start(residency))
            elif settings.idle_release_s is not None:
                work.append(residency.release_when_idle(settings.idle_release_s))
            background = [asyncio.create_task(one) for one in work]
            _log.info(
                "%s serves %s on %s", settings.name, settings.manifest.name, settings.endpoint
            )
            stopped = asyncio.create_task(self._stopping.wait(), name="stopped")
            try:
                await asyncio.wait([stopped, background[0]], return_when=asyncio.FIRST_COMPLETED)
            finally:
                stopped.cancel()
                await residency.leave(self._refused)
                for task in background:
                    task.cancel()
                outcomes = await asyncio.gather(*background, return_exceptions=True)
            if self._refused is not None:
                raise self._refused
            if isinstance(outcomes[0], Exception):
                raise outcomes[0]
        _log.info("%s has ended", settings.name)

    async def _stop_without_gpu(self, residency: Residency) -> None:
        """End a sidecar whose device is not there; any other trouble is answered on the wire."""
        try:
            await residency.prepared()
        except NoGpu as error:
            self._refused = error
            self.stop()
        except VramError as error:
            _log.error("preparing failed: %s", error)

    @staticmethod
    async def _load_at_start(residency: Residency) -> None:
        # logged, kept as last_error, and retried by the next request
        with contextlib.suppress(VramError):
            await residency.load()

    # -- what the wire asks (`wires.Host`)
    @property
    def model_ops(self) -> frozenset[str]:
        return self._adapter.ops

    def stop(self) -> None:
        self._stopping.set()

    def identity(self) -> Message:
        residency, settings = self._here, self._settings
        token = residency.token()
        found = {
            "ok": True,
            "model": settings.weights.source
            if not settings.weights.local
            else str(settings.manifest.weights_uri),
            "revision": settings.revision,
            "kind": self._adapter.kind,
            "rskill": settings.manifest.name,
            "pid": os.getpid(),
            "boot_id": self._boot_id,
            "consumer": settings.name,
            "state": residency.state,
            "lease_id": residency.lease.lease_id
            if token is not None and residency.lease is not None
            else None,
            "token": list(token) if token is not None else None,
        }
        if residency.on_standby:
            found["standby"] = True
        if residency.wanted:
            found["wanted"] = True
        if residency.last_error is not None:
            found["last_error"] = f"{residency.last_error.code}: {residency.last_error.message}"
        return found

    async def load(self, timeout_s: float | None) -> Message:
        residency = self._here
        loaded = await residency.load(timeout_s)
        lease = residency.lease
        return {
            "ok": True,
            "lease_id": lease.lease_id if lease else None,
            "token": list(lease.token) if lease else None,
            "loaded": loaded,
        }

    async def unload(self) -> None:
        await self._here.unload()

    async def run(self, name: str, call: ModelCall, message: Message) -> Message:
        residency = self._here
        if name == "reset" and call.token is None and residency.state != "resident":
            return {
                "ok": True
            }  # a model that is not resident has nothing to forget, and no reason to load
        answer: Message = (await residency.run(name, call.token, message, fresh_s=call.fresh_s))[
            "answer"
        ]
        return answer

    @property
    def _here(self) -> Residency:
        assert self._residency is not None, "the wire is served inside serve()"
        return self._residency
