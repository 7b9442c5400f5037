"""Verdict: whether a reading shows that the bytes of a release are back.

A released lease stays charged until a verdict. A reading is on target if all that can be checked
holds:

1. process: the reading shows no more of the process than it may retain;
2. ledger bound: the GPU shows no more than everything else is charged;
3. delta bound: it shows less than the baseline by what the lease held.

Two such readings in a row verify the release. The device total decides; bytes per process are
evidence and name the culprit. Where a list omits a living process, what the total misses is charged
to that process. Pure: it starts nothing and changes nothing.
"""

from collections import Counter
from dataclasses import dataclass

from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.core.ledger import GpuLedger, bytes_by_process, bytes_of
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LeaseState, Verdict, Verification
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.wire.notes import Culprit

DYING_S = 60.0
"""Longer than any driver takes to free the memory of a dead process. Bytes still there then belong
to a process that cannot be listed."""


# -- other processes -------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Others:
    """What other processes on the GPU may account for since the baseline.

    A total includes every process and names none. What others may have taken must not count as
    missing, and what they may have freed must not count as the lease's.
    """

    grown_bytes: int = 0
    """Others may have taken this since the baseline, up to what they are charged."""
    left_bytes: int = 0
    """The most that others may have freed since the baseline."""
    loading_bytes: int = 0
    """Charged for loads in progress and not yet seen. 0 where lists tell which process grew."""


def others_since(
    gpu: Gpu, verification: Verification, reading: MemorySampled, pending_s: float
) -> Others:
    """Return what others may account for. Bytes given up may be pending free for `pending_s`."""
    baseline, process = verification.baseline, verification.process
    lists = baseline is not None and None not in (baseline.processes, reading.processes)
    loading_bytes = 0 if lists else _loading_bytes(gpu, reading)
    if baseline is None:
        return Others(loading_bytes=loading_bytes)
    # 1. leaving holders, verdicts since the baseline, and what is pending free
    leaving = {other.process for other in gpu.verifications.values()} - {process}
    accounts = gpu.ledger.accounts
    left_bytes = sum([accounts[other].charged_bytes for other in leaving if other in accounts])
    left_bytes += sum([left for at, left in gpu.left if at > baseline.taken_at])
    left_bytes += gpu.pending_free.since(baseline.taken_at - pending_s)
    # 2. charges of loads that began since the baseline
    loaded: Counter[ProcessKey] = Counter()
    for lease in gpu.residents.filling(baseline.taken_at):
        loaded[lease.process] += gpu.ledger.charge_bytes(lease.id)
    if not lists:
        return Others(loaded.total() - loaded[process], left_bytes, loading_bytes)
    grown_bytes, shrunk_bytes = _between_lists(gpu.ledger, process, baseline, reading, loaded)
    return Others(grown_bytes, left_bytes + shrunk_bytes)


def _between_lists(
    ledger: GpuLedger,
    process: ProcessKey,
    baseline: MemorySampled,
    reading: MemorySampled,
    loaded: Counter[ProcessKey],
) -> tuple[int, int]:
    """Return how much the other holders grew between two lists, up to their charges, and by how
    much the other listed processes shrank."""
    held_then, held_now = bytes_by_process(baseline), bytes_by_process(reading)
    shrunk_bytes = sum(
        max(0, held - held_now.get(other, 0))
        for other, held in held_then.items()
        if other.pid != process.pid
    )
    then = {other.pid: held for other, held in held_then.items()}
    now = {other.pid: held for other, held in held_now.items()}
    grown_bytes = 0
    for other, account in ledger.accounts.items():
        if other == process:
            continue
        if other.pid in now:
            before = then.get(other.pid)
            if before is None:  # it may have held bytes that the list omitted
                hidden_bytes = ledger.unlisted_bytes(baseline) or 0
                before = 0 if other in loaded else min(account.charged_bytes, hidden_bytes)
            grown_bytes += max(0, min(now[other.pid], account.charged_bytes) - before)
        elif other.pid not in then:
            grown_bytes += loaded[other]
    return grown_bytes, shrunk_bytes


