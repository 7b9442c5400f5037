"""Bytes of one program over time, and the figures that they give. Pure: no clock, no GPU."""

from bisect import bisect_right
from dataclasses import dataclass, field
from operator import itemgetter

MIB = 1024 * 1024
REST_BYTES = MIB
"""Readings that differ by no more are at rest."""
LAST_PART = 0.25
"""Share of a program's time on the GPU, at its end, in which it is taken to do its work."""


@dataclass(slots=True)
class Series:
    """Readings in the order of time, kept where they change."""

    levels: list[tuple[float, int]] = field(default_factory=list)
    """(since, bytes): one list, because one thread adds to it and another one reads."""
    end_s: float = 0.0
    readings: int = 0

    def add(self, at_s: float, count: int) -> None:
        if not self.levels or count != self.last:
            self.levels.append((at_s, count))
        self.end_s = at_s
        self.readings += 1

    @property
    def last(self) -> int:
        return self.levels[-1][1] if self.levels else 0

    @property
    def rate_hz(self) -> float:
        """Readings per second, as they were really made."""
        span_s = self.end_s - self.levels[0][0] if self.levels else 0.0
        return (self.readings - 1) / span_s if span_s > 0 else 0.0

    def rested_s(self) -> float:
        """Return how long the newest level has lasted."""
        last, since_s = self.last, self.end_s
        for at_s, level in reversed(self.levels):
            if abs(level - last) > REST_BYTES:
                break
            since_s = at_s
        return self.end_s - since_s

    def peak(self, from_s: float, to_s: float) -> int:
        """Return the most within an interval; its first moment has the level from before it."""
        return max((level for level, _ in self._within(from_s, to_s)), default=0)

    def median(self, from_s: float, to_s: float) -> int:
        """Return the level that lies in the middle of an interval's time."""
        within = sorted(self._within(from_s, to_s))
        left = sum(lasted for _, lasted in within) / 2
        for level, lasted in within:
            left -= lasted
            if left <= 0:
                return level
        return 0

    def presence(self) -> tuple[float, float] | None:
        """Return the time of the first bytes and that after the last; None: none were seen."""
        shown = [at for at, (_, level) in enumerate(self.levels) if level > REST_BYTES]
        if not shown:
            return None
        return self.levels[shown[0]][0], self._until_s(shown[-1])

    def _until_s(self, at: int) -> float:
        return self.levels[at + 1][0] if at + 1 < len(self.levels) else self.end_s

    def _within(self, from_s: float, to_s: float) -> list[tuple[int, float]]:
        """Return (level, seconds) in the order of time."""
        found = []
        first = max(0, bisect_right(self.levels, from_s, key=itemgetter(0)) - 1)
        for at in range(first, len(self.levels)):
            since_s, level = self.levels[at]
            if since_s > to_s:
                break
            lasted_s = min(self._until_s(at), to_s) - max(since_s, from_s)
            found.append((level, max(0.0, lasted_s)))
        return found


@dataclass(frozen=True, slots=True)
class Figures:
    """What was measured, in bytes. Each but `context` is of the whole process tree.

    `inference_peak` None: nothing was asked. `retained` is left after an unload, `after_exit` after
    the program's end.
    """

    context: int
    load_peak: int
    steady: int
    inference_peak: int | None
    retained: int | None
    after_exit: int

    @property
    def freed(self) -> int:
        """What the unload, or for a program without one its end, gave back."""
        return self.steady - (self.after_exit if self.retained is None else self.retained)


def of_life(series: Series, context: int, after_exit: int) -> Figures | None:
    """Return the figures of a program that ran from its start to its end; None: no bytes were seen.

    Nothing tells when such a program has loaded: its peak is that of the load, and the last part of
    its time on the GPU is taken for its work.
    """
    presence = series.presence()
    if presence is None:
        return None
    from_s, to_s = presence
    work_s = to_s - (to_s - from_s) * LAST_PART
    before_exit_s = _just_before(to_s)
    return Figures(
        context=context,
        load_peak=series.peak(from_s, before_exit_s),
        steady=series.median(work_s, to_s),
        inference_peak=series.peak(work_s, before_exit_s),
        retained=None,
        after_exit=after_exit,
    )


def _just_before(at_s: float) -> float:
    """At `at_s` itself the next level begins."""
    return at_s - 1e-9
