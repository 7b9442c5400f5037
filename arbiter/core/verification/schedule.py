"""Course of a verification from its begin to its verdict: when the GPU is read, what follows.

Readings are asked for and handed to `evidence` and `judge`; a resolved verdict frees the charge.
The bytes stay charged until then. A failed reading means unknown: it frees nothing.
"""

from vram_arbiter.arbiter.core.events import MemorySampled, ProbeFailed
from vram_arbiter.arbiter.core.learning import costs, drift
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.model.verification import Verdict, Verification
from vram_arbiter.arbiter.core.verification import evidence
from vram_arbiter.arbiter.core.verification.judge import Judgement, judge
from vram_arbiter.schemas.defaults import VERIFY_READING_SHARE
from vram_arbiter.schemas.ids import GpuId, ProcessKey


# -- begin ---------------------------------------------------------------------------------------
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
    drift.on_leaving(core, lease)
    verification = Verification(
        key=lease.id,
        process=lease.process,
        lease=lease.id,
        consumer=lease.spec.consumer,
        model=drift.model_name(lease.spec),
        residue_bytes=lease.spec.residue_bytes,
        baseline=baseline,
        baseline_comparable=baseline is not None and 0.0 < lease.ready_at <= baseline.taken_at,
        confirmed_at=core.now,
        not_before=core.now + grace_s,
        deadline_at=core.now + grace_s + core.settings.verify_timeout_s,
        fenced_at=fenced_at,
        paced_from=core.now + grace_s,
        alive=alive,
        exiting=lease.departure.exiting,
        exclusive=lease.spec.exclusive,
    )
    _begin(core, gpu, verification)


def on_process_died(core: Core, gpu: Gpu, process: ProcessKey) -> None:
    """A process with an account on this GPU died: nothing may stay, and memory returns from now."""
    for verification in gpu.verifications.values():
        if verification.process == process:
            verification.alive = False
            verification.not_before = min(verification.not_before, core.now)
            verification.paced_from = core.now
            _read_soon(core, gpu, verification)
    if not gpu.ledger.accounts[process].charges and _retained_key(process) not in gpu.verifications:
        _begin_for_retained(core, gpu, process)


def _retained_key(process: ProcessKey) -> str:
    return f"residue:{process}"


def _begin_for_retained(core: Core, gpu: Gpu, process: ProcessKey) -> None:
    """Verify that the retained bytes of a dead process return."""
    baseline = gpu.sample or gpu.before_sleep
    changed_at = gpu.ledger.accounts[process].changed_at
    verification = Verification(
        key=_retained_key(process),
        process=process,
        lease=None,
        consumer=str(process),
        model="",
        residue_bytes=0,
        baseline=baseline,
        baseline_comparable=baseline is not None and baseline.taken_at > changed_at,
        confirmed_at=core.now,
        not_before=core.now,
        deadline_at=core.now + core.settings.verify_timeout_s,
        paced_from=core.now,
        alive=False,
    )
    _begin(core, gpu, verification)


def _begin(core: Core, gpu: Gpu, verification: Verification) -> None:
    gpu.verifications[verification.key] = verification
    core.turn.touch(gpu)
    _read_soon(core, gpu, verification)


def begin_again(core: Core, gpu: Gpu) -> None:
    """Restart the verifications of a GPU: readings before now no longer count."""
    for verification in gpu.verifications.values():
        verification.confirmed_at = core.now
        verification.settling = False
        verification.last_used_bytes = None
        _restart_clock(core, gpu, verification)


def _restart_clock(core: Core, gpu: Gpu, verification: Verification) -> None:
    """Begin polls and deadline anew: time without readings says nothing of the memory's return."""
    verification.paced_from = max(core.now, verification.not_before)
    verification.deadline_at = verification.paced_from + core.settings.verify_timeout_s
    verification.overdue = False
    verification.verdict = None
    _read_soon(core, gpu, verification)


# -- when to read --------------------------------------------------------------------------------
def on_probe_due(core: Core, gpu_id: str) -> None:
    """Take a background reading; `Arbiter.handle` plans the next one while the GPU is in demand."""
    gpu = core.gpus[GpuId(gpu_id)]
    gpu.asked_at = None  # a reading that never came must not silence the next one
    core.want_sample(gpu, core.now)
    core.wake(gpu)  # the last reading may be too old to carry a grant


