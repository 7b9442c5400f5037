"""Did the memory really come back? Pure judgement of readings; starts nothing, drops nothing.

A released lease stays charged until a verdict. Targets (all that can be checked must hold, twice in a row):
  a. ledger bound: the card shows no more than everything else is charged;
  b. delta bound: it shows less than before by what the lease held;
  c. evidence: its process shows no more than it may keep.
The device total decides; per-process figures are evidence and name the culprit. No reading means unknown, never free, and so does
a list that leaves a living process out: what such a one did not give back by the total is charged to it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.ledger.ledger import GpuLedger, is_hidden, process_bytes
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

DYING_S = 60.0
"""Longer than any driver takes to free what a dead process held; what is still there then belongs to somebody who cannot be listed."""


class Verdict(StrEnum):
    VERIFIED = "verified"
    RESIDUE = "residue"
    CONTESTED = "contested"
    STALE = "stale"
    UNVERIFIABLE = "unverifiable"


@dataclass(frozen=True, slots=True)
class Judgement:
    """`resolved`: the charge may go, but for `residue_bytes`. Otherwise the bytes stay charged and the polling goes on."""

    verdict: Verdict
    resolved: bool
    residue_bytes: int
    culprits: tuple[tuple[int, str, int], ...] = ()  # (pid, name, bytes)


@dataclass(slots=True)
class Verification:
    """One release, expiry or death under measurement."""

    key: str
    process: ProcessKey
    lease: LeaseId | None  # None: only a residue of a dead process
    consumer: str
    model: str  # under which name its footprint is learnt
    residue_bytes: int  # what may stay while the process lives
    baseline: MemorySampled | None  # newest reading in which the bytes were still there
    baseline_comparable: bool  # the lease was resident and ready when it was taken
    confirmed_at: float  # only readings that began later count
    not_before: (
        float  # no verdict earlier: a lost holder may still be loading until it fences itself
    )
    deadline_at: float
    paced_from: (
        float  # since when the memory may come back: the readings are dense first, then rarer
    )
    next_poll_at: float = 0.0
    settling: bool = False  # the newest reading is on target: one more has to agree
    alive: bool = True
    exiting: bool = False
    exclusive: bool = False  # nobody else may come before these bytes are gone, whatever would fit
    # until then a living holder may believe in its lease: what it keeps is no mere residue
    fenced_at: float = 0.0
    last_used_bytes: int | None = None  # of the newest counting reading
    verdict: Verdict | None = None  # announced, but not resolved
    overdue: bool = False

    @property
    def vanishes(self) -> bool:
        """The process is dead or promised to be: nothing may stay."""
        return self.exiting or not self.alive

    @property
    def kept_bytes(self) -> int:
        return 0 if self.vanishes else self.residue_bytes

    def going(self) -> Mapping[LeaseId, int]:
        """The lease on its way out and what it leaves behind, as the ledger wants it."""
        return {} if self.lease is None else {self.lease: self.kept_bytes}


@dataclass(frozen=True, slots=True)
class Others:
    """What everybody else on the card may account for in a reading (`others.since_baseline`)."""

    grown_bytes: int
    """They may have taken so much since the baseline, by right: up to what they are charged. From the lists of both readings; where one
    has no list, from the charges that began to be filled since. 0 without a baseline."""
    left_bytes: int
    """The most that may have gone from the card since the baseline with those of them who leave, have left, shrink, or are no longer
    listed. 0 without a baseline."""
    loading_bytes: int
    """Charged for loads under way, and not seen to be there yet. 0 where lists say who grew."""


@dataclass(frozen=True, slots=True)
class _Comparison:
    """A reading beside the three targets that stand at the head of this file."""

    used_bytes: int  # the card's total in the reading
    ledger_bound_bytes: int  # a.
    delta_bound_bytes: int | None  # b.; None: there is nothing to compare with
    held_bytes: int | None  # what the reading shows of the process; None: it cannot say
    expected_bytes: int  # c.: the most that this may be

    def short_bytes(self) -> int:
        """What did not come back; below 0: more came back than had to."""
        short_bytes = self.used_bytes - self.ledger_bound_bytes
        if self.delta_bound_bytes is not None:
            short_bytes = max(short_bytes, self.used_bytes - self.delta_bound_bytes)
        return short_bytes

    def on_target(self, tolerance_bytes: int) -> bool:
        """Does all that can be checked hold?"""
        evident = (
            self.held_bytes is None or self.held_bytes <= self.expected_bytes + tolerance_bytes
        )
        return evident and self.short_bytes() <= tolerance_bytes


def judge(
    v: Verification, ledger: GpuLedger, sample: MemorySampled, others: Others, tolerance_bytes: int
) -> Judgement | None:
    """Judge a counting reading, and remember it for the one that has to agree. None: not yet."""
    found = _compare(v, ledger, sample, others, tolerance_bytes)
    stable = (
        v.last_used_bytes is not None
        and abs(found.used_bytes - v.last_used_bytes) <= tolerance_bytes
    )
    v.last_used_bytes = found.used_bytes
    on_target = found.on_target(tolerance_bytes)
    v.settling = on_target and sample.taken_at >= v.not_before
    if on_target:
        return Judgement(Verdict.VERIFIED, True, v.kept_bytes) if stable and v.settling else None
    return _late(v, ledger, sample, found, tolerance_bytes) if v.overdue else None


# -- what a reading should show ----------------------------------------------------------------------------------------
def _compare(
    v: Verification, ledger: GpuLedger, sample: MemorySampled, others: Others, tolerance_bytes: int
) -> _Comparison:
    """Loads under way hide nothing: neither bound allows for bytes that may not have come yet."""
    expected = ledger.process_after_bytes(v.process, v.going(), dead=v.vanishes)
    ledger_bound = (
        ledger.total_after_bytes(v.process, v.going(), dead=v.vanishes) + ledger.driver_bytes()
    )
    ledger_bound -= others.loading_bytes
    ledger_bound -= _doubtful_bytes(v, ledger, sample, expected, others.left_bytes, tolerance_bytes)
    delta_bound = _delta_bound(v, ledger, expected)
    if delta_bound is not None:
        delta_bound += others.grown_bytes - others.loading_bytes
    held = process_bytes(sample, v.process)
    return _Comparison(sample.used_bytes, ledger_bound, delta_bound, held, expected)


def _delta_bound(v: Verification, ledger: GpuLedger, expected: int) -> int | None:
    """What the baseline showed, less what the process held then and should not any more. None: no baseline can tell."""
    if v.baseline is None:
        return None
    held_then = process_bytes(v.baseline, v.process)
    if held_then is None or is_hidden(v.baseline, v.process):
        if not v.baseline_comparable:
            return None
        held_then = _may_hold(v, ledger, v.baseline)
    return v.baseline.used_bytes - (held_then - expected)


def _doubtful_bytes(
    v: Verification,
    ledger: GpuLedger,
    sample: MemorySampled,
    expected: int,
    left_bytes: int,
    tolerance_bytes: int,
) -> int:
    """Bytes in nobody's list that the ledger still allows for, and that may have left in place of the lease's.

    More is gone than everybody who leaves accounts for, so somebody unnamed went too, and what he left room for may be the lease's. A total
    cannot tell, unless all of the unnamed is gone. Nor can it tell what stowaways of the last list did that no list shows any more. Once
    the time is up this doubt alone keeps nobody waiting.
    """
    if v.overdue:
        return 0
    unseen_bytes = ledger.stowaway_bytes() - ledger.unnamed_bytes if sample.processes is None else 0
    if v.baseline is None:
        return unseen_bytes
    leaves_bytes = _may_hold(v, ledger, v.baseline) - expected + left_bytes
    excess_bytes = v.baseline.used_bytes - sample.used_bytes - leaves_bytes
    unnamed_bytes = ledger.unnamed_bytes
    doubtful = tolerance_bytes < excess_bytes < unnamed_bytes - tolerance_bytes
    return unseen_bytes + (unnamed_bytes if doubtful else 0)


def _may_hold(v: Verification, ledger: GpuLedger, sample: MemorySampled) -> int:
    """A process that the reading does not name: what it is charged, as far as the total has bytes that nobody in the list explains."""
    hidden = ledger.hidden_bytes(sample)
    return min(ledger.filled_bytes(v.process), sample.used_bytes if hidden is None else hidden)


# -- the time is up ------------------------------------------------------------------------------------------------------
def _late(
    v: Verification,
    ledger: GpuLedger,
    sample: MemorySampled,
    found: _Comparison,
    tolerance_bytes: int,
) -> Judgement:
    """Say whose bytes these are, as far as this backend can tell."""
    held = found.held_bytes
    if held is None:
        return _late_by_total(v, sample, found, tolerance_bytes)
    if held > found.expected_bytes + tolerance_bytes:
        name = next(
            (use.name for use in sample.processes or () if use.process.pid == v.process.pid),
            v.consumer,
        )
        culprits = ((v.process.pid, name, held),)
        if v.alive:
            return _residue(v, sample, held, culprits)
        return Judgement(Verdict.CONTESTED, False, held, culprits)
    missing = _missing_bytes(v, ledger, sample, found)
    if v.alive and is_hidden(sample, v.process):
        stays = _may_hold(v, ledger, sample)
        if found.delta_bound_bytes is not None:
            stays = min(stays, found.expected_bytes + missing)
        if stays > found.expected_bytes + tolerance_bytes:
            return _residue(v, sample, stays)
    # a driver leaves a dying process out of its list before it has freed its bytes: what nobody has taken may be on its way still
    freeing = not v.alive and sample.taken_at < v.deadline_at + DYING_S
    resolved = not freeing or missing <= tolerance_bytes
    return Judgement(Verdict.CONTESTED, resolved, v.kept_bytes, _grown_since(v, ledger, sample))


def _late_by_total(
    v: Verification, sample: MemorySampled, found: _Comparison, tolerance_bytes: int
) -> Judgement:
    """The reading names nobody: only the total can tell."""
    if found.delta_bound_bytes is None:
        return Judgement(Verdict.UNVERIFIABLE, False, v.kept_bytes)
    if v.alive:
        return _residue(v, sample, found.expected_bytes + found.short_bytes())
    # a dead process holds nothing for ever: if the ledger explains the card, what is left belongs to others
    return Judgement(
        Verdict.CONTESTED, found.used_bytes <= found.ledger_bound_bytes + tolerance_bytes, 0
    )


def _residue(
    v: Verification,
    sample: MemorySampled,
    stays: int,
    culprits: tuple[tuple[int, str, int], ...] = (),
) -> Judgement:
    """A living process keeps more than it may. Until it has fenced itself these bytes are not left over: its lease is still in force for it."""
    return Judgement(Verdict.RESIDUE, sample.taken_at >= v.fenced_at, stays, culprits)


def _missing_bytes(
    v: Verification, ledger: GpuLedger, sample: MemorySampled, found: _Comparison
) -> int:
    """What did not come back, less what others visibly took beyond what they are charged; up to that they may grow, and were allowed for."""
    if found.delta_bound_bytes is None or v.baseline is None:
        return found.used_bytes - found.ledger_bound_bytes
    taken = 0
    for use in sample.processes or ():
        if use.process.pid != v.process.pid:
            then = process_bytes(v.baseline, use.process) or 0
            taken += max(0, (use.used_bytes or 0) - max(then, ledger.booked_by(use.process)))
    return max(
        found.used_bytes - found.ledger_bound_bytes,
        found.used_bytes - found.delta_bound_bytes - taken,
    )


def _grown_since(
    v: Verification, ledger: GpuLedger, sample: MemorySampled
) -> tuple[tuple[int, str, int], ...]:
    """Others that hold more than at the baseline, the largest first: (pid, name, bytes grown)."""
    grown: list[tuple[int, str, int]] = []
    for use in sample.processes or ():
        if use.process.pid == v.process.pid or not use.used_bytes:
            continue
        then = (process_bytes(v.baseline, use.process) or 0) if v.baseline is not None else 0
        if use.used_bytes > then and (v.baseline is not None or use.process in ledger.strangers):
            grown.append((use.process.pid, use.name, use.used_bytes - then))
    return tuple(sorted(grown, key=lambda item: (-item[2], item[0])))
