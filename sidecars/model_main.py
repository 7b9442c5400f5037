"""A sidecar's processes beside its host: the keeper of the weights, and the model it forks.

The keeper reads the weights into host RAM and touches no device. For each residency it forks a
model process, which copies them onto the GPU (`load`), answers requests of the sidecar's wire
(`run`), and ends without ceremony: the kernel and the driver take everything back. Both answer one
request after the other from their host until it closes the socket. Every failure is answered as a
typed error.
"""

import contextlib
import gc
import io
import logging
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Final, NoReturn

import msgpack

from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.errors import ModelError, OutOfMemory, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.sidecars.adapters.base import ModelAdapter, ModelCall
from vram_arbiter.sidecars.device.memory import REMEASURE, DeviceMemory, fill
from vram_arbiter.sidecars.device.open import open_memory
from vram_arbiter.sidecars.host_weights import HostWeights
from vram_arbiter.sidecars.quantization import check_precision
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights import Weights
from vram_arbiter.sidecars.wires import parse

type AdapterFor = Callable[[RSkillManifest, Weights], ModelAdapter]
"""Makes a model's adapter; a function of a module, so that a process can be told its name."""

LENGTH: Final = struct.Struct(">I")
ONNX_FULL: Final = "Failed to allocate memory for requested buffer"
THREADS_VARIABLE: Final = "OMP_NUM_THREADS"


def keep(
    settings: Settings,
    adapter_for: AdapterFor,
    set_up_log: Callable[[], None],
    threads: int,
    host_pid: int,
    host: socket.socket,
    births: socket.socket,
) -> None:
    """Serve the host as the keeper of its weights, until it closes the socket or ends.

    `births` brings the socket of each model process before its `fork` is asked for. `threads`: of a
    model process; the keeper itself has one only, because a fork copies no other, and locks that
    others hold would stay locked.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the host ends this process
    set_up_log()
    keeper = _Keeper(settings, adapter_for(settings.manifest, settings.weights))
    with host, host.makefile("rwb") as stream:
        while message := _receive(stream):
            if message["do"] == "fork":
                ours = socket.socket(fileno=socket.recv_fds(births, 1, 1)[1][0])
                keeper_pid = os.getpid()
                pid = os.fork()
                if pid == 0:
                    stream.close()
                    host.close()
                    births.close()
                    model = _Model(settings, keeper.adapter, keeper.weights)
                    _live(model, threads, (host_pid, keeper_pid), ours)
                ours.close()
                _send(stream, {"pid": pid})
            else:
                with _ending_with(host_pid):
                    reply = _answer(keeper, message)
                _send(stream, reply)
        os._exit(0)  # a million objects of imported code need no tidying


class _Keeper:
    def __init__(self, settings: Settings, adapter: ModelAdapter) -> None:
        self.adapter = adapter
        self.weights: HostWeights | None = None
        self._settings = settings

    def perform(self, message: Message) -> Message:
        match message["do"]:
            case "prepare":
                self.adapter.prepare()
            case "load":
                return {"bytes": self._load()}
            case "drop":
                if self.weights is not None:
                    self.weights.drop()
                    self.weights = None
                gc.collect()
            case "reap":
                _, status = os.waitpid(message["pid"], 0)
                return {"code": os.waitstatus_to_exitcode(status)}
        return {}

    def _load(self) -> int:
        """Read the weights into shared memory. Return their bytes: those of the production model
        where they stand for one, and at the pace of its disk."""
        settings = self._settings
        if (torch := sys.modules.get("torch")) is not None:
            torch.set_num_threads(1)
        self.adapter.load("cpu")
        self.weights = HostWeights(self.adapter.networks, settings.name)
        count = self.weights.size_bytes
        gc.collect()
        gc.freeze()  # collections need not walk the imported code, nor copy its pages after a fork
        if not count or not _stands_in(settings):
            return count
        if settings.throttle_bytes_per_s:
            time.sleep(settings.footprint.steady_bytes / settings.throttle_bytes_per_s)
        return max(count, settings.footprint.steady_bytes)


def _live(model: "_Model", threads: int, others: tuple[int, ...], host: socket.socket) -> NoReturn:
    """Serve the host as a model process; ends with the host or the keeper (`others`: their pids),
    through which the arbiter knows that its bytes are the sidecar's."""
    code = 1
    try:
        threading.Thread(target=_end_with, args=others, name="others", daemon=True).start()
        os.environ[THREADS_VARIABLE] = str(threads)
        if (torch := sys.modules.get("torch")) is not None:
            torch.set_num_threads(threads)
        with host, host.makefile("rwb") as stream:
            while message := _receive(stream):
                _send(stream, _answer(model, message))
        model.close()
        logging.shutdown()
        code = 0
    except OSError as error:
        logging.getLogger("sidecars").error("the model's process lost its host: %s", error)
    except BaseException:
        logging.getLogger("sidecars").exception("the model's process failed")
    finally:
        os._exit(code)