def on_poll_due(core: Core, gpu_id: str) -> None:
    """Read the GPU for its due verifications; the verdict is `stale` where no reading came."""
    gpu = core.gpus[GpuId(gpu_id)]
    due = [v for v in gpu.verifications.values() if v.next_poll_at <= core.now]
    for verification in due:
        if core.now >= verification.deadline_at and not verification.overdue:
            verification.overdue = True
            core.wake(gpu)
            if verification.last_used_bytes is None:
                _announce(core, gpu, verification, Judgement(Verdict.STALE, False, 0))
        verification.next_poll_at = _next_poll_at(core, gpu, verification)
    core.want_sample(gpu, max(verification.confirmed_at for verification in due))
    _set_poll(core, gpu)


def stale(core: Core) -> list[GpuId]:
    """Return the GPUs whose newest reading, good or failed, is too old to gate a grant."""
    oldest = core.now - core.settings.sample_max_age_s
    return [
        gpu.info.id
        for gpu in core.gpus.values()
        if (gpu.sample is None or gpu.sample.taken_at < oldest)
        and (gpu.failed_at is None or gpu.failed_at < oldest)
    ]


def _read_soon(core: Core, gpu: Gpu, verification: Verification) -> None:
    """Read at once and again soon: most memory is back when its holder reports the release."""
    core.want_sample(gpu, core.now)
    soon = core.now + core.settings.verify_confirm_s
    verification.next_poll_at = max(soon, verification.paced_from)
    _set_poll(core, gpu)


def _next_poll_at(core: Core, gpu: Gpu, verification: Verification) -> float:
    """Return the time of the next poll: dense while memory usually returns, then rarer.

    Polls stay dense longer for a consumer that is known to take longer, and are rarer on a GPU that
    is slow to read.
    """
    settings = core.settings
    pauses = settings.verify_poll_s
    if verification.overdue:
        return core.now + settings.verify_slow_poll_s
    waited_s = core.now - verification.paced_from
    usual_s = 1.5 * (core.learnt_s(verification.consumer, "verify_s") or 0.0)
    rungs = zip(pauses, settings.verify_poll_until_s, strict=False)
    pause = next(
        (pause for pause, until_s in rungs if waited_s < max(until_s, usual_s)), pauses[-1]
    )
    pause = max(pause, min(gpu.reading_s / VERIFY_READING_SHARE, settings.verify_slow_poll_s))
    return min(core.now + pause, max(verification.deadline_at, core.now + pauses[0]))


def _set_poll(core: Core, gpu: Gpu) -> None:
    timer = ("verify", gpu.info.id)
    if gpu.verifications:
        core.timers.set(timer, min(v.next_poll_at for v in gpu.verifications.values()))
    else:
        core.timers.clear(timer)


# -- a reading arrives ---------------------------------------------------------------------------
def on_reading(core: Core, reading: MemorySampled) -> None:
    """Take a reading and judge by it. An impossible one counts as failed, an outdated one not."""
    gpu = core.gpus.get(reading.gpu)
    if gpu is None or _outdated(gpu, reading):
        return
    problem = evidence.impossible(gpu, reading, core.settings.verify_tolerance_bytes)
    if problem:
        on_probe_failed(core, ProbeFailed(reading.gpu, reading.taken_at, problem))
        return
    answers_again = _on_answer(core, gpu, reading)
    evidence.take(core, gpu, reading)
    for verification in list(gpu.verifications.values()):
        if reading.taken_at > verification.confirmed_at:
            if answers_again or verification.verdict is Verdict.STALE:
                _restart_clock(core, gpu, verification)
            _weigh(core, gpu, verification, reading)
    evidence.note_pressure(core, gpu)
    core.wake(gpu)
    for feature in core.hooked["on_sample"]:
        feature.on_sample(core, gpu, reading)


def on_probe_failed(core: Core, event: ProbeFailed) -> None:
    """The GPU is unknown: grants stop until a good reading. Noted once per outage."""
    gpu = core.gpus.get(event.gpu)
    if gpu is None:
        return
    gpu.asked_at = None
    if gpu.failed_at is None:
        core.note("probe_failed", gpu=event.gpu, reason=event.reason)
    gpu.failed_at, gpu.failure = event.at, event.reason
    core.wake(gpu)


def _outdated(gpu: Gpu, reading: MemorySampled) -> bool:
    """Whether a reading began before the newest one, or before the machine was suspended."""
    newest_at = gpu.read_from if gpu.sample is None else gpu.sample.taken_at
    return reading.taken_at < max(newest_at, gpu.read_from)


