"""Host RAM for weights that left a card: who keeps how many bytes there, within one budget.

A holder that is asked to leave is told whether its weights may go to host RAM (`park`): the room is booked from that moment until it lets
go, so a promise given is kept. The bytes stay booked until the weights are resident again or the lease is over. Knows no cards, no order.
"""

from dataclasses import dataclass, field

from vram_arbiter.schemas.ids import LeaseId


@dataclass(slots=True)
class HostRam:
    """The budget for parked weights. 0 bytes: nobody parks."""

    budget_bytes: int
    booked: dict[LeaseId, int] = field(default_factory=dict)
    found: set[LeaseId] = field(default_factory=set)
    """Booked because it was found so after a restart, whatever the budget is now."""

    def used_bytes(self) -> int:
        return sum(self.booked.values())

    def fits(self, lease: LeaseId, count: int) -> bool:
        """Has the budget room for these bytes instead of what the lease has booked already?"""
        return self.used_bytes() - self.booked.get(lease, 0) + count <= self.budget_bytes

    def book(self, lease: LeaseId, count: int) -> bool:
        """Book the bytes if they fit. Nothing to keep is nothing to book. Says whether they are booked."""
        if not count or not self.fits(lease, count):
            return False
        self.booked[lease] = count
        self.found.discard(lease)
        return True

    def find(self, lease: LeaseId, count: int) -> None:
        """Its holder keeps these bytes whether they fit or not: the daemon was away when they came, or its budget was larger."""
        if count and lease not in self.booked:
            self.booked[lease] = count
            self.found.add(lease)

    def drop(self, lease: LeaseId) -> None:
        """Its holder keeps nothing there (any more)."""
        self.booked.pop(lease, None)
        self.found.discard(lease)

    def status(self) -> dict[str, int]:
        """Return `schemas.wire.HostRamView`."""
        return {"budget_bytes": self.budget_bytes, "parked_bytes": self.used_bytes()}

    def granted_bytes(self) -> int:
        """What was booked because it fitted: never more than the budget."""
        return sum(count for lease, count in self.booked.items() if lease not in self.found)
