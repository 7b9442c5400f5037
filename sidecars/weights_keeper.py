"""The process that keeps a model's weights in host RAM, and the server that it is forked from.

The server (`multiprocessing`'s forkserver) imports the model's libraries once. The *keeper*, forked
from it, holds the weights and touches no device. A model process (`model_process`) is forked from
the keeper for each residency. Must not know leases, wires or torch.
"""

import asyncio
import contextlib
import logging
import multiprocessing
import os
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Final

from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.runtime.threads import in_daemon_thread
from vram_arbiter.sidecars import model_main
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.model_main import THREADS_VARIABLE
from vram_arbiter.sidecars.model_process import Channel, ModelProcess, how_ended
from vram_arbiter.sidecars.settings import HOST_VARIABLE, NICE_VARIABLE, Settings

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


class _Keeper:
    """The process that holds the weights, and from which model processes are forked."""

    def __init__(
        self,
        process: ForkServerProcess,
        streams: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        births: socket.socket,
    ) -> None:
        self.ended = asyncio.Event()
        self.weights_bytes: int | None = None
        self._process = process
        self._channel = Channel(*streams, self._told)
        self._births = births
        self._sentinel = process.sentinel
        asyncio.get_running_loop().add_reader(self._sentinel, self._on_end)

    async def prepare(self) -> None:
        await self._channel.ask({"do": "prepare"})
        model = await self.fork()
        try:
            await model.check()
        finally:
            await model.end()

    async def load(self) -> int:
        if self.weights_bytes is None:
            self.weights_bytes = (await self._channel.ask({"do": "load"}))["bytes"]
        return self.weights_bytes

    async def drop(self) -> None:
        if self.weights_bytes is not None:
            self.weights_bytes = None
            await self._channel.ask({"do": "drop"})

    async def fork(self) -> ModelProcess:
        ours, theirs = socket.socketpair()
        with theirs:
            socket.send_fds(self._births, [b"."], [theirs.fileno()])
        try:
            pid = (await self._channel.ask({"do": "fork"}))["pid"]
            reader, writer = await asyncio.open_connection(sock=ours)
        except BaseException:
            ours.close()
            raise
        return ModelProcess(pid, reader, writer, self._reap)

    async def end(self) -> None:
        if not self.ended.is_set():
            self._process.kill()
            await self.ended.wait()

    async def _reap(self, pid: int) -> int | None:
        try:
            code: int = (await self._channel.ask({"do": "reap", "pid": pid}))["code"]
        except ModelError:  # the keeper is gone: the process was reaped by another one
            return None
        return code

    def _on_end(self) -> None:
        asyncio.get_running_loop().remove_reader(self._sentinel)
        self._process.join()  # its end is known already
        self._channel.close()
        self._births.close()
        self.ended.set()

    async def _told(self) -> str:
        await self.ended.wait()
        return f"the process that keeps the weights ended{how_ended(self._process.exitcode)}"


class ModelProcesses:
    """The weights of a model and the processes that use them. The server of imports ends with this
    program."""

    def __init__(
        self,
        settings: Settings,
        adapter_for: "model_main.AdapterFor",
        set_up_log: Callable[[], None],
    ) -> None:
        self._settings = settings
        self._adapter_for = adapter_for
        self._set_up_log = set_up_log
        self._context: ForkServerContext = multiprocessing.get_context("forkserver")
        self._threads = int(os.environ.get(THREADS_VARIABLE) or len(os.sched_getaffinity(0)))
        self._turn = asyncio.Lock()
        self._keeper: _Keeper | None = None

    def preload(self, modules: Iterable[str]) -> None:
        """Name the modules that the server imports. One that is missing is told by `prepare`."""
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        os.environ[THREADS_VARIABLE] = "1"  # of the server and the keeper, whatever is set here
        os.environ[NICE_VARIABLE] = str(self._settings.nice)
        os.environ[HOST_VARIABLE] = str(os.getpid())
        self._context.set_forkserver_preload(["vram_arbiter.sidecars.preload", *modules])

    async def prepare(self) -> None:
        """Do what needs neither weights nor a device. Repeatable. Raises ModelError or NoGpu."""
        async with self._turn:
            await self._prepared()

    async def load(self) -> int:
        """Read the weights into host RAM, if they are not there. Return their bytes.

        Raises ModelError or ConfigError.
        """
        async with self._turn:
            return await (await self._prepared()).load()

    async def start(self) -> ModelProcess:
        """Start a process that can copy them onto a GPU. Raises as `load`."""
        async with self._turn:
            keeper = await self._prepared()
            await keeper.load()  # they may have been dropped since
            return await keeper.fork()

    async def drop(self) -> None:
        """Free the host RAM of the weights. Never raises."""
        async with self._turn:
            if self._keeper is not None:
                with contextlib.suppress(ModelError):  # gone, and the weights with it
                    await self._keeper.drop()

    async def end(self) -> None:
        """End everything. Idempotent."""
        async with self._turn:
            if self._keeper is not None:
                await self._keeper.end()

    async def _prepared(self) -> _Keeper:
        """Return the keeper, another one where it has died."""
        keeper = self._keeper
        if keeper is None or keeper.ended.is_set():
            _log.info("starting the model's processes: its libraries are imported")
            began = time.monotonic()
            keeper = await self._start()
            try:
                await keeper.prepare()
            except BaseException:
                await keeper.end()
                raise
            self._keeper = keeper
            _log.info("prepared after %.2f s", time.monotonic() - began)
        return keeper

    async def _start(self) -> _Keeper:
        """Fork the keeper; the first one waits for the imports."""
        (ours, theirs), (births, births_there) = socket.socketpair(), socket.socketpair()
        process = self._context.Process(
            target=model_main.keep,
            args=(
                self._settings,
                self._adapter_for,
                self._set_up_log,
                self._threads,
                os.getpid(),
                theirs,
                births_there,
            ),
            name=f"weights of {self._settings.name}",
            daemon=True,
        )
        try:
            # from this thread: the server ends with the thread that started it (`preload`)
            forkserver.ensure_running()
            await in_daemon_thread(partial(self._fork, process), "start a model")
            streams = await asyncio.open_connection(sock=ours)
        except BaseException:
            ours.close()
            births.close()
            raise
        finally:
            theirs.close()
            births_there.close()
        return _Keeper(process, streams, births)

    def _fork(self, process: ForkServerProcess) -> None:
        shipped = self._adapter_for is make_adapter  # else the script itself may define it
        with _main_unnamed() if shipped else contextlib.nullcontext():
            process.start()


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
