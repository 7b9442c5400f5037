"""Wait queue of one GPU, ordered by effective priority.

Effective priority is priority + waited/ageing. All requests age at the same rate, so the order of
two is fixed when they arrive: `arrival time − priority × ageing` (smaller first), then arrival. The
queue is a sorted list that time never disturbs; every wait is bounded. Without ageing (0) it is the
order of arrival.
"""

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator
from itertools import islice

from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.schemas.ids import LeaseId

type Rank = tuple[float, int]


class WaitQueue:
    """Sorted requests; keeps the smallest need, so that a full GPU is seen at a glance."""

    def __init__(self, ageing_s_per_point: float) -> None:
        self._ageing_s = ageing_s_per_point
        self._ranks: list[Rank] = []
        self._leases: dict[int, Lease] = {}  # by arrival
        self._needs: list[int] = []

    def __len__(self) -> int:
        return len(self._ranks)

    def __iter__(self) -> Iterator[Lease]:
        return (self._leases[arrival] for _, arrival in self._ranks)

    def __contains__(self, lease: Lease) -> bool:
        return lease.request.arrival in self._leases

    def add(self, lease: Lease) -> None:
        insort(self._ranks, self.rank(lease))
        insort(self._needs, lease.request.load_peak_bytes)
        self._leases[lease.request.arrival] = lease

    def discard(self, lease: Lease) -> None:
        """Take a request out, if it is here."""
        if lease.request.arrival not in self._leases:
            return
        del self._leases[lease.request.arrival]
        del self._ranks[bisect_left(self._ranks, self.rank(lease))]
        del self._needs[bisect_left(self._needs, lease.request.load_peak_bytes)]

    def head(self) -> Lease | None:
        return self._leases[self._ranks[0][1]] if self._ranks else None

    def behind_head(self) -> Iterator[Lease]:
        for index in range(1, len(self._ranks)):
            yield self._leases[self._ranks[index][1]]

    def smallest_need_bytes(self) -> int:
        """Return the smallest load peak of a queue that is not empty."""
        return self._needs[0]

    def precedes(self, first: Lease, second: Lease) -> bool:
        """Return whether `first` is, or was, before `second`. Neither has to wait still."""
        return self.rank(first) < self.rank(second)

    def position(self, lease: Lease) -> int:
        """Return the place of a request; 1 is the head."""
        return bisect_left(self._ranks, self.rank(lease)) + 1

    def ahead_of(self, lease: Lease) -> LeaseId | None:
        """Return the request directly before this one."""
        index = self.position(lease) - 2
        return self._leases[self._ranks[index][1]].id if index >= 0 else None

    def after(self, rank: Rank) -> Iterator[Lease]:
        """Yield the requests behind a rank, whether or not a request has it now."""
        first = bisect_right(self._ranks, rank)
        return (self._leases[arrival] for _, arrival in islice(self._ranks, first, None))

    def rank(self, lease: Lease) -> Rank:
        """Return the key by which any queue orders this request."""
        if lease.request.rank is not None:
            return (lease.request.rank, lease.request.arrival)
        return (
            lease.request.arrived_at - lease.spec.priority * self._ageing_s,
            lease.request.arrival,
        )
