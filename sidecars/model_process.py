"""One process for each residency of a model. It owns the weights and the device's context, and its
end returns every byte of both.

A server (`multiprocessing`'s forkserver) imports the model's libraries once, without touching a
device; a model process is forked from it within milliseconds. The host speaks to it over a socket
pair, one msgpack map each way at a time (`model_main`). Whatever goes wrong in it is a typed error
here, never the end of the host. Must not know leases, wires or torch.
"""

import asyncio
import contextlib
import logging
import multiprocessing
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Final, Protocol

import msgpack

from vram_arbiter.schemas.errors import ModelError, WaitTimeout, from_wire
from vram_arbiter.schemas.plain import Message
from vram_arbiter.sidecars import model_main
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.model_main import LENGTH
from vram_arbiter.sidecars.settings import NICE_VARIABLE, Settings

END_S: Final = 5.0
"""How long a process may take to free its memory in order; then it is killed."""
ENVIRONMENT: Final = {
    "PYTORCH_NVML_BASED_CUDA_CHECK": "1",  # asking for GPUs initializes no CUDA before the fork
    # no threads before the fork: a lock that another thread holds stays locked in the child
    "TOKENIZERS_PARALLELISM": "false",
    "OPENBLAS_NUM_THREADS": "1",  # numpy's; torch has threads of its own, made at first use
    "JE_ARROW_MALLOC_CONF": "background_thread:false",  # pyarrow's allocator
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
}
_log = logging.getLogger("sidecars")


class Model(Protocol):
    """One residency of a model, as `residency` needs it."""

    ended: asyncio.Event
    """The process is gone, and its memory with it."""

    async def prepare(self) -> None:
        """Do what needs no device. Repeatable. Raises ModelError."""
        ...

    async def load(self, gpu: str) -> int | None:
        """Load onto a GPU (its UUID; "": the only one). Return the bytes on it, None if unknown.

        Raises OutOfMemory, NoGpu or ModelError; end the process then.
        """
        ...

    async def run(
        self, call: Message, *, begin_s: float, end_s: float, begins: Callable[[], None]
    ) -> Message:
        """Answer one request of the model's wire, one after the other.

        `begins` is called when its turn comes, and may raise. Raises WaitTimeout where that was not
        within `begin_s`, and ModelError where the answer took longer than `end_s`: the process has
        been killed then.
        """
        ...

    async def end(self, *, at_once: bool = False) -> None:
        """End the process after its present work, and wait until it is gone. Idempotent.

        `at_once`: in the middle of its work, for a load that is not wanted any more.
        """
        ...


