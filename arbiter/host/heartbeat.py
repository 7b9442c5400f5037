"""Heartbeat of the daemon: its periodic chores, systemd's watchdog and status line."""

import asyncio
from collections.abc import Callable, Iterable

from vram_arbiter.schemas.runtime.systemd import Notifier

STATUS_EVERY_S = 5.0


async def beat(
    notifier: Notifier,
    alive: Callable[[], bool],
    chores: Iterable[Callable[[], None]],
    status: Callable[[], str],
) -> None:
    """Do the chores every few seconds, until canceled.

    The watchdog is fed only if `alive` says that an event has just passed through the engine and
    the executor, on this very thread: whatever is stuck there starves it.
    """
    period_s = min(STATUS_EVERY_S, (notifier.watchdog_s or 3 * STATUS_EVERY_S) / 3)
    said = ""
    while True:
        await asyncio.sleep(period_s)
        if notifier.watchdog_s is not None and alive():
            notifier.watchdog()
        for chore in chores:
            chore()
        if (text := status()) != said and notifier.status(text):
            said = text
