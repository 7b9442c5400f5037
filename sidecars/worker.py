"""The one thread that touches model and device.

The event loop hands it work and stays free for `ping` and `revoke`.
"""

import asyncio
import contextvars
import os
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from vram_arbiter.schemas.errors import ModelError, OutOfMemory, VramError, WaitTimeout


class Worker:
    """Thread that runs one piece of work after the other, in the order given.

    `stopping` ends waits inside the work (throttled loads). `nice` (0 to 19) lowers the thread, and
    those that a model library starts from it, below other programs: imports and loads take all
    cores for seconds, beside a robot's control loop.
    """

    def __init__(self, nice: int = 0) -> None:
        self._pool = ThreadPoolExecutor(
            max_workers=1, thread_name_prefix="model", initializer=_stand_back, initargs=(nice,)
        )
        self.stopping = threading.Event()
        self.stuck = asyncio.Event()
        """Set when work did not end within its time. No thread can be ended from outside, only the
        process."""

    async def run_for[T](self, work: Callable[[], T], *, begin_s: float, end_s: float) -> T:
        """Do the work as `run` does, within limits.

        Raises: WaitTimeout when it could not begin within `begin_s`, because other work is in
        progress: it never will. ModelError when it has not ended `end_s` after that: it still runs,
        and `stuck` is set.
        """
        loop, context = asyncio.get_running_loop(), contextvars.copy_context()
        begun: asyncio.Future[None] = loop.create_future()

        def begin() -> None:
            if not begun.done():
                begun.set_result(None)

        def noted() -> T:
            loop.call_soon_threadsafe(begin)
            return work()

        submitted = self._pool.submit(context.run, self._guarded, noted)
        done = asyncio.wrap_future(submitted)
        done.add_done_callback(_seen)
        try:
            waited: set[asyncio.Future[Any]] = {begun, done}
            await asyncio.wait(waited, timeout=begin_s, return_when=asyncio.FIRST_COMPLETED)
            if submitted.cancel():
                raise WaitTimeout(
                    f"the model was busy for {begin_s:.0f} s with earlier requests",
                    hint="ask less often, or wait longer",
                )
            await self._until(done, end_s)
        except asyncio.CancelledError:
            if not submitted.cancel():
                await self._until(done, end_s)
            raise
        if not done.done():
            raise ModelError(
                f"the model has not answered within {end_s:.0f} s; the sidecar ends",
                hint="the next request starts it again; see its log",
            )
        return await done

    async def _until(self, done: asyncio.Future[Any], end_s: float) -> None:
        await asyncio.wait({done}, timeout=end_s)
        if not done.done():
            self.stuck.set()

    async def run[T](self, work: Callable[[], T], *, abandon: bool = False) -> T:
        """Do the work and wait for it, also if the caller is canceled: a model is never left half
        loaded.

        `abandon`: do not wait then, for work that holds nothing (imports). Raises the work's own
        typed error; any other failure comes as ModelError, a full GPU as OutOfMemory. The work runs
        in the caller's context: its spans are the present span's children.
        """
        context = contextvars.copy_context()
        future = asyncio.get_running_loop().run_in_executor(
            self._pool, context.run, self._guarded, work
        )
        try:
            return await asyncio.shield(future)
        except asyncio.CancelledError:
            if not abandon:
                await asyncio.wait([future])
                if not future.cancelled():
                    future.exception()  # the failure was seen: asyncio need not log it
            raise

    def close(self) -> None:
        """Refuse further work; work in progress ends by itself."""
        self.stopping.set()
        self._pool.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def _guarded[T](work: Callable[[], T]) -> T:
        try:
            return work()
        except VramError as error:
            _forget_locals(error)
            raise
        # any failure inside a model is an answer to the caller, not the end of the sidecar
        except Exception as error:
            _forget_locals(error)
            if (
                type(error).__name__ == "OutOfMemoryError"
            ):  # torch's class; importing torch to compare it would cost seconds
                raise OutOfMemory(str(error)) from error
            if isinstance(error, ImportError):
                raise ModelError(str(error), hint="pip install 'vram-arbiter[sidecars]'") from error
            raise ModelError(
                f"{type(error).__name__}: {error}", hint="see the sidecar's log"
            ) from error


def _seen(done: asyncio.Future[Any]) -> None:
    """Keep asyncio from logging a failure that has no caller any more."""
    if not done.cancelled():
        done.exception()


def _forget_locals(error: BaseException | None) -> None:
    """Clear the frames of a failure: the error is kept for `ping`, and half a loaded model would
    stay on the GPU with it."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__cause__ or error.__context__


def _stand_back(nice: int) -> None:
    """Lower the calling thread alone: on Linux a nice value belongs to a thread."""
    os.setpriority(os.PRIO_PROCESS, 0, max(nice, os.getpriority(os.PRIO_PROCESS, 0)))
