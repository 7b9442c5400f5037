"""What a reading of a GPU says: whose bytes it shows, and what other processes may account for.

A reading names stowaways, shrinks retained bytes, and shows pressure. It never frees a charge: only
a verdict does (`schedule`).
"""

from collections import Counter

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.ledger.ledger import Account
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.model.verification import Verification
from vram_arbiter.arbiter.core.verification.judge import Others
from vram_arbiter.schemas.ids import ProcessKey


def impossible(gpu: Gpu, reading: MemorySampled, tolerance_bytes: int) -> str:
    """Say why a reading cannot be true; "" if it can. Nonsense means unknown, never free."""
    used, total, info = reading.used_bytes, reading.total_bytes, gpu.info
    if info.total_bytes and abs(total - info.total_bytes) > tolerance_bytes:
        return (
            f"impossible reading: {total} bytes of memory, {info.total_bytes} at the start; "
            "if that is so now, restart the arbiter"
        )
    if total < info.capacity_bytes - tolerance_bytes:
        return f"impossible reading: {total} bytes of memory, {info.capacity_bytes} are leased out"
    if not 0 <= used <= total + tolerance_bytes:
        return f"impossible reading: {used} of {total} bytes are used"
    for use in reading.listed:
        if not 0 <= use.held_bytes <= total + tolerance_bytes:
            return (
                f"impossible reading: process {use.process.pid} holds {use.held_bytes} "
                f"of {total} bytes"
            )
    return ""


# -- intake --------------------------------------------------------------------------------------
def take(core: Core, gpu: Gpu, reading: MemorySampled) -> None:
    """Make a reading the newest of its GPU, and take its evidence into the ledger."""
    _watch_pending_free(gpu, reading)
    gpu.sample = reading
    gpu.residents.seen(reading.taken_at)
    known = {stranger.process: stranger.used_bytes for stranger in gpu.ledger.strangers.values()}
    gpu.ledger.observe(
        reading,
        quiet=gpu.quiet() and reading.taken_at > gpu.changed_at,
        pending_bytes=gpu.pending_free.since(reading.taken_at - core.settings.verify_timeout_s),
    )
    if reading.lists_processes:
        drift.on_evidence(core, gpu)
        _note_stowaways(core, gpu, known)
        _shrink_retained(core, gpu, reading)


def _watch_pending_free(gpu: Gpu, reading: MemorySampled) -> None:
    leaving = {verification.process for verification in gpu.verifications.values()}
    leaving.update(lease.process for lease in gpu.in_state(LeaseState.UNLOADING))
    accounts = gpu.ledger.accounts
    gpu.pending_free.watch(
        gpu.sample,
        reading,
        leaving,
        lambda process: accounts[process].booked_bytes() if process in accounts else 0,
    )


def _note_stowaways(core: Core, gpu: Gpu, known: dict[ProcessKey, int]) -> None:
    """Note stowaways that are new or have grown."""
    tolerance = core.settings.verify_tolerance_bytes
    for stranger in gpu.ledger.strangers.values():
        before = known.get(stranger.process)
        if before is None or stranger.used_bytes > before + tolerance:
            core.note(
                "stowaway",
                gpu=gpu.info.id,
                pid=stranger.process.pid,
                name=stranger.name,
                used_bytes=stranger.used_bytes,
            )


def _shrink_retained(core: Core, gpu: Gpu, reading: MemorySampled) -> None:
    """Lower retained bytes to what a list shows of processes without leases."""
    verified = {verification.process for verification in gpu.verifications.values()}
    for account in list(gpu.ledger.accounts.values()):
        process = account.process
        if account.charges or process in verified or reading.taken_at <= account.changed_at:
            continue
        retained_bytes = _retained_bytes(core, gpu, account, reading)
        if retained_bytes + core.settings.verify_tolerance_bytes < account.residue_bytes:
            gpu.ledger.set_residue(process, retained_bytes, core.now)
            core.record_residue(gpu, process, retained_bytes)


def _retained_bytes(core: Core, gpu: Gpu, account: Account, reading: MemorySampled) -> int:
    """Return the most that a process without leases may retain by this reading."""
    process, floor_bytes = account.process, account.residue_floor_bytes
    if reading.bytes_of(process) is None:  # listed without its bytes
        return max(floor_bytes, reading.used_bytes)
    held_bytes = account.measured_bytes
    if not held_bytes and process not in core.connected and core.recovering is None:
        floor_bytes = 0
    if reading.omits(process):
        unlisted_bytes = gpu.ledger.unlisted_bytes(reading)
        held_bytes = account.residue_bytes if unlisted_bytes is None else unlisted_bytes
    return max(floor_bytes, held_bytes)


