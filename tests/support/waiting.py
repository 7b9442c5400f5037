"""Waiting in tests: for a condition that shows from outside, and for a story with an end."""

import asyncio
from collections.abc import Awaitable, Callable

from vram_arbiter.testing import waiting

PATIENCE_S = 60.0


def until[T](condition: Callable[[], T], deadline_s: float = PATIENCE_S) -> T:
    """Poll until the condition is true, and return its value; AssertionError at the deadline."""
    return waiting.eventually(condition, deadline_s)


async def eventually(condition: Callable[[], object]) -> None:
    """Wait as `until`, without holding up the event loop."""
    await asyncio.to_thread(until, condition)


def play[T](story: Callable[[], Awaitable[T]], limit_s: float = PATIENCE_S) -> T:
    """Run a story in an event loop of its own, and return its result; TimeoutError at the limit."""

    async def bounded() -> T:
        async with asyncio.timeout(limit_s):
            return await story()

    return asyncio.run(bounded())
