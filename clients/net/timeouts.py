"""Waiting for an answer with a time limit that counts only the time in which this process ran.

A loop that was held up (an import, a stop, a busy machine) finds the answer and the end of its time at once. It must not know what is asked.
"""

import asyncio

HELD_UP_S = 0.1
"""A timer that is later than this says that the process did not run; a loop at work is late by milliseconds."""


async def answered[T](answer: asyncio.Future[T], timeout_s: float) -> T:
    """Its result, or what it raises. Raises TimeoutError after `timeout_s`, and cancels it; an answer that is there by then counts, and whoever
    was held up has as long again for it, `timeout_s` at most: what came meanwhile is still to be read."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    try:
        await asyncio.wait({answer}, timeout=timeout_s)
        late_s = loop.time() - deadline
        if not answer.done() and late_s > HELD_UP_S:
            await asyncio.wait({answer}, timeout=min(late_s, timeout_s))
        if not answer.done():
            raise TimeoutError
        return answer.result()
    finally:
        answer.cancel()
