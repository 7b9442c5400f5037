"""Slots of a control loop at a fixed rate: when a tick is due, and how long the loop sleeps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vram_arbiter.runner.control.clock import Clock


@dataclass(frozen=True, slots=True)
class Slot:
    """One tick's place on the grid: how late it began and when it has to be over."""

    late_ms: float = 0.0
    deadline_s: float = math.inf  # infinite without a rate


class Pacing:
    """Grid of slots. `rate_hz` 0 runs as fast as it can, without deadlines. Raises ValueError."""

    def __init__(self, rate_hz: float, clock: Clock) -> None:
        if not math.isfinite(rate_hz) or rate_hz < 0:
            raise ValueError(f"rate_hz must be 0 or more, got {rate_hz}")
        self.rate_hz = rate_hz
        self._clock = clock
        self._due_s: float | None = None  # when the present tick should have begun

    @property
    def period_s(self) -> float | None:
        return 1.0 / self.rate_hz if self.rate_hz > 0 else None

    def start(self) -> None:
        """Begin a grid now."""
        self._due_s = self._clock.now_s()

    def stop(self) -> None:
        """Leave the grid: single ticks are due when they begin."""
        self._due_s = None

    def slot(self, started_s: float) -> Slot:
        """Return the slot of a tick that began at `started_s`."""
        period_s = self.period_s
        due_s = started_s if self._due_s is None or period_s is None else self._due_s
        late_ms = max(0.0, started_s - due_s) * 1e3
        return Slot(late_ms, math.inf if period_s is None else due_s + period_s)

    def wait(self) -> None:
        """Sleep to the next slot that is still to come.

        A long tick costs its own slots only: the grid resynchronizes, no burst catches up.
        """
        period_s = self.period_s
        if period_s is None or self._due_s is None:
            return
        self._due_s += period_s
        behind_s = self._clock.now_s() - self._due_s
        if behind_s > 0:
            self._due_s += math.ceil(behind_s / period_s) * period_s
        self._clock.sleep_s(self._due_s - self._clock.now_s())
