"""Deadlines by name.

Setting a later time is cheap, as renewals do it all the time. Reads no clock.
"""

from heapq import heapify, heappop, heappush

type TimerKey = tuple[str, str]
"""(kind, subject), e.g. ("ttl", "L3-17")."""

SLACK = 256
"""Entries of cleared timers that stay in the heap however few are set."""


class Timers:
    """Heap of deadlines; an entry that was moved later is corrected when it comes up."""

    def __init__(self) -> None:
        self._due: dict[TimerKey, float] = {}
        self._heap: list[tuple[float, TimerKey]] = []

    def __contains__(self, key: TimerKey) -> bool:
        return key in self._due

    def due(self, key: TimerKey) -> float | None:
        """When a timer comes up; None: it is not set."""
        return self._due.get(key)

    def set(self, key: TimerKey, at: float) -> None:
        before = self._due.get(key)
        self._due[key] = at
        if before is None or at < before:
            heappush(self._heap, (at, key))

    def clear(self, key: TimerKey) -> None:
        self._due.pop(key, None)
        if len(self._heap) > SLACK + 2 * len(self._due):
            # waits of a day that are given up after a second must not stay here for the day
            self._heap = [(at, timer) for timer, at in self._due.items()]
            heapify(self._heap)

    def next_at(self) -> float | None:
        """When the earliest timer is due."""
        while self._heap:
            at, key = self._heap[0]
            due = self._due.get(key)
            if due == at:
                return at
            heappop(self._heap)
            if due is not None and due > at:
                heappush(self._heap, (due, key))
        return None

    def pop_due(self, now: float) -> TimerKey | None:
        """Take the earliest timer that is due, or None."""
        at = self.next_at()
        if at is None or at > now:
            return None
        _, key = heappop(self._heap)
        del self._due[key]
        return key