def _on_answer(core: Core, gpu: Gpu, reading: MemorySampled) -> bool:
    """Record that the probe answered. Return whether this ends an outage."""
    if gpu.asked_at is not None and reading.taken_at >= gpu.asked_at:
        gpu.asked_at = None
    gpu.reading_s = max(0.0, core.now - reading.taken_at)
    if gpu.failed_at is None:
        return False
    gpu.failed_at, gpu.failure = None, ""
    core.note("probe_ok", gpu=gpu.info.id)
    return True


def _weigh(core: Core, gpu: Gpu, verification: Verification, reading: MemorySampled) -> None:
    settings = core.settings
    others = evidence.others_since(gpu, verification, reading, settings.verify_timeout_s)
    opinion = judge(verification, gpu.ledger, reading, others, settings.verify_tolerance_bytes)
    verification.settling = opinion.settling
    verification.last_used_bytes = reading.used_bytes
    if others.loading_bytes and not opinion.settling:
        # nothing is granted before the load ends, so no request waits for this verdict
        deadline_at = core.now + settings.verify_timeout_s
        verification.deadline_at = max(verification.deadline_at, deadline_at)
    elif opinion.judgement is not None:
        _announce(core, gpu, verification, opinion.judgement, reading)
        if opinion.judgement.resolved:
            _resolve(core, gpu, verification, opinion.judgement)
    elif opinion.settling:
        confirm_at = reading.taken_at + settings.verify_confirm_s
        verification.next_poll_at = max(core.now, confirm_at)
        _set_poll(core, gpu)


# -- the verdict ---------------------------------------------------------------------------------
def _announce(
    core: Core,
    gpu: Gpu,
    verification: Verification,
    judgement: Judgement,
    reading: MemorySampled | None = None,
) -> None:
    """Note a verdict; an unresolved one that repeats is noted once."""
    if verification.verdict is judgement.verdict and not judgement.resolved:
        return
    verification.verdict = judgement.verdict
    core.note(
        "verified",
        lease_id=verification.lease,
        consumer=verification.consumer,
        gpu=gpu.info.id,
        verdict=str(judgement.verdict),
        resolved=judgement.resolved,
        ms=(core.now - verification.confirmed_at) * 1e3,
        before_bytes=None if verification.baseline is None else verification.baseline.used_bytes,
        after_bytes=None if reading is None else reading.used_bytes,
        residue_bytes=judgement.residue_bytes,
        culprits=[
            {"pid": pid, "name": name, "bytes": count} for pid, name, count in judgement.culprits
        ],
    )


def _resolve(core: Core, gpu: Gpu, verification: Verification, judgement: Judgement) -> None:
    """Free the charge except for retained bytes, and tell everything that waits for it."""
    del gpu.verifications[verification.key]
    _set_poll(core, gpu)
    gpu.changed_at = core.now
    core.wake(gpu)
    process = verification.process
    held_bytes = gpu.ledger.filled_bytes(process)
    if verification.lease is None:
        gpu.left.append((core.now, held_bytes))
        gpu.ledger.set_residue(process, 0, core.now)
        core.record_residue(gpu, process, 0)
        return
    drift.on_verdict(core, gpu, verification)
    retained_bytes = gpu.ledger.drop(
        verification.lease, judgement.residue_bytes, verification.retained_bytes, core.now
    )
    gpu.left.append((core.now, held_bytes - gpu.ledger.filled_bytes(process)))
    core.record_residue(gpu, process, retained_bytes)
    core.forget(f"lease:{verification.lease}")
    _close_eviction(core, gpu, verification, judgement)
    costs.left(core, verification.consumer)
    lease = core.leases.get(verification.lease)
    if lease is not None and lease.state is LeaseState.VERIFYING:
        lives_on = core.next_state(lease)
        core.move(lease, lives_on or LeaseState.RELEASED, str(judgement.verdict))
        if lives_on is None:
            core.end(lease, None)
    if core.recovering is not None:
        core.recovering.discard(verification.lease)


def _close_eviction(core: Core, gpu: Gpu, verification: Verification, judgement: Judgement) -> None:
    core.learn(verification.consumer, "verify_s", core.now - verification.confirmed_at)
    for eviction in gpu.evictions:
        if eviction.lease == verification.lease:
            eviction.verdict, eviction.verdict_at = str(judgement.verdict), core.now
            waiter = core.waiting.get(eviction.wanted_by) if eviction.wanted_by else None
            for gpu_id in () if waiter is None else waiter.request.gpus:
                core.wake(core.gpus[gpu_id])  # the waiter may fit on another GPU
