"""Course of a verification from its begin to its verdict: when the GPU is read, what follows.

1. begin: `begin_for_lease`, `on_process_died` set its clock (`Gpu.verify`) and read at once;
2. polls: `on_poll_due` reads again, densely at first, and declares it overdue at its deadline;
3. readings: `on_reading` takes the evidence of each (stowaways, retained bytes, pressure, never a
   charge) and hands it to `judge`; one on target has to be confirmed by another;
4. verdict: it is noted; a resolved one frees the charge and tells what waits for it.

The bytes stay charged until then. A failed reading means unknown: it frees nothing.
"""

from collections.abc import Iterable

from vram_arbiter.arbiter.core import learning, standby
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.core.events import MemorySampled, ProbeFailed
from vram_arbiter.arbiter.core.ledger import bytes_of
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState, Verdict, Verification
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.core.verification.judge import Judgement, judge, others_since
from vram_arbiter.schemas.defaults import VERIFY_READING_SHARE
from vram_arbiter.schemas.ids import GpuId, ProcessKey
from vram_arbiter.schemas.wire.notes import (
    About,
    ProbeFailedNote,
    ProbeOkNote,
    StowawayNote,
    VerifiedNote,
)


# -- 1. begin --------------------------------------------------------------------------------------
def begin_for_lease(
    core: Core, gpu: Gpu, lease: Lease, *, alive: bool, grace_s: float = 0.0, fenced_at: float = 0.0
) -> None:
    """Verify that the bytes of a lease return.

    Args:
        alive: Whether its process lives.
        grace_s: Seconds without a verdict: a lost holder may still be loading.
        fenced_at: When the holder has fenced itself, in monotonic seconds.
    """
    baseline = lease.departure.baseline or gpu.sample or gpu.before_sleep
    shown_in = gpu.ledger.accounts[lease.process].shown_in
    dead = lease.departure.baseline is None and not alive
    if dead and shown_in and core.now - shown_in.taken_at <= core.settings.verify_timeout_s:
        # a death may be heard after a reading that shows the bytes as those of a child
        baseline = shown_in
    for drift in learning.on_leaving(core.footprints, gpu, lease):
        core.note(drift, lease)
    vanishes = lease.departure.exiting or not alive
    verification = Verification(
        key=lease.id,
        process=lease.process,
        lease=lease.id,
        consumer=lease.spec.consumer,
        model=learning.model_name(lease.spec),
        retained_bytes=0 if vanishes else lease.spec.footprint.residue_bytes,
        baseline=baseline,
        baseline_comparable=baseline is not None and 0.0 < lease.ready_at <= baseline.taken_at,
        confirmed_at=core.now,
        not_before=core.now + grace_s,
        fenced_at=fenced_at,
        alive=alive,
        vanishes=vanishes,
        exclusive=lease.spec.exclusive,
    )
    gpu.verify(verification, core.now, core.settings)


def on_process_died(gpu: Gpu, process: ProcessKey, now: float, settings: Settings) -> None:
    """A process with an account on this GPU died: nothing may stay, and memory returns from now.
    What is charged stays until it is measured gone."""
    account = gpu.ledger.accounts[process]
    account.retained_floor_bytes = 0
    for verification in gpu.verifications.values():
        if verification.process == process:
            verification.alive, verification.vanishes = False, True
            verification.retained_bytes = 0
            verification.not_before = min(verification.not_before, now)
            verification.paced_from = now
            gpu.read_soon(verification, now, settings)
    key = f"residue:{process}"
    if account.charges or key in gpu.verifications:
        return
    baseline = gpu.sample or gpu.before_sleep
    retained = Verification(
        key=key,
        process=process,
        lease=None,
        consumer=str(process),
        model="",
        retained_bytes=0,
        baseline=baseline,
        baseline_comparable=baseline is not None and baseline.taken_at > account.changed_at,
        confirmed_at=now,
        not_before=now,
        alive=False,
        vanishes=True,
    )
    gpu.verify(retained, now, settings)


# -- 2. polls --------------------------------------------------------------------------------------
def on_poll_due(core: Core, gpu_id: str) -> None:
    """Read the GPU for its due verifications; the verdict is `stale` where no reading came."""
    gpu = core.gpus[GpuId(gpu_id)]
    gpu.touched = True  # its next poll is planned
    due = [v for v in gpu.verifications.values() if v.next_poll_at <= core.now]
    for verification in due:
        if core.now >= verification.deadline_at and not verification.overdue:
            verification.overdue = True
            gpu.wake()
            if verification.last_used_bytes is None:
                stale_one = Judgement(Verdict.STALE, False, 0)
                core.turn.effects += _verified(gpu, verification, stale_one, None, core.now)
        usual_s = core.costs.learnt_s(verification.consumer, "verify_s") or 0.0
        verification.next_poll_at = _next_poll_at(
            verification, core.settings, core.now, usual_s, gpu.reading_s
        )
    if due:  # else this event has put its polls off
        gpu.want_sample(core.now, max([verification.confirmed_at for verification in due]))


