"""Time for control loops: a replaceable monotonic clock and a precise sleep.

The only place of the runner that sleeps. Must not know ticks or skills.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

BUSY_TAIL_S = (
    0.001  # the kernel wakes a sleeper up to a millisecond late; the last one is spent awake
)


class Clock(Protocol):
    """Monotonic time of one machine, wall time for people, and sleeping."""

    def now_s(self) -> float: ...

    def now_ns(self) -> int: ...

    def wall_ns(self) -> int: ...

    def sleep_s(self, duration_s: float) -> None: ...


def precise_sleep(
    duration_s: float,
    *,
    sleep: Callable[[float], None] = time.sleep,
    now_s: Callable[[], float] = time.monotonic,
) -> None:
    """Sleep for `duration_s`: asleep up to the last millisecond, awake for that one.

    Returns at once if the duration is not positive.
    """
    wake_s = now_s() + duration_s
    if duration_s > BUSY_TAIL_S:
        sleep(duration_s - BUSY_TAIL_S)
    while now_s() < wake_s:
        pass


class SystemClock:
    """The machine's own clock."""

    def now_s(self) -> float:
        return time.monotonic()

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        return time.time_ns()

    def sleep_s(self, duration_s: float) -> None:
        precise_sleep(duration_s)
