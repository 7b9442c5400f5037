"""The process of one residency, as the sidecar's host sees it.

It is forked from the keeper of the weights (`weights_keeper`) and owns the device's context; its
end returns every byte of it. The host speaks to it over a socket pair, one msgpack map each way at
a time (`model_main`). Whatever goes wrong in it is a typed error here, never the end of the host.
Must not know leases, wires or torch.
"""

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Awaitable, Callable
from typing import Final

import msgpack

from vram_arbiter.schemas.errors import ModelError, WaitTimeout, from_wire
from vram_arbiter.schemas.plain import Message
from vram_arbiter.sidecars.model_main import LENGTH

END_S: Final = 5.0
"""How long a process may take to free its memory in order; then it is killed."""
_log = logging.getLogger("sidecars")


class Channel:
    """Requests to one process, answered in turn."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        gone: Callable[[], Awaitable[str]],
    ) -> None:
        self._reader = reader
        self._writer = writer
        self._gone = gone
        self._turn = asyncio.Lock()

    async def ask(self, message: Message) -> Message:
        """Raises the process's typed error, or ModelError with the text of `gone`. A caller that is
        canceled leaves the exchange to itself: the answer is not taken for the next one's."""
        exchange = asyncio.create_task(self._exchange(message), name="ask")
        exchange.add_done_callback(lambda done: done.cancelled() or done.exception())
        return await asyncio.shield(exchange)

    async def _exchange(self, message: Message) -> Message:
        packed = msgpack.packb(message)
        async with self._turn:
            try:
                self._writer.write(LENGTH.pack(len(packed)) + packed)
                await self._writer.drain()
                (length,) = LENGTH.unpack(await self._reader.readexactly(LENGTH.size))
                reply: Message = msgpack.unpackb(await self._reader.readexactly(length))
            except (OSError, asyncio.IncompleteReadError):
                raise ModelError(await self._gone(), hint="see the sidecar's log") from None
        if (error := reply.get("error")) is not None:
            raise from_wire(error)
        return reply

    def close(self) -> None:
        self._writer.close()


class ModelProcess:
    """One residency of a model, in a process of its own.

    `ended`: it is gone, and its memory with it. `reap` returns its exit code once it has ended.
    """

    def __init__(
        self,
        pid: int,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        reap: Callable[[int], Awaitable[int | None]],
    ) -> None:
        self.ended = asyncio.Event()
        self.pid = pid
        self._channel = Channel(reader, writer, self._told)
        self._reap = reap
        self._code: int | None = None
        self._turn = asyncio.Lock()
        self._pidfd = os.pidfd_open(pid)  # it is not reaped before its end was seen here
        self._ending: asyncio.Task[None] | None = None
        asyncio.get_running_loop().add_reader(self._pidfd, self._on_end)

    async def check(self) -> None:
        """Open the device, and allocate nothing. Raises NoGpu or ConfigError."""
        await self._channel.ask({"do": "check"})

    async def load(self, gpu: str) -> int | None:
        """Copy the weights onto a GPU (its UUID; "": the only one). Return the bytes on it, None if
        unknown.

        Raises OutOfMemory, NoGpu or ModelError; end the process then.
        """
        async with self._turn:
            used: int | None = (await self._channel.ask({"do": "load", "gpu": gpu}))["used_bytes"]
            return used

    async def run(
        self, call: Message, *, begin_s: float, end_s: float, begins: Callable[[], None]
    ) -> Message:
        """Answer one request of the model's wire, one after the other.

        `begins` is called when its turn comes, and may raise. Raises WaitTimeout where that was not
        within `begin_s`, and ModelError where the answer took longer than `end_s`: the process has
        been killed then.
        """
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
            answering = asyncio.create_task(
                self._channel.ask({"do": "run", "call": call}), name="answer"
            )
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
        """End the process after its present work, and wait until it is gone. Idempotent.

        `at_once`: in the middle of its work, for a load that is not wanted any more.
        """
        if at_once:
            self.kill()
        async with self._turn:
            self._channel.close()  # the process frees its memory and ends
            try:
                async with asyncio.timeout(END_S):
                    await self.ended.wait()
            except TimeoutError:
                _log.warning("the model's process %d did not end: killing it", self.pid)
                self.kill()
                await self.ended.wait()

    def kill(self) -> None:
        """End the process in the middle of its work; its memory comes back all the same."""
        if self._ending is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def _on_end(self) -> None:
        asyncio.get_running_loop().remove_reader(self._pidfd)
        os.close(self._pidfd)
        self._ending = asyncio.create_task(self._end(), name="reap")

    async def _end(self) -> None:
        self._code = await self._reap(self.pid)
        self._channel.close()
        self.ended.set()

    async def _told(self) -> str:
        await self.ended.wait()
        return f"the model's process ended{how_ended(self._code)}"


def how_ended(code: int | None) -> str:
    if code is None or code >= 0:
        return "" if not code else f" with {code}"
    return f" by {signal.Signals(-code).name}"
