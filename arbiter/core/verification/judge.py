"""Verdict on a release from one reading. Pure: it starts nothing and changes nothing.

A released lease stays charged until a verdict. A reading is on target if all that can be checked
holds:

1. ledger bound: the GPU shows no more than everything else is charged;
2. delta bound: it shows less than the baseline by what the lease held;
3. process: the reading shows no more of the process than it may retain.

Two such readings in a row verify the release. The device total decides; bytes per process are
evidence and name the culprit. Where a list omits a living process, what the total misses is charged
to that process.
"""

from dataclasses import dataclass

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.ledger.ledger import GpuLedger
from vram_arbiter.arbiter.core.model.verification import Verdict, Verification

DYING_S = 60.0
"""Longer than any driver takes to free the memory of a dead process. Bytes still there then belong
to a process that cannot be listed."""

type Culprit = tuple[int, str, int]
"""(pid, name, bytes)"""


@dataclass(frozen=True, slots=True)
class Others:
    """What other processes on the GPU may account for (`evidence.others_since`)."""

    grown_bytes: int = 0
    """Others may have taken this since the baseline, up to what they are charged."""
    left_bytes: int = 0
    """The most that others may have freed since the baseline."""
    loading_bytes: int = 0
    """Charged for loads in progress and not yet seen. 0 where lists tell which process grew."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict. If resolved, the charge goes except for `residue_bytes`; otherwise polls go on."""

    verdict: Verdict
    resolved: bool
    residue_bytes: int
    culprits: tuple[Culprit, ...] = ()


@dataclass(frozen=True, slots=True)
class Opinion:
    """What one reading says of one verification."""

    settling: bool  # on target, and early enough: one more reading has to agree
    judgement: Judgement | None  # None: not yet


@dataclass(frozen=True, slots=True)
class _Case:
    """One reading beside what the ledger and the baseline allow it to show."""

    verification: Verification
    ledger: GpuLedger
    reading: MemorySampled
    tolerance_bytes: int
    allowed_bytes: int  # the most that the process may still hold
    held_bytes: int | None  # what the reading shows of the process; None: it cannot tell
    ledger_bound_bytes: int
    delta_bound_bytes: int | None  # None: no baseline to compare with

    def over_ledger_bytes(self) -> int:
        """Bytes by which the total exceeds the ledger bound."""
        return self.reading.used_bytes - self.ledger_bound_bytes

    def missing_bytes(self, taken_bytes: int = 0) -> int:
        """Bytes that did not return, less `taken_bytes` of the delta; negative: more returned."""
        over = self.over_ledger_bytes()
        if self.delta_bound_bytes is None:
            return over
        return max(over, self.reading.used_bytes - self.delta_bound_bytes - taken_bytes)

    def holds_too_much(self, held_bytes: int) -> bool:
        return held_bytes > self.allowed_bytes + self.tolerance_bytes

    def on_target(self) -> bool:
        if self.held_bytes is not None and self.holds_too_much(self.held_bytes):
            return False
        return self.missing_bytes() <= self.tolerance_bytes


def judge(
    verification: Verification,
    ledger: GpuLedger,
    reading: MemorySampled,
    others: Others,
    tolerance_bytes: int,
) -> Opinion:
    """Judge a reading that began after the release."""
    case = _compare(verification, ledger, reading, others, tolerance_bytes)
    if not case.on_target():
        return Opinion(False, _late(case) if verification.overdue else None)
    settling = reading.taken_at >= verification.not_before
    last = verification.last_used_bytes
    agrees = last is not None and abs(reading.used_bytes - last) <= tolerance_bytes
    verified = Judgement(Verdict.VERIFIED, True, verification.retained_bytes)
    return Opinion(settling, verified if settling and agrees else None)


# -- bounds --------------------------------------------------------------------------------------
def _compare(
    verification: Verification,
    ledger: GpuLedger,
    reading: MemorySampled,
    others: Others,
    tolerance_bytes: int,
) -> _Case:
    """Compute the bounds. Neither allows for loads in progress, whose bytes may not be there."""
    process, leaving = verification.process, verification.leaving()
    dead = verification.vanishes
    allowed = ledger.process_after_bytes(process, leaving, dead=dead)
    ledger_bound = ledger.total_after_bytes(process, leaving, dead=dead) + ledger.driver_bytes()
    ledger_bound -= others.loading_bytes
    if not verification.overdue:
        ledger_bound -= _doubtful_bytes(
            verification, ledger, reading, allowed, others.left_bytes, tolerance_bytes
        )
    delta_bound = _delta_bound(verification, ledger, allowed)
    if delta_bound is not None:
        delta_bound += others.grown_bytes - others.loading_bytes
    return _Case(
        verification,
        ledger,
        reading,
        tolerance_bytes,
        allowed,
        reading.bytes_of(process),
        ledger_bound,
        delta_bound,
    )


def _delta_bound(verification: Verification, ledger: GpuLedger, allowed_bytes: int) -> int | None:
    """Return the baseline's total less what the process must have freed; None: it cannot tell."""
    baseline = verification.baseline
    if baseline is None:
        return None
    if baseline.shows(verification.process):
        held_bytes = baseline.bytes_of(verification.process) or 0
    elif verification.baseline_comparable:
        held_bytes = _may_hold_bytes(verification, ledger, baseline)
    else:
        return None
    return baseline.used_bytes - (held_bytes - allowed_bytes)


