"""What a reading of a card says: whose bytes are there, stowaways, residues that shrank, pressure.

Takes the evidence into the ledger and hands the reading on to the verifications under way (`measure`). A failed reading is *unknown*: it
frees nothing.
"""

from vram_arbiter.arbiter.core.events import MemorySampled, ProbeFailed
from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.ledger.ledger import is_hidden, process_bytes
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas.ids import GpuId, ProcessKey


def on_sample(core: Core, sample: MemorySampled) -> None:
    """A reading arrived. One older than the newest or from before a suspend is dropped; one of an unknown card too. One that cannot be true
    is a failed one."""
    gpu = core.gpus.get(sample.gpu)
    if gpu is None or sample.taken_at < gpu.read_from:
        return
    if gpu.sample is not None and sample.taken_at < gpu.sample.taken_at:
        return
    if problem := _impossible(core, gpu, sample):
        on_probe_failed(core, ProbeFailed(sample.gpu, sample.taken_at, problem))
        return
    if gpu.asked_at is not None and sample.taken_at >= gpu.asked_at:
        gpu.asked_at = None
    _watch_returning(gpu, sample)
    gpu.sample = sample
    gpu.residents.seen(sample.taken_at)
    gpu.reading_s = max(0.0, core.now - sample.taken_at)
    answers_again = gpu.failed_at is not None
    if answers_again:
        gpu.failed_at, gpu.failure = None, ""
        core.note("probe_ok", gpu=gpu.info.id)
    known = {stranger.process: stranger.used_bytes for stranger in gpu.ledger.strangers.values()}
    gpu.ledger.observe(
        sample,
        quiet=gpu.quiet() and sample.taken_at > gpu.changed_at,
        returning_bytes=gpu.pending_free.since(sample.taken_at - core.settings.verify_timeout_s),
    )
    if sample.processes is not None:
        drift.on_evidence(core, gpu)
        _note_stowaways(core, gpu, known)
    _shrink_residues(core, gpu, sample)
    schedule.on_reading(core, gpu, sample, answers_again=answers_again)
    note_pressure(core, gpu)
    core.wake(gpu)
    for feature in core.features:
        feature.on_sample(core, gpu, sample)


def _impossible(core: Core, gpu: Gpu, sample: MemorySampled) -> str:
    """Why a reading cannot be true; "" if it can. A driver that answers nonsense knows nothing: its GPU is unknown, not free."""
    tolerance = core.settings.verify_tolerance_bytes
    used, total, info = sample.used_bytes, sample.total_bytes, gpu.info
    if info.total_bytes and abs(total - info.total_bytes) > tolerance:
        return f"impossible reading: {total} bytes of memory, {info.total_bytes} at the start; if that is so now, restart the arbiter"
    if total < info.capacity_bytes - tolerance:
        return f"impossible reading: {total} bytes of memory, {info.capacity_bytes} are leased out"
    if not 0 <= used <= total + tolerance:
        return f"impossible reading: {used} of {total} bytes are used"
    for use in sample.processes or ():
        if use.used_bytes is not None and not 0 <= use.used_bytes <= total + tolerance:
            return f"impossible reading: process {use.process.pid} holds {use.used_bytes} of {total} bytes"
    return ""


def on_probe_failed(core: Core, event: ProbeFailed) -> None:
    """Unknown. Grants stop until a good reading comes; said once per outage."""
    gpu = core.gpus.get(event.gpu)
    if gpu is None:
        return
    gpu.asked_at = None
    if gpu.failed_at is None:
        core.note("probe_failed", gpu=event.gpu, reason=event.reason)
    gpu.failed_at, gpu.failure = event.at, event.reason
    core.wake(gpu)


def on_probe_due(core: Core, gpu_id: str) -> None:
    """Time for a background reading; `handle` sets the next one while anybody is interested."""
    gpu = core.gpus[GpuId(gpu_id)]
    gpu.asked_at = None  # a reading that never came must not silence the next one
    core.want_sample(gpu, core.now)
    core.wake(gpu)  # an old sample no longer carries a grant


def stale(core: Core) -> list[GpuId]:
    """Return the GPUs whose newest reading, successful or not, is older than one that may gate a grant."""
    oldest = core.now - core.settings.sample_max_age_s
    return [
        gpu.info.id
        for gpu in core.gpus.values()
        if (gpu.sample is None or gpu.sample.taken_at < oldest)
        and (gpu.failed_at is None or gpu.failed_at < oldest)
    ]


def note_pressure(core: Core, gpu: Gpu) -> None:
    """Say when pressure begins and when it ends."""
    pressure_bytes = gpu.ledger.pressure_bytes()
    if bool(pressure_bytes) == gpu.pressed:
        return
    gpu.pressed = bool(pressure_bytes)
    over = [
        {"pid": account.process.pid, "over_bytes": gpu.ledger.drift_bytes(account.process)}
        for account in gpu.ledger.accounts.values()
        if gpu.ledger.drift_bytes(account.process) > core.settings.verify_tolerance_bytes
    ]
    core.note(
        "pressure",
        gpu=gpu.info.id,
        pressure_bytes=pressure_bytes,
        stowaway_bytes=gpu.ledger.stowaway_bytes(),
        holders=over,
        reason="more is held than the budget" if pressure_bytes else "pressure is over",
    )


def _watch_returning(gpu: Gpu, sample: MemorySampled) -> None:
    leaving = {verification.process for verification in gpu.verifications.values()}
    leaving.update(lease.process for lease in gpu.in_state(LeaseState.UNLOADING))
    accounts = gpu.ledger.accounts
    gpu.pending_free.watch(
        gpu.sample,
        sample,
        leaving,
        lambda process: accounts[process].booked_bytes() if process in accounts else 0,
    )


def _note_stowaways(core: Core, gpu: Gpu, known: dict[ProcessKey, int]) -> None:
    tolerance = core.settings.verify_tolerance_bytes
    for stranger in gpu.ledger.strangers.values():
        if (
            stranger.process not in known
            or stranger.used_bytes > known[stranger.process] + tolerance
        ):
            core.note(
                "stowaway",
                gpu=gpu.info.id,
                pid=stranger.process.pid,
                name=stranger.name,
                used_bytes=stranger.used_bytes,
                reason="holds bytes without a lease; charged as reserve",
            )


def _shrink_residues(core: Core, gpu: Gpu, sample: MemorySampled) -> None:
    """A measured leftover that came back later, and the residue of a process that is neither here nor on the card."""
    if sample.processes is None:
        return
    tolerance = core.settings.verify_tolerance_bytes
    waiting_for = {verification.process for verification in gpu.verifications.values()}
    for account in list(gpu.ledger.accounts.values()):
        process = account.process
        if account.charges or process in waiting_for or sample.taken_at <= account.changed_at:
            continue
        floor, held_bytes = account.residue_floor_bytes, account.measured_bytes
        if process_bytes(sample, process) is None:
            held_bytes = (
                sample.used_bytes
            )  # listed without its bytes: no more than all that is on the card
        elif not held_bytes and process not in core.connected and core.recovering is None:
            floor = 0
        if is_hidden(sample, process):  # only the total can tell
            hidden_bytes = gpu.ledger.hidden_bytes(sample)
            held_bytes = account.residue_bytes if hidden_bytes is None else hidden_bytes
        target = max(floor, held_bytes)
        if target + tolerance < account.residue_bytes:
            gpu.ledger.set_residue(process, target, core.now)
            core.record_residue(gpu, process, target)
