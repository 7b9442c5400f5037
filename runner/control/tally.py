"""Counts of a goal's actions and chunks, or of a whole run's, for its result."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from vram_arbiter.runner.control.timings import TIMINGS_KEPT, spread
from vram_arbiter.runner.protocols import ChunkStart, GoalData


def _newest() -> deque[float]:
    return deque(maxlen=TIMINGS_KEPT)


@dataclass(slots=True)
class Tally:
    """`first_ms` and `chunk_ms`: latencies of goals' first chunks and of all others. `late_ms`: how
    far behind its slot each tick began, from the first action on.
    """

    withheld: int = 0
    clamped: int = 0
    prefetch_hits: int = 0
    prefetch_misses: int = 0
    standing_steps: int = 0
    over_budget: int = 0
    first_ms: deque[float] = field(default_factory=_newest)
    chunk_ms: deque[float] = field(default_factory=_newest)
    late_ms: deque[float] = field(default_factory=_newest)

    def count_chunk(self, chunk: ChunkStart) -> None:
        """Add a chunk of which the first action is due."""
        (self.first_ms if chunk.in_time is None else self.chunk_ms).append(chunk.latency_s * 1e3)
        self.over_budget += chunk.over_budget
        self.prefetch_hits += chunk.in_time is True
        self.prefetch_misses += chunk.in_time is False

    def as_data(self) -> GoalData:
        """Return the counts; of chunks only where there was one, and of prefetch only where one
        followed another.
        """
        data: GoalData = {"withheld": self.withheld, "clamped": self.clamped}
        if self.late_ms:
            data["late_starts_ms"] = spread(self.late_ms)
        if self.first_ms:
            later = spread(self.chunk_ms) if self.chunk_ms else {}
            data["chunk_latency_ms"] = {"first": max(self.first_ms), **later}
            data["chunks_over_budget"] = self.over_budget
            data["standing_steps"] = self.standing_steps
        if chunks := self.prefetch_hits + self.prefetch_misses:
            data["prefetch"] = {
                "hits": self.prefetch_hits,
                "misses": self.prefetch_misses,
                "hit_rate": self.prefetch_hits / chunks,
            }
        return data