def _doubtful_bytes(
    verification: Verification,
    ledger: GpuLedger,
    reading: MemorySampled,
    allowed_bytes: int,
    left_bytes: int,
    tolerance_bytes: int,
) -> int:
    """Return unattributed bytes in the ledger that may have left in place of the lease's.

    If more is gone than the leaving processes account for, an unlisted process freed memory too,
    and the room may be hidden bytes of the lease. A total tells only once all unattributed bytes
    are gone. Without a list, stowaways of the last list may have left as well.
    """
    unseen_bytes = ledger.stowaway_bytes() - ledger.unnamed_bytes
    if reading.lists_processes:
        unseen_bytes = 0
    baseline = verification.baseline
    if baseline is None:
        return unseen_bytes
    expected_bytes = _may_hold_bytes(verification, ledger, baseline) - allowed_bytes + left_bytes
    excess_bytes = baseline.used_bytes - reading.used_bytes - expected_bytes
    doubtful = tolerance_bytes < excess_bytes < ledger.unnamed_bytes - tolerance_bytes
    return unseen_bytes + (ledger.unnamed_bytes if doubtful else 0)


def _may_hold_bytes(verification: Verification, ledger: GpuLedger, reading: MemorySampled) -> int:
    """Return the most that a process may hold which the reading does not show."""
    unlisted = ledger.unlisted_bytes(reading)
    most = reading.used_bytes if unlisted is None else unlisted
    return min(ledger.filled_bytes(verification.process), most)


# -- after the deadline --------------------------------------------------------------------------
def _late(case: _Case) -> Judgement:
    """Name the holder of the missing bytes, as far as the source can tell."""
    verification, held = case.verification, case.held_bytes
    if held is None:
        return _late_by_total(case)
    if case.holds_too_much(held):
        culprits = ((verification.process.pid, _name_of(case), held),)
        if verification.alive:
            return _residue(case, held, culprits)
        return Judgement(Verdict.CONTESTED, False, held, culprits)
    missing = case.missing_bytes(_taken_bytes(case))
    if verification.alive and not case.reading.shows(verification.process):
        stays = _may_hold_bytes(verification, case.ledger, case.reading)
        if case.delta_bound_bytes is not None:
            stays = min(stays, case.allowed_bytes + missing)
        if case.holds_too_much(stays):
            return _residue(case, stays)
    # a driver may omit a dying process before it has freed its memory
    dying = not verification.alive and case.reading.taken_at < verification.deadline_at + DYING_S
    resolved = not dying or missing <= case.tolerance_bytes
    return Judgement(Verdict.CONTESTED, resolved, verification.retained_bytes, _grown(case))


def _late_by_total(case: _Case) -> Judgement:
    """Judge by the total alone: the reading does not tell what the process holds."""
    verification = case.verification
    if case.delta_bound_bytes is None:
        return Judgement(Verdict.UNVERIFIABLE, False, verification.retained_bytes)
    if verification.alive:
        return _residue(case, case.allowed_bytes + case.missing_bytes())
    # a dead process frees everything: if the ledger explains the total, the rest is of others
    return Judgement(Verdict.CONTESTED, case.over_ledger_bytes() <= case.tolerance_bytes, 0)


def _residue(case: _Case, stays_bytes: int, culprits: tuple[Culprit, ...] = ()) -> Judgement:
    """A living process keeps too much. Until it has fenced itself its lease is in force for it."""
    fenced = case.reading.taken_at >= case.verification.fenced_at
    return Judgement(Verdict.RESIDUE, fenced, stays_bytes, culprits)


def _name_of(case: _Case) -> str:
    pid = case.verification.process.pid
    uses = (use for use in case.reading.listed if use.process.pid == pid)
    return next((use.name for use in uses), case.verification.consumer)


def _taken_bytes(case: _Case) -> int:
    """Return what others visibly took since the baseline beyond their charges."""
    baseline = case.verification.baseline
    if baseline is None:
        return 0
    taken = 0
    for use in case.reading.listed:
        if use.process.pid != case.verification.process.pid:
            explained = max(baseline.bytes_of(use.process) or 0, case.ledger.booked_by(use.process))
            taken += max(0, use.held_bytes - explained)
    return taken


def _grown(case: _Case) -> tuple[Culprit, ...]:
    """Return the other processes that grew since the baseline, largest growth first.

    Without a baseline: stowaways.
    """
    baseline = case.verification.baseline
    grown: list[Culprit] = []
    for use in case.reading.listed:
        if use.process.pid == case.verification.process.pid:
            continue
        if baseline is None and use.process not in case.ledger.strangers:
            continue
        before = 0 if baseline is None else baseline.bytes_of(use.process) or 0
        if use.held_bytes > before:
            grown.append((use.process.pid, use.name, use.held_bytes - before))
    return tuple(sorted(grown, key=lambda item: (-item[2], item[0])))
