"""The daemon's event loop: asyncio's own, with timers that keep their microseconds.

epoll counts in whole milliseconds and Python rounds up, so each wait of 2 ms between two readings of a card took up to 3. `select` on
the epoll descriptor itself waits to the microsecond. Must not know what the timers are for.
"""

import asyncio
import select
import selectors

FINE_BELOW_S = 0.05
"""Longer waits do not notice a millisecond."""
SELECT_FD_MAX = 1023
"""`select` takes no greater descriptor. Ours is one of the first that the daemon opens."""


class FineSelector(selectors.EpollSelector):
    """Waits first for anything or for the exact time, then asks what there is."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is not None and 0 < timeout < FINE_BELOW_S and self.fileno() <= SELECT_FD_MAX:
            select.select((self.fileno(),), (), (), timeout)
            timeout = 0
        return super().select(timeout)


def new_loop() -> asyncio.AbstractEventLoop:
    return asyncio.SelectorEventLoop(FineSelector())
