"""Record of a verification: did the memory of one release, expiry or death return?"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.schemas.ids import LeaseId, ProcessKey


class Verdict(StrEnum):
    """Outcome of a verification, in the words of the wire."""

    VERIFIED = "verified"
    RESIDUE = "residue"
    CONTESTED = "contested"
    STALE = "stale"
    UNVERIFIABLE = "unverifiable"


@dataclass(slots=True)
class Verification:
    """A lease, or retained bytes of a dead process, under measurement. Times are monotonic."""

    key: str
    process: ProcessKey
    lease: LeaseId | None  # None: retained bytes of a dead process
    consumer: str
    model: str  # name under which its footprint is learned
    residue_bytes: int  # may stay while the process lives
    baseline: MemorySampled | None  # newest reading in which the bytes were still there
    baseline_comparable: bool  # the lease was resident and ready when the baseline was taken
    confirmed_at: float  # only readings that began later count
    not_before: float  # no verdict earlier: a lost holder may load until it fences itself
    deadline_at: float
    paced_from: float  # since when the memory may return: polls are dense first, then rarer
    next_poll_at: float = 0.0
    settling: bool = False  # the newest reading is on target: one more has to agree
    alive: bool = True
    exiting: bool = False
    exclusive: bool = False  # no grant before these bytes are gone, even if it would fit
    fenced_at: float = 0.0  # until then a living holder may use its lease
    last_used_bytes: int | None = None  # of the newest counting reading
    verdict: Verdict | None = None  # announced, but not resolved
    overdue: bool = False

    @property
    def vanishes(self) -> bool:
        """Whether the process is dead or about to exit, so that nothing may stay."""
        return self.exiting or not self.alive

    @property
    def retained_bytes(self) -> int:
        """Bytes that the process may retain."""
        return 0 if self.vanishes else self.residue_bytes

    def leaving(self) -> Mapping[LeaseId, int]:
        """Return the leaving lease with the bytes that it may retain, as the ledger takes it."""
        return {} if self.lease is None else {self.lease: self.retained_bytes}