class _Model:
    def __init__(
        self, settings: Settings, adapter: ModelAdapter, weights: HostWeights | None
    ) -> None:
        self._settings = settings
        self._adapter = adapter
        self._weights = weights
        self._memory: DeviceMemory | None = None

    def perform(self, message: Message) -> Message:
        match message["do"]:
            case "check":
                self._opened()
            case "load":
                return {"used_bytes": self._load(message["gpu"])}
            case "run":
                call = parse(message["call"], self._adapter.ops)
                assert isinstance(call, ModelCall), "the host answers all others"
                return {"answer": npy.pack(self._adapter.run(call))}
        return {}

    def close(self) -> None:
        if self._memory is not None:
            self._memory.close()

    def _opened(self) -> DeviceMemory:
        wanted = self._settings
        return open_memory(wanted.device, wanted.name, wanted.footprint.residue_bytes)

    def _load(self, gpu: str) -> int | None:
        """Copy the weights onto the device, then ballast up to the footprint where they stand for a
        larger model. Return the bytes on the GPU."""
        settings, footprint = self._settings, self._settings.footprint
        memory = self._memory = self._opened()
        if gpu:
            memory.bind(gpu)
        memory.touch()
        if self._adapter.networks:  # a passthrough computes in whatever it likes
            check_precision(settings.manifest, memory.torch_device)
        if self._weights is not None and memory.torch_device == "cpu":
            self._weights.own()  # simulated, or none: a copy all the same
        self._adapter.place(memory.torch_device)
        used = memory.used_bytes()
        if used is None or not _stands_in(settings):
            return used  # a real model has its own bytes
        fill(
            memory,
            "weights",
            footprint.steady_bytes - used,
            bytes_per_s=memory.throttle_bytes_per_s(),
        )
        if footprint.load_peak_bytes > footprint.steady_bytes:
            memory.free(
                memory.allocate("load peak", footprint.load_peak_bytes - footprint.steady_bytes)
            )
            memory.empty_cache()
        return memory.used_bytes()


def _answer(process: "_Keeper | _Model", message: Message) -> Message:
    """Any failure inside a model is an answer to the caller."""
    try:
        return process.perform(message)
    except Exception as error:  # noqa: BLE001
        return {"error": _typed(error).to_wire()}


def _stands_in(settings: Settings) -> bool:
    return bool(settings.stands_for) or settings.device.startswith("fake:")


def _receive(stream: io.BufferedRWPair) -> Message | None:
    """Return the next request; None where the host has closed the socket."""
    if not (header := stream.read(LENGTH.size)):
        return None
    (length,) = LENGTH.unpack(header)
    message: Message = msgpack.unpackb(stream.read(length))
    return message


def _send(stream: io.BufferedRWPair, message: Message) -> None:
    packed = msgpack.packb(message)
    stream.write(LENGTH.pack(len(packed)) + packed)
    stream.flush()


def _typed(error: BaseException) -> VramError:
    if isinstance(error, VramError):
        return error
    # torch's class; importing torch to compare it would cost seconds. onnxruntime has no class
    if type(error).__name__ == "OutOfMemoryError" or ONNX_FULL in str(error):
        return OutOfMemory(str(error), hint=REMEASURE)
    if isinstance(error, ImportError):
        return ModelError(str(error), hint="pip install 'vram-arbiter[sidecars]'")
    logging.getLogger("sidecars").exception("the model failed", exc_info=error)
    return ModelError(f"{type(error).__name__}: {error}", hint="see the sidecar's log")


def _end_with(*pids: int) -> NoReturn:
    """End this process when another one ends, also in the middle of its work: no program would use
    its memory, and no lease covers it any more."""
    select.select([_watched(pid) for pid in pids], [], [])
    os._exit(1)


def _watched(pid: int) -> int:
    """Return a descriptor that is readable once a process has ended; end with it if it has."""
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        os._exit(1)


@contextlib.contextmanager
def _ending_with(host_pid: int) -> Iterator[None]:
    """End this process when its host ends, inside the block only: no thread is left after it."""
    done, finish = os.pipe()

    def watch() -> None:
        host = _watched(host_pid)
        if host in select.select([host, done], [], [])[0]:
            os._exit(1)
        os.close(host)

    watching = threading.Thread(target=watch, name="host", daemon=True)
    watching.start()
    try:
        yield
    finally:
        os.close(finish)
        watching.join()
        os.close(done)
