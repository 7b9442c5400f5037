"""A model's process: one request after the other from its host, until that closes the socket.

`prepare` does what needs no device, `load` puts the weights onto the GPU, `run` answers a request
of the sidecar's wire. Every failure is answered as a typed error. The process ends without
ceremony: the kernel and the driver take everything back.
"""

import gc
import logging
import os
import select
import signal
import socket
import struct
import threading
from collections.abc import Callable
from typing import Final, NoReturn

import msgpack

from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.errors import ModelError, OutOfMemory, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.sidecars.adapters.base import ModelAdapter, ModelCall
from vram_arbiter.sidecars.device.memory import DeviceMemory, fill
from vram_arbiter.sidecars.device.open import open_memory
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights import Weights
from vram_arbiter.sidecars.wires import parse

type AdapterFor = Callable[[RSkillManifest, Weights], ModelAdapter]
"""Makes a model's adapter; a function of a module, so that a process can be told its name."""

LENGTH: Final = struct.Struct(">I")


def main(settings: Settings, adapter_for: AdapterFor, host_pid: int, host: socket.socket) -> None:
    """Serve the host until it closes the socket or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the host ends this process
    threading.Thread(target=_end_with, args=(host_pid,), name="host", daemon=True).start()
    model = _Model(settings, adapter_for(settings.manifest, settings.weights))
    with host, host.makefile("rwb") as stream:
        while header := stream.read(LENGTH.size):
            (length,) = LENGTH.unpack(header)
            reply = msgpack.packb(model.answer(msgpack.unpackb(stream.read(length))))
            stream.write(LENGTH.pack(len(reply)) + reply)
            stream.flush()
        model.close()
        logging.shutdown()
        os._exit(0)  # a million objects of imported code need no tidying


class _Model:
    def __init__(self, settings: Settings, adapter: ModelAdapter) -> None:
        self._settings = settings
        self._adapter = adapter
        self._memory: DeviceMemory | None = None

    def answer(self, message: Message) -> Message:
        try:
            match message["do"]:
                case "prepare":
                    self._memory = open_memory(self._settings)
                    self._adapter.prepare()
                    gc.collect()
                    gc.freeze()  # later collections need not walk the imported code
                    return {}
                case "load":
                    return {"used_bytes": self._load(message["gpu"])}
                case "run":
                    call = parse(message["call"], self._adapter.ops)
                    assert isinstance(call, ModelCall), "the host answers all others"
                    answer: Message = npy.pack(self._adapter.run(call))
                    return {"answer": answer}
        # any failure inside a model is an answer to the caller
        except Exception as error:  # noqa: BLE001
            return {"error": _typed(error).to_wire()}
        raise AssertionError(f"the host asked for {message['do']}")

    def close(self) -> None:
        if self._memory is not None:
            self._memory.close()

    def _load(self, gpu: str) -> int | None:
        """Load the weights, then ballast up to the footprint where they stand for a larger model,
        at the pace of a real load. Return the bytes on the GPU."""
        settings, footprint = self._settings, self._settings.footprint
        memory = self._memory
        assert memory is not None, "a model is prepared before it is loaded"
        if gpu:
            memory.bind(gpu)
        memory.touch()
        self._adapter.load("cpu")
        self._adapter.place(memory.torch_device)
        used = memory.used_bytes()
        if used is None or not (settings.device.startswith("fake:") or settings.stands_for):
            return used  # a real model has its own bytes
        paces = (settings.throttle_bytes_per_s, memory.throttle_bytes_per_s())
        fill(
            memory,
            "weights",
            footprint.steady_bytes - used,
            bytes_per_s=min((pace for pace in paces if pace), default=None),
        )
        if footprint.load_peak_bytes > footprint.steady_bytes:
            memory.free(
                memory.allocate("load peak", footprint.load_peak_bytes - footprint.steady_bytes)
            )
            memory.empty_cache()
        return memory.used_bytes()


def _typed(error: BaseException) -> VramError:
    if isinstance(error, VramError):
        return error
    # torch's class; importing torch to compare it would cost seconds
    if type(error).__name__ == "OutOfMemoryError":
        return OutOfMemory(str(error))
    if isinstance(error, ImportError):
        return ModelError(str(error), hint="pip install 'vram-arbiter[sidecars]'")
    logging.getLogger("sidecars").exception("the model failed", exc_info=error)
    return ModelError(f"{type(error).__name__}: {error}", hint="see the sidecar's log")


def _end_with(host_pid: int) -> NoReturn:
    """End this process when its host ends, also in the middle of its work: no program would use
    the memory, and no lease covers it any more."""
    try:
        host = os.pidfd_open(host_pid)
    except ProcessLookupError:
        os._exit(1)
    select.select([host], [], [])
    os._exit(1)
