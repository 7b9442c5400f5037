"""The one thread that touches model and device. The event loop hands it work and stays free for `ping` and `revoke`."""

import asyncio
import contextvars
import os
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from schemas.errors import ModelError, OutOfMemory, VramError


class Worker:
    """Runs one piece of work after the other, in the order given. `stopping` ends waits inside the work (throttled loads).

    `nice` (0 to 19) is how far the thread, and those that a model library starts from it, stand behind other programs: imports and loads
    take all cores for seconds, and beside them somebody controls a robot.
    """

    def __init__(self, nice: int = 0) -> None:
        self._pool = ThreadPoolExecutor(
            max_workers=1, thread_name_prefix="model", initializer=_stand_back, initargs=(nice,)
        )
        self.stopping = threading.Event()

    async def run[T](self, work: Callable[[], T], *, abandon: bool = False) -> T:
        """Do the work and wait for it, also if the caller is cancelled meanwhile: a model is never left half loaded.

        `abandon`: do not wait then, for work that holds nothing (imports). Raises the work's own typed error; any other failure
        comes as ModelError, a full card as OutOfMemory. The work runs in the caller's context: its spans are the present span's children.
        """
        context = contextvars.copy_context()
        future = asyncio.get_running_loop().run_in_executor(self._pool, context.run, self._guarded, work)
        try:
            return await asyncio.shield(future)
        except asyncio.CancelledError:
            if not abandon:
                await asyncio.wait([future])
                if not future.cancelled():
                    future.exception()  # was seen: asyncio need not complain
            raise

    def close(self) -> None:
        """Refuse further work; what runs now ends by itself."""
        self.stopping.set()
        self._pool.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def _guarded[T](work: Callable[[], T]) -> T:
        try:
            return work()
        except VramError as error:
            _forget_locals(error)
            raise
        except (
            Exception
        ) as error:  # any failure inside a model is an answer to the caller, not the end of the sidecar
            _forget_locals(error)
            if (
                type(error).__name__ == "OutOfMemoryError"
            ):  # torch's; importing torch to say so would cost seconds
                raise OutOfMemory(str(error)) from error
            if isinstance(error, ImportError):
                raise ModelError(str(error), hint="pip install 'vram-arbiter[sidecars]'") from error
            raise ModelError(f"{type(error).__name__}: {error}", hint="see the sidecar's log") from error


def _forget_locals(error: BaseException | None) -> None:
    """Of the frames that a failure came through: the error is kept for `ping`, and half a loaded
    model would stay on the GPU with it."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__cause__ or error.__context__


def _stand_back(nice: int) -> None:
    """Of the calling thread alone: on Linux a nice value is a thread's."""
    os.setpriority(os.PRIO_PROCESS, 0, max(nice, os.getpriority(os.PRIO_PROCESS, 0)))
