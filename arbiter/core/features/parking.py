"""Host RAM for parked weights: how many bytes each lease keeps there, within one budget.

The bytes of a revoked lease are booked from the moment that its holder is told that it may park, so
that the promise is kept, until the weights are resident again or the lease is over.
"""

from dataclasses import dataclass, field

from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.views import HostRamView


@dataclass(slots=True)
class HostRam:
    """The budget for parked weights. 0 bytes: nothing is parked."""

    budget_bytes: int
    booked: dict[LeaseId, int] = field(default_factory=dict)
    found: set[LeaseId] = field(default_factory=set)
    """Booked as found after a restart, whatever the budget is now."""

    def used_bytes(self) -> int:
        return sum(self.booked.values())

    def fits(self, lease: LeaseId, count: int) -> bool:
        """Return whether the budget has room for these bytes in place of the lease's own."""
        return self.used_bytes() - self.booked.get(lease, 0) + count <= self.budget_bytes

    def book(self, lease: LeaseId, count: int) -> bool:
        """Book bytes if there are any and they fit. Return whether they are booked."""
        if not count or not self.fits(lease, count):
            return False
        self.booked[lease] = count
        self.found.discard(lease)
        return True

    def find(self, lease: LeaseId, count: int) -> None:
        """Book what a holder keeps after a restart, fitting or not: the budget may differ."""
        if count and lease not in self.booked:
            self.booked[lease] = count
            self.found.add(lease)

    def drop(self, lease: LeaseId) -> None:
        """Free the bytes of a lease."""
        self.booked.pop(lease, None)
        self.found.discard(lease)

    def status(self) -> HostRamView:
        """The budget and what is booked of it."""
        return HostRamView(self.budget_bytes, self.used_bytes())

    def granted_bytes(self) -> int:
        """Return what was booked because it fitted: never more than the budget."""
        return sum(count for lease, count in self.booked.items() if lease not in self.found)