def _loading_bytes(gpu: Gpu, reading: MemorySampled) -> int:
    """Return what is charged for loads in progress and not seen yet.

    A total cannot tell bytes that arrive from bytes that have not gone. A lease that became ready
    after the reading began may have loaded during it, also where it has left or was lost since.
    """
    count, at = 0, reading.taken_at
    for debt in gpu.verifications.values():
        if debt.lease is not None and debt.lease not in gpu.residents and debt.confirmed_at >= at:
            count += gpu.ledger.charge_bytes(debt.lease)
    for lease in (*gpu.in_state(LeaseState.LOADING), *gpu.residents.loaded_since(at)):
        account = gpu.ledger.accounts[lease.process]
        other_charges = account.leased_bytes - gpu.ledger.charge_bytes(lease.id)
        shown_bytes = bytes_of(reading, lease.process) or 0
        held = max(other_charges, account.retained_bytes, shown_bytes)
        count += max(0, account.charged_bytes - held)
    return count


# -- the verdict -----------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict. If resolved, the charge goes except for `residue_bytes`; otherwise polls go on.

    `VERIFIED` and not resolved: the reading is on target, and one more has to agree.
    """

    verdict: Verdict
    resolved: bool
    residue_bytes: int
    culprits: tuple[Culprit, ...] = ()


@dataclass(frozen=True, slots=True)
class _Case:
    """One reading beside what the ledger and the baseline allow it to show."""

    verification: Verification
    ledger: GpuLedger
    reading: MemorySampled
    allowed_bytes: int  # the most that the process may still hold
    held_bytes: int | None  # what the reading shows of the process; None: it cannot tell
    limit_bytes: int  # what is above it is too much for the process
    over_ledger_bytes: int  # bytes by which the total exceeds the ledger bound
    over_baseline_bytes: int | None  # the delta bound; None: no baseline to compare with

    def others(self) -> list[ProcessUse]:
        """The listed processes other than the one that released."""
        pid = self.verification.process.pid
        return [use for use in self.reading.processes or () if use.process.pid != pid]

    def missing_bytes(self, taken_bytes: int = 0) -> int:
        """Bytes that did not return, less `taken_bytes` of the delta; negative: more returned."""
        if self.over_baseline_bytes is None:
            return self.over_ledger_bytes
        return max(self.over_ledger_bytes, self.over_baseline_bytes - taken_bytes)


def judge(
    verification: Verification,
    ledger: GpuLedger,
    reading: MemorySampled,
    others: Others,
) -> Judgement | None:
    """Judge a reading that began after the release. Return None where it says nothing yet."""
    case = _compare(verification, ledger, reading, others)
    held = case.held_bytes
    if (
        held is not None and held > case.limit_bytes
    ) or case.missing_bytes() > ledger.tolerance_bytes:
        return _late(case) if verification.overdue else None
    if reading.taken_at < verification.not_before:
        return None
    last = verification.last_used_bytes
    agrees = last is not None and abs(reading.used_bytes - last) <= ledger.tolerance_bytes
    return Judgement(Verdict.VERIFIED, agrees, verification.retained_bytes)


def _compare(
    verification: Verification,
    ledger: GpuLedger,
    reading: MemorySampled,
    others: Others,
) -> _Case:
    """Compute the bounds. Neither allows for loads in progress, whose bytes may not be there."""
    process, baseline, used_bytes = verification.process, verification.baseline, reading.used_bytes
    # 1. process
    going = {} if verification.lease is None else {verification.lease: verification.retained_bytes}
    allowed_bytes, total_bytes = ledger.after_bytes(process, going, dead=verification.vanishes)
    # 2. ledger bound
    ledger_bound = total_bytes + ledger.driver_bytes - others.loading_bytes
    if ledger.stowaway_bytes and not verification.overdue:
        returning_bytes = others.left_bytes - allowed_bytes
        ledger_bound -= _doubtful_bytes(verification, ledger, reading, returning_bytes)
    # 3. delta bound: the baseline's total less what the process must have freed
    over_baseline = None
    held_before = None if baseline is None else bytes_of(baseline, process, omitted=None)
    if baseline is not None and held_before is None and verification.baseline_comparable:
        held_before = _may_hold_bytes(verification, ledger, baseline)
    if baseline is not None and held_before is not None:
        delta_bound = baseline.used_bytes - (held_before - allowed_bytes)
        over_baseline = used_bytes - delta_bound - others.grown_bytes + others.loading_bytes
    return _Case(
        verification,
        ledger,
        reading,
        allowed_bytes,
        bytes_of(reading, process),
        allowed_bytes + ledger.tolerance_bytes,
        used_bytes - ledger_bound,
        over_baseline,
    )


def _doubtful_bytes(
    verification: Verification,
    ledger: GpuLedger,
    reading: MemorySampled,
    returning_bytes: int,
) -> int:
    """Return unattributed bytes in the ledger that may have left in place of the lease's.

    If more is gone than the leaving processes account for (`returning_bytes` and what the process
    held), an unlisted process freed memory too, and the room may be hidden bytes of the lease. A
    total tells only once all unattributed bytes are gone. Without a list, stowaways of the last
    list may have left as well.
    """
    unattributed_bytes, baseline = ledger.unattributed_bytes, verification.baseline
    unseen_bytes = (
        0 if reading.processes is not None else ledger.stowaway_bytes - unattributed_bytes
    )
    if baseline is None:
        return unseen_bytes
    expected_bytes = _may_hold_bytes(verification, ledger, baseline) + returning_bytes
    excess_bytes = baseline.used_bytes - reading.used_bytes - expected_bytes
    doubtful = ledger.tolerance_bytes < excess_bytes < unattributed_bytes - ledger.tolerance_bytes
    return unseen_bytes + (unattributed_bytes if doubtful else 0)


def _may_hold_bytes(verification: Verification, ledger: GpuLedger, reading: MemorySampled) -> int:
    """Return the most that a process may hold which the reading does not show."""
    unlisted = ledger.unlisted_bytes(reading)
    most = reading.used_bytes if unlisted is None else unlisted
    account = ledger.accounts.get(verification.process)
    return 0 if account is None else min(account.charged_bytes, most)


# -- after the deadline ----------------------------------------------------------------------------
def _late(case: _Case) -> Judgement:
    """Name the holder of the missing bytes, as far as the source can tell."""
    verification, reading, held = case.verification, case.reading, case.held_bytes
    if held is None:
        return _late_by_total(case)
    process = verification.process
    if held > case.limit_bytes:
        own = (use.name for use in reading.processes or () if use.process.pid == process.pid)
        culprits = (Culprit(process.pid, next(own, verification.consumer), held),)
        if verification.alive:
            return _residue(case, held, culprits)
        return Judgement(Verdict.CONTESTED, False, held, culprits)
    missing = case.missing_bytes(_taken_bytes(case))
    if verification.alive and bytes_of(reading, process, omitted=None) is None:
        stays = _may_hold_bytes(verification, case.ledger, reading)
        if case.over_baseline_bytes is not None:
            stays = min(stays, case.allowed_bytes + missing)
        if stays > case.limit_bytes:
            return _residue(case, stays)
    # a driver may omit a dying process before it has freed its memory
    dying = not verification.alive and reading.taken_at < verification.deadline_at + DYING_S
    resolved = not dying or missing <= case.ledger.tolerance_bytes
    return Judgement(Verdict.CONTESTED, resolved, verification.retained_bytes, _grown(case))


def _late_by_total(case: _Case) -> Judgement:
    """Judge by the total alone: the reading does not tell what the process holds."""
    verification = case.verification
    if case.over_baseline_bytes is None:
        return Judgement(Verdict.UNVERIFIABLE, False, verification.retained_bytes)
    if verification.alive:
        return _residue(case, case.allowed_bytes + case.missing_bytes())
    # a dead process frees everything: if the ledger explains the total, the rest is of others
    return Judgement(Verdict.CONTESTED, case.over_ledger_bytes <= case.ledger.tolerance_bytes, 0)


def _residue(case: _Case, stays_bytes: int, culprits: tuple[Culprit, ...] = ()) -> Judgement:
    """A living process keeps too much. Until it has fenced itself its lease is in force for it."""
    fenced = case.reading.taken_at >= case.verification.fenced_at
    return Judgement(Verdict.RESIDUE, fenced, stays_bytes, culprits)


def _taken_bytes(case: _Case) -> int:
    """Return what others visibly took since the baseline beyond their charges."""
    baseline = case.verification.baseline
    if baseline is None:
        return 0
    taken = 0
    for use in case.others():
        explained = max(bytes_of(baseline, use.process) or 0, case.ledger.charged_to(use.process))
        taken += max(0, use.held_bytes - explained)
    return taken


def _grown(case: _Case) -> tuple[Culprit, ...]:
    """Return the other processes that grew since the baseline, largest growth first.

    Without a baseline: stowaways.
    """
    baseline = case.verification.baseline
    grown: list[Culprit] = []
    for use in case.others():
        if baseline is None and use.process not in case.ledger.stowaways:
            continue
        before = 0 if baseline is None else bytes_of(baseline, use.process) or 0
        if use.held_bytes > before:
            grown.append(Culprit(use.process.pid, use.name, use.held_bytes - before))
    return tuple(sorted(grown, key=lambda culprit: (-culprit.bytes, culprit.pid)))
