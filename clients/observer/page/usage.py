"""The last hour of the GPUs: how their bytes were divided, at each change that was seen.

Bounded by time and by number. Outlives restarts of the daemon.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from heapq import nlargest

from vram_arbiter.clients.observer.figures import GpuUsage
from vram_arbiter.clients.observer.page.messages import (
    OTHERS,
    PENDING_FREE,
    RETAINED,
    STOWAWAYS,
    Usage,
    UsageSample,
)

KEPT_S = 3600.0
CONSUMERS_MAX = 12
"""Consumers of one sample; the smaller ones are summed up."""
PARTS_MAX = 12_000
"""Of all samples together: about a megabyte."""

type Part = tuple[str | int, int]


@dataclass(frozen=True, slots=True)
class Division:
    """How the bytes of one GPU were divided from an instant (monotonic) on."""

    number: int
    at: float
    gpu: int
    used_bytes: int | None
    parts: tuple[Part, ...]


class UsageRecord:
    """`take` with each status; `since` for the open pages."""

    def __init__(self) -> None:
        self._samples: dict[int, deque[Division]] = {}  # by GPU, oldest first
        self._parts = 0
        self.number = 0
        """Of the newest sample."""

    def take(self, usage: Iterable[GpuUsage], now: float) -> None:
        for one in usage:
            parts = _parts(one)
            samples = self._samples.setdefault(one.index, deque())
            if samples and (samples[-1].parts, samples[-1].used_bytes) == (parts, one.used_bytes):
                continue
            self.number += 1
            samples.append(Division(self.number, now, one.index, one.used_bytes, parts))
            self._parts += 1 + len(parts)
            while len(samples) > 1 and samples[1].at <= now - KEPT_S:
                self._forget(samples)
        while self._parts > PARTS_MAX:
            longest = max(self._samples.values(), key=len)
            if len(longest) == 1:
                return
            self._forget(longest)

    def since(self, number: int, origin: float) -> Usage:
        """Return the samples after a number; 0: all.

        `origin`: the daemon's start, from which their times count; earlier ones are negative.
        """
        every = (sample for samples in self._samples.values() for sample in samples)
        found = sorted((one for one in every if one.number > number), key=lambda one: one.number)
        places: dict[str, int] = {}
        samples = tuple(
            UsageSample(
                round(one.at - origin, 2),
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
