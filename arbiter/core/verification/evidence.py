"""Evidence: whose bytes a reading of a GPU shows.

It names stowaways, shrinks retained bytes and shows pressure. It never frees a charge: only a
verdict does (`judge`, `schedule`). What a source can tell beside the total is derived in `ledger`
alone.
"""

from vram_arbiter.arbiter.core import learning
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.ledger import Account, bytes_of
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LEAVING, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.wire.notes import StowawayNote


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
    for use in reading.processes or ():
        held = use.used_bytes
        if held is not None and not 0 <= held <= total + tolerance_bytes:
            return f"impossible reading: process {use.process.pid} holds {held} of {total} bytes"
    return ""


def take(core: Core, gpu: Gpu, reading: MemorySampled) -> None:
    """Make a reading the newest of its GPU, and take its evidence into the ledger."""
    ledger, known = gpu.ledger, gpu.ledger.stowaways
    tolerance_bytes = core.settings.verify_tolerance_bytes
    # 1. what processes gave up since the reading before; those that leave are measured anyway
    verified = {verification.process for verification in gpu.verifications.values()}
    unloading = {lease.process for lease in gpu.in_state(LeaseState.UNLOADING)}
    gpu.pending_free.watch(gpu.sample, reading, verified | unloading, ledger.charged_to)
    # 2. the newest reading
    gpu.sample = reading
    gpu.residents.seen(reading.taken_at)
    moving = gpu.verifications or gpu.in_state(LeaseState.LOADING, *LEAVING)
    ledger.observe(
        reading,
        quiet=not moving and reading.taken_at > gpu.changed_at,
        pending_bytes=gpu.pending_free.since(reading.taken_at - core.settings.verify_timeout_s),
    )
    if reading.processes is None:
        return
    # 3. bytes per process: footprints, stowaways that are new or have grown, retained bytes
    learning.on_evidence(core, gpu)
    for use in ledger.stowaways.values():
        before = known.get(use.process)
        if before is None or use.held_bytes > before.held_bytes + tolerance_bytes:
            core.note(StowawayNote(gpu.info.id, use.process.pid, use.name, use.held_bytes))
    for account in list(ledger.accounts.values()):
        if account.charges or account.process in verified:
            continue
        lives = account.process in core.connected or not core.serving
        least_bytes = max(account.measured_bytes, account.retained_floor_bytes if lives else 0)
        shows_less = least_bytes + tolerance_bytes < account.retained_bytes
        if shows_less and reading.taken_at > account.changed_at:
            _shrink_retained(core, gpu, account, reading)


def _shrink_retained(core: Core, gpu: Gpu, account: Account, reading: MemorySampled) -> None:
    """Lower retained bytes of a process without leases to the most that a list leaves it."""
    process, floor_bytes = account.process, account.retained_floor_bytes
    held_bytes = account.measured_bytes
    if bytes_of(reading, process) is None:  # listed without its bytes
        held_bytes = reading.used_bytes
    else:
        if not held_bytes and process not in core.connected and core.serving:
            floor_bytes = 0
        if bytes_of(reading, process, omitted=None) is None:  # not listed
            unlisted_bytes = gpu.ledger.unlisted_bytes(reading)
            held_bytes = account.retained_bytes if unlisted_bytes is None else unlisted_bytes
    retained_bytes = max(floor_bytes, held_bytes)
    if retained_bytes + core.settings.verify_tolerance_bytes < account.retained_bytes:
        gpu.ledger.retain(process, retained_bytes, core.now)
        core.record_residue(gpu, process, retained_bytes)
