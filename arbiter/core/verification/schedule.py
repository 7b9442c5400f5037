"""The bytes of a lease are measured away: a verification from its begin to its verdict.

Says when to look, has each reading judged (`verify`, with what `others` may account for), tells the verdict and draws its consequences.
The bytes stay charged until then.
"""

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.learning import costs, drift
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.verification import others
from vram_arbiter.arbiter.core.verification.judge import Judgement, Verdict, Verification, judge
from vram_arbiter.schemas.defaults import VERIFY_READING_SHARE
from vram_arbiter.schemas.ids import GpuId, ProcessKey


# -- begin -----------------------------------------------------------------------------------------------------------
def begin_for_lease(
    core: Core, gpu: Gpu, lease: Lease, *, alive: bool, grace_s: float = 0.0, fenced_at: float = 0.0
) -> None:
    """Measure a lease's bytes away. Its charge is in the ledger and stays there until the verdict."""
    baseline = lease.departure.baseline or gpu.sample or gpu.before_sleep
    drift.on_leaving(core, lease)
    comparable = baseline is not None and 0.0 < lease.ready_at <= baseline.taken_at
    verification = Verification(
        key=lease.id,
        process=lease.process,
        lease=lease.id,
        consumer=lease.spec.consumer,
        model=drift.model_name(lease.spec),
        residue_bytes=lease.spec.residue_bytes,
        baseline=baseline,
        baseline_comparable=comparable,
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


def begin_for_residue(core: Core, gpu: Gpu, process: ProcessKey) -> None:
    """The process died and had only a residue here: measure that away too."""
    baseline = gpu.sample or gpu.before_sleep
    verification = Verification(
        key=f"residue:{process}",
        process=process,
        lease=None,
        consumer=str(process),
        model="",
        residue_bytes=0,
        baseline=baseline,
        baseline_comparable=baseline is not None
        and baseline.taken_at > gpu.ledger.accounts[process].changed_at,
        confirmed_at=core.now,
        not_before=core.now,
        deadline_at=core.now + core.settings.verify_timeout_s,
        paced_from=core.now,
        alive=False,
    )
    _begin(core, gpu, verification)


def _begin(core: Core, gpu: Gpu, verification: Verification) -> None:
    gpu.verifications[verification.key] = verification
    _read_soon(core, gpu, verification)


def bereave(core: Core, gpu: Gpu, verification: Verification) -> None:
    """Its process died: nothing may stay any more, and it is from now on that the memory comes back."""
    verification.alive = False
    verification.not_before = min(verification.not_before, core.now)
    verification.paced_from = core.now
    _read_soon(core, gpu, verification)


def begin_again(core: Core, gpu: Gpu, verification: Verification) -> None:
    """What was read so far tells nothing any more, and neither does the time that it took."""
    verification.confirmed_at = core.now
    verification.settling = False
    verification.last_used_bytes = None
    _wait_anew(core, gpu, verification)


def _wait_anew(core: Core, gpu: Gpu, verification: Verification) -> None:
    """Nobody could look for a while: that time says nothing about when the memory comes back."""
    verification.paced_from = max(core.now, verification.not_before)
    verification.deadline_at = verification.paced_from + core.settings.verify_timeout_s
    verification.overdue = False
    verification.verdict = None
    _read_soon(core, gpu, verification)


# -- when to look ----------------------------------------------------------------------------------------------------
def on_poll_due(core: Core, gpu_id: str) -> None:
    """Read the card for all verifications that are due, and say `stale` where no reading came in time."""
    gpu = core.gpus[GpuId(gpu_id)]
    due = [v for v in gpu.verifications.values() if v.next_poll_at <= core.now]
    for verification in due:
        if core.now >= verification.deadline_at and not verification.overdue:
            verification.overdue = True
            core.wake(gpu)
            if verification.last_used_bytes is None:
                _announce(core, gpu, verification, Judgement(Verdict.STALE, False, 0))
        verification.next_poll_at = _next_poll_at(core, gpu, verification)
    # a reading that is under way and counts for all of them is not asked for twice
    core.want_sample(gpu, max(verification.confirmed_at for verification in due))
    _set_poll(core, gpu)


def _read_soon(core: Core, gpu: Gpu, verification: Verification) -> None:
    """A reading at once, and the next one soon: most memory is back when its holder says so."""
    core.want_sample(gpu, core.now)
    soon = core.now + core.settings.verify_confirm_s
    verification.next_poll_at = max(soon, verification.paced_from)
    _set_poll(core, gpu)


def _next_poll_at(core: Core, gpu: Gpu, verification: Verification) -> float:
    """When to look again: dense as long as memory usually takes to come back, then rarer.

    A consumer that is known to take longer is looked at densely for longer, and a card that is slow to read is read less often.
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
    if gpu.verifications:
        core.timers.set(
            ("verify", gpu.info.id), min(v.next_poll_at for v in gpu.verifications.values())
        )
    else:
        core.timers.clear(("verify", gpu.info.id))


# -- weigh a reading -------------------------------------------------------------------------------------------------
def on_reading(core: Core, gpu: Gpu, sample: MemorySampled, *, answers_again: bool) -> None:
    """Weigh a new reading for all of whom it may say something. `answers_again`: the readings before it failed."""
    for verification in list(gpu.verifications.values()):
        if sample.taken_at > verification.confirmed_at:
            if answers_again or verification.verdict is Verdict.STALE:
                _wait_anew(core, gpu, verification)
            _weigh(core, gpu, verification, sample)


def _weigh(core: Core, gpu: Gpu, verification: Verification, sample: MemorySampled) -> None:
    meanwhile = others.since_baseline(gpu, verification, sample, core.settings.verify_timeout_s)
    judgement = judge(
        verification, gpu.ledger, sample, meanwhile, core.settings.verify_tolerance_bytes
    )
    if meanwhile.loading_bytes and not verification.settling:
        # nothing is granted before the load has ended, so nobody waits for this verdict
        verification.deadline_at = max(
            verification.deadline_at, core.now + core.settings.verify_timeout_s
        )
        return
    if judgement is None:
        if verification.settling:
            verification.next_poll_at = max(
                core.now, sample.taken_at + core.settings.verify_confirm_s
            )
            _set_poll(core, gpu)
        return
    _announce(core, gpu, verification, judgement, sample)
    if judgement.resolved:
        _resolve(core, gpu, verification, judgement)


# -- the verdict -----------------------------------------------------------------------------------------------------
def _announce(
    core: Core,
    gpu: Gpu,
    verification: Verification,
    judgement: Judgement,
    sample: MemorySampled | None = None,
) -> None:
    """Tell a verdict once; an unresolved one that repeats is silent."""
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
        after_bytes=None if sample is None else sample.used_bytes,
        residue_bytes=judgement.residue_bytes,
        culprits=[
            {"pid": pid, "name": name, "bytes": count} for pid, name, count in judgement.culprits
        ],
    )


def _resolve(core: Core, gpu: Gpu, verification: Verification, judgement: Judgement) -> None:
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
    residue = gpu.ledger.drop(
        verification.lease, judgement.residue_bytes, verification.kept_bytes, core.now
    )
    gpu.left.append((core.now, held_bytes - gpu.ledger.filled_bytes(process)))
    core.record_residue(gpu, process, residue)
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
    for way_out in gpu.evictions:
        if way_out.lease == verification.lease:
            way_out.verdict, way_out.verdict_at = str(judgement.verdict), core.now
            waiter = core.waiting.get(way_out.wanted_by) if way_out.wanted_by is not None else None
            for gpu_id in () if waiter is None else waiter.request.gpus:
                core.wake(
                    core.gpus[gpu_id]
                )  # if this was not enough, it may be served on another card
