"""Start times, delays and durations of a run's newest ticks.

Plain numbers, so that the garbage collector has no objects to walk. Written by the control thread,
read by any.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path

TIMINGS_KEPT = (
    36_000  # twenty minutes at 30 Hz; older timings leave the percentiles, never the counts
)

_SHARES = {"p50": 0.5, "p99": 0.99, "max": 1.0}


def percentile(values: Sequence[float], share: float) -> float:
    """Return a percentile by linear interpolation between ranks; 0.0 for no values.

    Args: `share` runs from 0 to 1.
    """
    if not values:
        return 0.0
    ordered = sorted(values)
    rank = share * (len(ordered) - 1)
    low = math.floor(rank)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (rank - low)


def spread(values: Iterable[float]) -> dict[str, float]:
    """Return median, 99th percentile and maximum."""
    kept = list(values)
    return {name: percentile(kept, share) for name, share in _SHARES.items()}


def mean(values: Sequence[float]) -> float:
    """0.0 for no values."""
    return sum(values) / len(values) if values else 0.0


class Timings:
    """The last `kept` ticks.

    Reset ticks build a scene: they count neither as inference nor as late.
    """

    def __init__(self, kept: int = TIMINGS_KEPT) -> None:
        self._rows: deque[tuple[float, ...]] = deque(maxlen=kept)

    def add(
        self,
        started_s: float,
        late_ms: float,
        tick_ms: float,
        inference_ms: float,
        hal_ms: float = 0.0,
        *,
        reset: bool = False,
    ) -> None:
        """Add one tick: monotonic start, delay, and durations of the tick, its skill and the
        robot.
        """
        self._rows.append((started_s, late_ms, tick_ms, inference_ms, hal_ms, float(reset)))

    def clear(self) -> None:
        """Forget all ticks."""
        self._rows.clear()

    @property
    def tick_ms(self) -> list[float]:
        """Of all ticks."""
        return [row[2] for row in self._snapshot()]

    @property
    def inference_ms(self) -> list[float]:
        """Of all ticks that may have asked a skill."""
        return [row[3] for row in self._snapshot() if not row[5]]

    @property
    def late_ms(self) -> list[float]:
        """How far behind its slot each tick began."""
        return [row[1] for row in self._snapshot() if not row[5]]

    def write(self, path: Path) -> None:
        """Write one JSON line per tick. Raises OSError."""
        names = ("started_s", "late_ms", "tick_ms", "inference_ms", "hal_ms")
        with path.open("w") as file:
            file.writelines(
                json.dumps(dict(zip(names, row, strict=False)) | {"reset": bool(row[5])}) + "\n"
                for row in self._snapshot()
            )

    def _snapshot(self) -> Iterable[tuple[float, ...]]:
        """Copy in one step of the interpreter: the control thread keeps adding."""
        return self._rows.copy()
