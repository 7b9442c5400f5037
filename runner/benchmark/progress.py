"""How far a benchmark is, at which rate, and how long it takes yet: a line on stderr, which a
terminal rewrites.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from typing import Final

from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome
from vram_arbiter.schemas.runtime.printable import printable

CLEARED: Final = "\r\x1b[K"

log = logging.getLogger("runner")


class ProgressLine:
    """Of `episodes` that are left to play."""

    def __init__(self, episodes: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._episodes, self._played, self._errors = episodes, 0, 0
        self._clock, self._began_s = clock, clock()

    def tell(self, cell: Cell, played: SeedOutcome) -> None:
        """Show an outcome and what is left."""
        self._played += 1
        self._errors += played.success is None
        text = f"{cell.world}, {cell.contestant}, seed {played.seed}: {played}; {self}"
        if sys.stderr.isatty():
            print(CLEARED, printable(text), sep="", end="", file=sys.stderr, flush=True)
        else:
            log.info("%s", text)

    def end(self) -> None:
        """Leave the line to others."""
        if sys.stderr.isatty() and self._played:
            print(file=sys.stderr)

    def __str__(self) -> str:
        per_s = self._played / max(self._clock() - self._began_s, 1e-9)
        left = timedelta(seconds=round((self._episodes - self._played) / per_s))
        errors = f", {self._errors} errors" if self._errors else ""
        return f"{self._played}/{self._episodes}, {60 * per_s:.3g} a minute, {left} left{errors}"