class ModelProcess:
    """A `Model` in a process of its own."""

    def __init__(
        self,
        process: ForkServerProcess,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        self.ended = asyncio.Event()
        self._process = process
        self._reader = reader
        self._writer = writer
        self._turn = asyncio.Lock()
        self._prepared = False
        self._sentinel = process.sentinel
        asyncio.get_running_loop().add_reader(self._sentinel, self._on_end)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None, "it was started"
        return self._process.pid

    async def prepare(self) -> None:
        async with self._turn:
            if not self._prepared:
                await self._ask({"do": "prepare"})
                self._prepared = True

    async def load(self, gpu: str) -> int | None:
        async with self._turn:
            used: int | None = (await self._ask({"do": "load", "gpu": gpu}))["used_bytes"]
            return used

    async def run(
        self, call: Message, *, begin_s: float, end_s: float, begins: Callable[[], None]
    ) -> Message:
        try:
            async with asyncio.timeout(begin_s):
                await self._turn.acquire()
        except TimeoutError:
            raise WaitTimeout(
                f"the model was busy for {begin_s:.0f} s with earlier requests",
                hint="ask less often, or wait longer",
            ) from None
        try:
            begins()
            answering = asyncio.create_task(self._ask({"do": "run", "call": call}), name="answer")
            try:
                await asyncio.wait({answering}, timeout=end_s)
            except asyncio.CancelledError:  # the model works on: nothing else begins meanwhile
                await asyncio.wait({answering}, timeout=end_s)
                raise
            finally:
                if not answering.done():
                    _log.critical("the model has not answered within %.0f s: killing it", end_s)
                    self.kill()
                    answering.cancel()
            if answering.cancelled() or not answering.done():
                raise ModelError(
                    f"the model has not answered within {end_s:.0f} s; its process was ended",
                    hint="the next request loads it again; see the sidecar's log",
                )
            return await answering
        finally:
            self._turn.release()

    async def end(self, *, at_once: bool = False) -> None:
        if at_once:
            self.kill()
        async with self._turn:
            self._writer.close()  # the process frees its memory and ends
            try:
                async with asyncio.timeout(END_S):
                    await self.ended.wait()
            except TimeoutError:
                _log.warning("the model's process %d did not end: killing it", self.pid)
                self.kill()
                await self.ended.wait()

    def kill(self) -> None:
        """End the process in the middle of its work; its memory comes back all the same."""
        if not self.ended.is_set():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    async def _ask(self, message: Message) -> Message:
        """Raises the process's typed error, or ModelError where the process is gone."""
        packed = msgpack.packb(message)
        try:
            self._writer.write(LENGTH.pack(len(packed)) + packed)
            await self._writer.drain()
            (length,) = LENGTH.unpack(await self._reader.readexactly(LENGTH.size))
            reply: Message = msgpack.unpackb(await self._reader.readexactly(length))
        except (OSError, asyncio.IncompleteReadError):
            await self.ended.wait()
            raise ModelError(
                f"the model's process ended{self._how()}", hint="see the sidecar's log"
            ) from None
        if (error := reply.get("error")) is not None:
            raise from_wire(error)
        return reply

    def _on_end(self) -> None:
        asyncio.get_running_loop().remove_reader(self._sentinel)
        self._process.join()  # its end is known already
        self._writer.close()
        self.ended.set()

    def _how(self) -> str:
        code = self._process.exitcode
        if code is None or code >= 0:
            return "" if not code else f" with {code}"
        return f" by {signal.Signals(-code).name}"


class ModelProcesses:
    """Starts the processes of one model. The server of imports ends with this program."""

    def __init__(self, settings: Settings, adapter_for: "model_main.AdapterFor") -> None:
        self._settings = settings
        self._adapter_for = adapter_for
        self._context: ForkServerContext = multiprocessing.get_context("forkserver")

    def preload(self, modules: Iterable[str]) -> None:
        """Name the modules that the server imports. One that is missing is told by `prepare`."""
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        os.environ[NICE_VARIABLE] = str(self._settings.nice)
        self._context.set_forkserver_preload(["vram_arbiter.sidecars.preload", *modules])

    def _fork(self, process: ForkServerProcess) -> None:
        shipped = self._adapter_for is make_adapter  # else the script itself may define it
        with _main_unnamed() if shipped else contextlib.nullcontext():
            process.start()

    async def start(self) -> ModelProcess:
        """Fork a process; the first one waits for the imports."""
        ours, theirs = socket.socketpair()
        arguments = (self._settings, self._adapter_for, os.getpid(), theirs)
        process = self._context.Process(
            target=model_main.main,
            args=arguments,
            name=f"model of {self._settings.name}",
            daemon=True,
        )
        try:
            await _in_a_thread(partial(self._fork, process))
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        reader, writer = await asyncio.open_connection(sock=ours)
        return ModelProcess(process, reader, writer)


@contextlib.contextmanager
def _main_unnamed() -> Iterator[None]:
    """Keep multiprocessing from running the program's script again in the child: one without the
    usual guard would start a second sidecar there."""
    main = sys.modules["__main__"]
    spec, file = main.__spec__, vars(main).pop("__file__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        main.__spec__ = spec
        if file is not None:
            main.__file__ = file


async def _in_a_thread(work: Callable[[], None]) -> None:
    """Do the work in a thread that the program's end does not wait for."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[None] = loop.create_future()

    def tell(error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is None:
            done.set_result(None)
        else:
            done.set_exception(error)

    def run() -> None:
        error: BaseException | None = None
        try:
            work()
        except BaseException as failed:  # noqa: BLE001  raised where it is awaited
            error = failed
        with contextlib.suppress(RuntimeError):  # the program has ended
            loop.call_soon_threadsafe(tell, error)

    threading.Thread(target=run, name="start a model", daemon=True).start()
    await done
