"""The last minutes of the GPUs: how their bytes were divided, sampled when something changed.

Bounded by time and by bytes. Nothing is read for it, and nothing is kept while nothing changes.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from heapq import nlargest

from vram_arbiter.arbiter.core.report.usage import GpuUsage
from vram_arbiter.arbiter.http.messages import (
    OTHERS,
    PENDING_FREE,
    RETAINED,
    STOWAWAYS,
    Usage,
    UsageSample,
)

KEPT_S = 600.0
PERIOD_S = 0.5
CONSUMERS_MAX = 12
"""Consumers of one sample; the smaller ones are summed up."""
PARTS_MAX = 12_000
"""Of all samples together: about a megabyte."""

type Part = tuple[str | int, int]


@dataclass(frozen=True, slots=True)
class Division:
    """How the bytes of one GPU were divided from an instant on."""

    number: int
    at_s: float
    gpu: int
    used_bytes: int | None
    parts: tuple[Part, ...]


class UsageRecord:
    """`changed()` after each event of the engine; `since(number)` for the open pages."""

    def __init__(
        self,
        usage: Callable[[], Sequence[GpuUsage]],
        started_at: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._usage = usage
        self._started_at = started_at
        self._clock = clock
        self._samples: dict[int, deque[Division]] = {}  # by GPU, oldest first
        self._parts = 0
        self._taken_at = float("-inf")
        self._timer: asyncio.TimerHandle | None = None
        self.number = 0
        """Of the newest sample."""

    def changed(self) -> None:
        """Take a sample now, or when the last one is PERIOD_S old."""
        if self._timer is not None:
            return
        wait_s = self._taken_at + PERIOD_S - self._clock()
        if wait_s <= 0:
            self._take()
        else:
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._take)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def since(self, number: int) -> Usage:
        """Return the samples after a number; 0: all, as of now."""
        if number == 0 and self._timer is not None:
            self._timer.cancel()
            self._take()
        found = [
            sample
            for samples in self._samples.values()
            for sample in samples
            if sample.number > number
        ]
        found.sort(key=lambda sample: sample.number)
        places: dict[str, int] = {}
        samples = tuple(
            UsageSample(
                round(one.at_s, 2),
                one.gpu,
                one.used_bytes,
                tuple(
                    (part if isinstance(part, int) else places.setdefault(part, len(places)), count)
                    for part, count in one.parts
                ),
            )
            for one in found
        )
        return Usage(tuple(places), samples, KEPT_S)

    def _take(self) -> None:
        self._timer, self._taken_at = None, self._clock()
        at_s = self._taken_at - self._started_at
        for one in self._usage():
            parts = _parts(one)
            samples = self._samples.setdefault(one.index, deque())
            if samples and (samples[-1].parts, samples[-1].used_bytes) == (parts, one.used_bytes):
                continue
            self.number += 1
            samples.append(Division(self.number, at_s, one.index, one.used_bytes, parts))
            self._parts += 1 + len(parts)
            while len(samples) > 1 and samples[1].at_s <= at_s - KEPT_S:
                self._forget(samples)
        while self._parts > PARTS_MAX:
            longest = max(self._samples.values(), key=len)
            if len(longest) == 1:
                return
            self._forget(longest)

    def _forget(self, samples: deque[Division]) -> None:
        """Drop the oldest sample of a GPU; its newest one always stays, since it still holds."""
        self._parts -= 1 + len(samples.popleft().parts)


def _parts(one: GpuUsage) -> tuple[Part, ...]:
    """Return the parts of a GPU that have bytes: the largest consumers by name, then the codes."""
    named = nlargest(CONSUMERS_MAX, one.consumers.items(), key=lambda item: (item[1], item[0]))
    parts: list[Part] = sorted(named)
    if len(one.consumers) > len(named):
        rest = sum(one.consumers.values()) - sum(count for _, count in named)
        parts.append((OTHERS, rest))
    parts += [
        (PENDING_FREE, one.pending_free_bytes),
        (RETAINED, one.retained_bytes),
        (STOWAWAYS, one.stowaway_bytes),
    ]
    return tuple((part, count) for part, count in parts if count)
