"""Refused requests in the daemon's log, with their reasons and without letting a peer fill the disk with them."""

import logging
import time
from collections.abc import Callable

from schemas.runtime.printable import printable

log = logging.getLogger(__name__)

BURST = 50
PER_S = 5.0
"""Lines a second in the long run. What is left out is counted, and the count stands in the next line."""


class RefusalLog:
    """`say` for every refusal; beyond the rate it only counts."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._budget = float(BURST)
        self._at = clock()
        self._left_out = 0

    def say(self, client: str, request: int | None, code: str, message: str) -> None:
        now = self._clock()
        self._budget = min(float(BURST), self._budget + (now - self._at) * PER_S)
        self._at = now
        if self._budget < 1:
            self._left_out += 1
            return
        self._budget -= 1
        more = f" ({self._left_out} more refusals before it are not shown)" if self._left_out else ""
        self._left_out = 0
        log.info(
            "refused request %s of client %s: %s: %s%s", request, client[:16], code, printable(message), more
        )