def note_pressure(core: Core, gpu: Gpu) -> None:
    """Note the begin and the end of pressure."""
    pressure_bytes = gpu.ledger.pressure_bytes()
    if bool(pressure_bytes) == gpu.pressed:
        return
    gpu.pressed = bool(pressure_bytes)
    over = {process: gpu.ledger.drift_bytes(process) for process in gpu.ledger.accounts}
    tolerance = core.settings.verify_tolerance_bytes
    core.note(
        "pressure",
        gpu=gpu.info.id,
        pressure_bytes=pressure_bytes,
        stowaway_bytes=gpu.ledger.stowaway_bytes(),
        holders=[
            {"pid": process.pid, "over_bytes": count}
            for process, count in over.items()
            if count > tolerance
        ],
    )


# -- other processes -----------------------------------------------------------------------------
def others_since(
    gpu: Gpu, verification: Verification, reading: MemorySampled, pending_s: float
) -> Others:
    """Return what others may account for since the baseline.

    A total includes every process and names none. What others may have taken must not count as
    missing, and what they may have freed must not count as the lease's.

    Args:
        pending_s: How long bytes given up may be pending free.
    """
    baseline = verification.baseline
    lists = baseline is not None and baseline.lists_processes and reading.lists_processes
    loading_bytes = 0 if lists else _loading_bytes(gpu, reading)
    if baseline is None:
        return Others(loading_bytes=loading_bytes)
    process = verification.process
    left_bytes = _freed_bytes(gpu, process, baseline.taken_at, pending_s)
    if lists:
        left_bytes += _shrunk_bytes(process, baseline, reading)
        grown_bytes = _grown_by_list(gpu, process, baseline, reading)
    else:
        filling = _filling(gpu, baseline.taken_at)
        grown_bytes = filling.total() - filling[process]
    return Others(grown_bytes, left_bytes, loading_bytes)


def _filling(gpu: Gpu, since: float) -> Counter[ProcessKey]:
    """Return the charges that began to be filled after `since`, by process."""
    filling: Counter[ProcessKey] = Counter()
    for lease in gpu.residents.filling(since):
        filling[lease.process] += gpu.ledger.charge_bytes(lease.id)
    return filling


def _grown_by_list(
    gpu: Gpu, process: ProcessKey, baseline: MemorySampled, reading: MemorySampled
) -> int:
    """Return how much the other holders grew between two lists, up to their charges."""
    filling = _filling(gpu, baseline.taken_at)
    then = {use.process.pid: use.held_bytes for use in baseline.listed}
    now = {use.process.pid: use.held_bytes for use in reading.listed}
    unlisted_bytes = gpu.ledger.unlisted_bytes(baseline) or 0
    grown = 0
    for other, account in gpu.ledger.accounts.items():
        if other == process:
            continue
        if other.pid in now:
            booked = account.booked_bytes()
            # a newly listed process may have held bytes before that the list omitted
            before = 0 if other in filling else min(booked, unlisted_bytes)
            grown += max(0, min(now[other.pid], booked) - then.get(other.pid, before))
        elif other.pid not in then:
            grown += filling[other]
    return grown


def _freed_bytes(gpu: Gpu, process: ProcessKey, since: float, pending_s: float) -> int:
    """Return the most that leaving holders and pending frees may have returned after `since`."""
    leaving = {other.process for other in gpu.verifications.values()} - {process}
    count = sum(gpu.ledger.filled_bytes(other) for other in leaving)
    count += sum(left for at, left in gpu.left if at > since)
    return count + gpu.pending_free.since(since - pending_s)


def _shrunk_bytes(process: ProcessKey, baseline: MemorySampled, reading: MemorySampled) -> int:
    """Return by how much the other listed processes shrank between two lists."""
    now = {use.process: use.held_bytes for use in reading.listed}
    return sum(
        max(0, use.held_bytes - now.get(use.process, 0))
        for use in baseline.listed
        if use.process.pid != process.pid
    )


def _loading_bytes(gpu: Gpu, reading: MemorySampled) -> int:
    """Return what is charged for loads in progress and not seen yet.

    A total cannot tell bytes that arrive from bytes that have not gone.
    """
    count = 0
    # a lease that became ready after the reading began may have loaded during it
    for lease in (*gpu.in_state(LeaseState.LOADING), *gpu.residents.ready_since(reading.taken_at)):
        account = gpu.ledger.accounts[lease.process]
        other_charges = account.charged_bytes - gpu.ledger.charge_bytes(lease.id)
        shown_bytes = reading.bytes_of(lease.process) or 0
        held = max(other_charges, account.residue_bytes, shown_bytes)
        count += max(0, account.booked_bytes() - held)
    return count
