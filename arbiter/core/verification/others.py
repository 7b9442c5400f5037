"""What everybody else on a card may account for, while the bytes of one lease are measured away.

A total leaves nobody out and names nobody: between a verification's baseline and a later reading others load, grow, shrink and leave.
What they may have taken must not count as missing, and what they may have left must not count as the lease's. Decides nothing.
"""

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.ledger.ledger import process_bytes
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.state import Gpu
from vram_arbiter.arbiter.core.verification.judge import Others, Verification
from vram_arbiter.schemas.ids import ProcessKey


def since_baseline(
    gpu: Gpu, verification: Verification, sample: MemorySampled, returns_s: float
) -> Others:
    """What the judge of a reading has to know of them. `returns_s`: how long given up bytes may be on their way back."""
    return Others(
        grown_bytes=_grown_by_right(gpu, verification, sample),
        left_bytes=_left_bytes(gpu, verification, sample, returns_s),
        loading_bytes=_loading_bytes(gpu, verification, sample),
    )


def _grown_by_right(gpu: Gpu, verification: Verification, sample: MemorySampled) -> int:
    """What other leaseholders may have grown since the baseline without telling: up to what they are charged."""
    baseline = verification.baseline
    if baseline is None:
        return 0
    filling: dict[ProcessKey, int] = {}
    for lease in gpu.residents.filling(baseline.taken_at):
        filling[lease.process] = filling.get(lease.process, 0) + gpu.ledger.charge_bytes(lease.id)
    if baseline.processes is None or sample.processes is None:
        return sum(count for process, count in filling.items() if process != verification.process)
    then = {use.process.pid: use.used_bytes or 0 for use in baseline.processes}
    now = {use.process.pid: use.used_bytes or 0 for use in sample.processes}
    hidden_bytes = gpu.ledger.hidden_bytes(baseline) or 0
    grown = 0
    for process, account in gpu.ledger.accounts.items():
        if process == verification.process:
            continue
        booked = account.booked_bytes()
        if process.pid in now:
            # one that came onto the list may have been on the card before, as far as somebody was whom the list left out
            before = 0 if process in filling else min(booked, hidden_bytes)
            grown += max(0, min(now[process.pid], booked) - then.get(process.pid, before))
        elif process.pid not in then:
            grown += filling.get(process, 0)
    return grown


def _left_bytes(
    gpu: Gpu, verification: Verification, sample: MemorySampled, returns_s: float
) -> int:
    """The most that others may have taken off the card since the baseline: who leaves, has left, shrinks, or is no longer listed."""
    baseline = verification.baseline
    if baseline is None:
        return 0
    leaving = {other.process for other in gpu.verifications.values()} - {verification.process}
    count = sum(gpu.ledger.filled_bytes(process) for process in leaving)
    count += sum(left for at, left in gpu.left if at > baseline.taken_at)
    count += gpu.pending_free.since(baseline.taken_at - returns_s)
    if baseline.processes is not None and sample.processes is not None:
        now = {use.process: use.used_bytes or 0 for use in sample.processes}
        count += sum(
            max(0, (use.used_bytes or 0) - now.get(use.process, 0))
            for use in baseline.processes
            if use.process.pid != verification.process.pid
        )
    return count


def _loading_bytes(gpu: Gpu, verification: Verification, sample: MemorySampled) -> int:
    """What is charged for loads under way, and is not seen to be held yet.

    Where lists say who grew, they are believed. A total alone cannot tell what comes from what has not gone.
    """
    baseline = verification.baseline
    if baseline is not None and baseline.processes is not None and sample.processes is not None:
        return 0
    count = 0
    # of one that has become ready since the reading began, it shows no more than of one that loads
    for lease in (*gpu.in_state(LeaseState.LOADING), *gpu.residents.ready_since(sample.taken_at)):
        account = gpu.ledger.accounts[lease.process]
        others = account.charged_bytes - gpu.ledger.charge_bytes(lease.id)
        held = max(others, account.residue_bytes, process_bytes(sample, lease.process) or 0)
        count += max(0, account.booked_bytes() - held)
    return count
