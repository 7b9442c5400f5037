"""Was the machine suspended? CLOCK_BOOTTIME runs on while it sleeps, CLOCK_MONOTONIC does not:
their difference is the sleep.

Timers, deadlines and readings all use the monotonic clock, so nothing expires over night, and the
daemon has to notice that the night was there. Must not know what is done about it.
"""

import time
from collections.abc import Callable
from functools import partial

NOTICED_S = 1.0
"""A shorter sleep changes nothing that a reading of the card would show."""


_boottime = partial(time.clock_gettime, time.CLOCK_BOOTTIME)


class SuspendWatch:
    """`slept_s()` gives the seconds slept since it was last asked, each sleep once; 0.0 if there
    was none."""

    def __init__(
        self,
        boottime: Callable[[], float] = _boottime,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._boottime = boottime
        self._monotonic = monotonic
        self._total_s = self._lead_s()

    def slept_s(self) -> float:
        total_s = self._lead_s()
        slept_s = total_s - self._total_s
        if slept_s < NOTICED_S:
            return 0.0
        self._total_s = total_s
        return slept_s

    def _lead_s(self) -> float:
        """Boottime's lead. A thread that is held up between the two readings sees less of it, never
        more: no sleep is made up."""
        boottime = self._boottime()
        return boottime - self._monotonic()
