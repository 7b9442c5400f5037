"""The daemon's event loop: asyncio's own, with timers that keep their microseconds.

epoll counts in whole milliseconds and Python rounds up, so each wait of 2 ms between two readings
of a card took up to 3. `select` on the epoll descriptor itself waits to the microsecond. Must not
know what the timers are for.
"""

import asyncio
import select
import selectors
import time

FINE_BELOW_S = 0.05
"""Longer waits do not notice a millisecond."""
SELECT_FD_MAX = 1023
"""`select` takes no greater descriptor. Ours is one of the first that the daemon opens."""


class FineSelector(selectors.EpollSelector):
    """Waits for whole milliseconds as ever; only what is left then takes a call more."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None or not 0 < timeout < FINE_BELOW_S or self.fileno() > SELECT_FD_MAX:
            return super().select(timeout)
        until = time.monotonic() + timeout
        if timeout >= 0.001:
            ready = super().select((int(timeout * 1e3) - 0.5) / 1e3)  # it rounds up
            if ready:
                return ready
        select.select((self.fileno(),), (), (), max(0.0, until - time.monotonic()))
        return super().select(0)


def new_loop() -> asyncio.AbstractEventLoop:
    return asyncio.SelectorEventLoop(FineSelector())
