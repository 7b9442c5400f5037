"""The daemon's own process: its event loop, memory and descriptors.

asyncio's loop keeps its timers' microseconds here: epoll counts in whole milliseconds and Python
rounds up, so each wait of 2 ms between two readings of a GPU took up to 3. `select` on the epoll
descriptor itself waits to the microsecond. Must not know what the daemon does.
"""

import asyncio
import os
import resource
import select
import selectors
import signal
import sys
import time

FINE_BELOW_S = 0.05
"""Longer waits do not notice a millisecond."""
SELECT_FD_MAX = 1023
"""`select` takes no greater descriptor. Ours is one of the first that the daemon opens."""
OPEN_FILES = 65_536
SWITCH_S = 0.0005
"""How long the loop may keep the interpreter from a thread that reads a GPU, which asks for it some
twenty times per reading: with Python's own 5 ms a client that floods the loop makes every reading
take a tenth of a second.
"""


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


def memory_bytes() -> int:
    """Return the RAM of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def leave_no_zombies() -> None:
    """As the first process of a container, let the kernel reap what ends.

    Orphans of other programs become children of this one, which starts no process itself.
    """
    if os.getpid() == 1:
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)


def raise_limits() -> int:
    """Let readings have the interpreter soon, and open as many files as may be. Return how many.

    A connection and a pidfd per client need more than the usual soft limit of 1,024 descriptors.
    """
    sys.setswitchinterval(SWITCH_S)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return soft
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    return wanted
