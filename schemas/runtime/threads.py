"""Blocking work beside an event loop."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future

from vram_arbiter.schemas.errors import ProbeFailed


async def in_daemon_thread[T](work: Callable[[], T], name: str) -> T:
    """Do the work in a thread that the program's end does not wait for, if it hangs. Raises what
    the work raises."""
    done: Future[T] = Future()
    done.set_running_or_notify_cancel()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:  # noqa: BLE001  raised where it is awaited
            done.set_exception(error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return await asyncio.wrap_future(done)


async def answered_within[T](limit_s: float, work: Callable[[], T], what: str = "the driver") -> T:
    """Do work that may hang in a daemon thread. Raises ProbeFailed after `limit_s`, and what the
    work raises."""
    try:
        async with asyncio.timeout(limit_s):
            return await in_daemon_thread(work, what)
    except TimeoutError as error:
        late = f"{what} gave no answer within {limit_s:g} s"
        raise ProbeFailed(late, hint="see nvidia-smi and dmesg") from error