def _next_poll_at(
    verification: Verification, settings: Settings, now: float, usual_s: float, reading_s: float
) -> float:
    """Return the time of the next poll: dense while memory usually returns, then rarer.

    Polls stay dense longer for a consumer that is known to take longer (`usual_s`), and are rarer
    on a GPU that is slow to read.
    """
    pauses = settings.verify_poll_s
    if verification.overdue:
        return now + settings.verify_slow_poll_s
    waited_s = now - verification.paced_from
    rungs = zip(pauses, settings.verify_poll_until_s, strict=False)
    pause = next(
        (pause for pause, until_s in rungs if waited_s < max(until_s, 1.5 * usual_s)), pauses[-1]
    )
    pause = max(pause, min(reading_s / VERIFY_READING_SHARE, settings.verify_slow_poll_s))
    return min(now + pause, max(verification.deadline_at, now + pauses[0]))


def on_probe_due(core: Core, gpu_id: str) -> None:
    """Take a background reading; `Arbiter.handle` plans the next one while the GPU is in demand."""
    gpu = core.gpus[GpuId(gpu_id)]
    gpu.asked_at = None  # a reading that never came must not silence the next one
    gpu.want_sample(core.now, core.now)
    gpu.wake()  # the last reading may be too old to carry a grant


def stale(gpus: Iterable[Gpu], oldest: float) -> list[GpuId]:
    """Return the GPUs whose newest reading, good or failed, is too old to gate a grant."""
    return [
        gpu.info.id
        for gpu in gpus
        if (gpu.sample is None or gpu.sample.taken_at < oldest)
        and (gpu.failed_at is None or gpu.failed_at < oldest)
    ]


# -- 3. readings -----------------------------------------------------------------------------------
def on_reading(core: Core, reading: MemorySampled) -> None:
    """Take a reading and judge by it. An impossible one counts as failed, an outdated one not: it
    began before the newest one, or before the machine was suspended."""
    gpu = core.gpus.get(reading.gpu)
    if gpu is None or reading.taken_at < gpu.read_from:
        return
    if gpu.sample is not None and reading.taken_at < gpu.sample.taken_at:
        return
    if problem := gpu.ledger.impossible(reading):
        on_probe_failed(core, ProbeFailed(reading.gpu, reading.taken_at, problem))
        return
    # the probe answers, perhaps after an outage
    if gpu.asked_at is not None and reading.taken_at >= gpu.asked_at:
        gpu.asked_at = None
    gpu.reading_s = max(0.0, core.now - reading.taken_at)
    answers_again = gpu.failed_at is not None
    if answers_again:
        gpu.failed_at, gpu.failure = None, ""
        core.note(ProbeOkNote(gpu.info.id))
    _take_evidence(core, gpu, reading)
    for verification in list(gpu.verifications.values()):
        if reading.taken_at > verification.confirmed_at:
            if answers_again or verification.verdict is Verdict.STALE:
                gpu.verify(verification, core.now, core.settings)
            _weigh(core, gpu, verification, reading)
    gpu.wake()


def _take_evidence(core: Core, gpu: Gpu, reading: MemorySampled) -> None:
    """Make a reading the newest of its GPU, and take its evidence into the ledger."""
    ledger, known = gpu.ledger, gpu.ledger.stowaways
    tolerance_bytes = ledger.tolerance_bytes
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
    for drift, lease in learning.on_evidence(gpu, core.now):
        core.note(drift, lease)
    for use in ledger.stowaways.values():
        before = known.get(use.process)
        if before is None or use.held_bytes > before.held_bytes + tolerance_bytes:
            core.note(StowawayNote(gpu.info.id, use.process.pid, use.name, use.held_bytes))
    for account in list(ledger.accounts.values()):
        if account.charges or account.process in verified or reading.taken_at <= account.changed_at:
            continue
        gone = account.process not in core.connected and core.serving
        retained_bytes = ledger.leftover_bytes(account, reading, gone=gone)
        if retained_bytes + tolerance_bytes < account.retained_bytes:
            ledger.retain(account.process, retained_bytes, core.now)
            core.record_residue(gpu, account.process, retained_bytes)


def on_probe_failed(core: Core, event: ProbeFailed) -> None:
    """The GPU is unknown: grants stop until a good reading. Noted once per outage."""
    gpu = core.gpus.get(event.gpu)
    if gpu is None:
        return
    gpu.asked_at = None
    if gpu.failed_at is None:
        core.note(ProbeFailedNote(event.gpu, event.reason))
    gpu.failed_at, gpu.failure = event.at, event.reason
    gpu.wake()


def _weigh(core: Core, gpu: Gpu, verification: Verification, reading: MemorySampled) -> None:
    """Judge by a reading that counts, and do what follows."""
    settings = core.settings
    others = others_since(gpu, verification, reading, settings.verify_timeout_s)
    judgement = judge(verification, gpu.ledger, reading, others)
    verification.last_used_bytes = reading.used_bytes
    on_target = judgement is not None and judgement.verdict is Verdict.VERIFIED
    if others.loading_bytes and not on_target:
        # nothing is granted before the load ends, so no request waits for this verdict
        deadline_at = core.now + settings.verify_timeout_s
        verification.deadline_at = max(verification.deadline_at, deadline_at)
    elif judgement is not None and on_target and not judgement.resolved:
        confirm_at = reading.taken_at + settings.verify_confirm_s
        verification.next_poll_at = max(core.now, confirm_at)
    elif judgement is not None:
        core.turn.effects += _verified(gpu, verification, judgement, reading, core.now)
        if judgement.resolved:
            _resolve(core, gpu, verification, judgement)


# -- 4. verdict ------------------------------------------------------------------------------------
def _verified(
    gpu: Gpu,
    verification: Verification,
    judgement: Judgement,
    reading: MemorySampled | None,
    now: float,
) -> list[Note]:
    """Return the note of a verdict; an unresolved one that repeats is noted once."""
    if verification.verdict is judgement.verdict and not judgement.resolved:
        return []
    verification.verdict = judgement.verdict
    residue_bytes = judgement.residue_bytes
    if reading is not None and (shown := bytes_of(reading, verification.process)) is not None:
        residue_bytes = min(residue_bytes, shown)  # what it may retain, it need not hold
    verified = VerifiedNote(
        verdict=judgement.verdict,
        resolved=judgement.resolved,
        ms=(now - verification.confirmed_at) * 1e3,
        before_bytes=None if verification.baseline is None else verification.baseline.used_bytes,
        after_bytes=None if reading is None else reading.used_bytes,
        residue_bytes=residue_bytes,
        culprits=judgement.culprits,
    )
    return [Note(verified, About(verification.lease, verification.consumer, gpu.info.id))]


def _resolve(core: Core, gpu: Gpu, verification: Verification, judgement: Judgement) -> None:
    """Free the charge except for retained bytes, and tell everything that waits for it."""
    # 1. the bytes
    del gpu.verifications[verification.key]
    gpu.changed_at = core.now
    gpu.wake()
    process, lease_id = verification.process, verification.lease
    account = gpu.ledger.accounts[process]
    held_bytes = account.charged_bytes
    if lease_id is None:
        gpu.left.append((core.now, held_bytes))
        gpu.ledger.retain(process, 0, core.now)
        core.record_residue(gpu, process, 0)
        return
    learning.on_verdict(core.footprints, core.costs, gpu, verification, core.now)
    retained_bytes = gpu.ledger.drop(
        lease_id, judgement.residue_bytes, verification.retained_bytes, core.now
    )
    gpu.left.append((core.now, held_bytes - account.charged_bytes))
    core.record_residue(gpu, process, retained_bytes)
    core.forget(f"lease:{lease_id}")
    # 2. its eviction, and the waiter that it was for
    for eviction in gpu.evictions:
        if eviction.lease == lease_id:
            eviction.verdict, eviction.verdict_at = str(judgement.verdict), core.now
            waiter = core.waiting.get(eviction.wanted_by) if eviction.wanted_by else None
            if waiter is not None:
                core.wake_candidates(waiter)  # it may fit on another GPU
    # 3. the lease
    lease = core.leases.get(lease_id)
    if lease is not None and lease.state is LeaseState.VERIFYING:
        lives_on = lease.next_state
        if lives_on is not None:
            standby.go_away(core, lease, lives_on, str(judgement.verdict))
        else:
            core.move(lease, LeaseState.RELEASED, str(judgement.verdict))
            core.end(lease, None)
    core.recovering.discard(lease_id)
