"""Readings of a card: what they say about stowaways, pressure and the verifications under way.

Starts, polls and ends verifications; the judgement itself is in `verify`. A failed reading is *unknown*: it frees nothing.
"""

from collections.abc import Mapping
from typing import Any

from arbiter.core import costs, crashes, drift, eviction, families, growth, standby
from arbiter.core.events import MemorySampled, ProbeFailed
from arbiter.core.lease import AWAY, Lease, LeaseState
from arbiter.core.ledger import is_hidden, process_bytes
from arbiter.core.state import Core, Gpu
from arbiter.core.verify import Judgement, Verdict, Verification, judge
from schemas.defaults import VERIFY_READING_SHARE
from schemas.ids import GpuId, LeaseId, ProcessKey


# -- readings ------------------------------------------------------------------------------------------------------
def on_sample(core: Core, sample: MemorySampled) -> None:
    """A reading arrived. One older than the newest or from before a suspend is dropped; one of an unknown card too."""
    gpu = core.gpus.get(sample.gpu)
    if gpu is None or sample.taken_at < gpu.read_from:
        return
    if gpu.sample is not None and sample.taken_at < gpu.sample.taken_at:
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
        returning_bytes=gpu.returning.since(sample.taken_at - core.settings.verify_timeout_s),
    )
    if sample.processes is not None:
        drift.on_evidence(core, gpu)
        _note_stowaways(core, gpu, known)
    _shrink_residues(core, gpu, sample)
    for verification in list(gpu.verifications.values()):
        if sample.taken_at > verification.confirmed_at:
            if answers_again or verification.verdict is Verdict.STALE:
                _wait_anew(core, gpu, verification)
            _weigh(core, gpu, verification, sample)
    note_pressure(core, gpu)
    core.wake(gpu)


def _watch_returning(gpu: Gpu, sample: MemorySampled) -> None:
    leaving = {verification.process for verification in gpu.verifications.values()}
    leaving.update(lease.process for lease in gpu.in_state(LeaseState.UNLOADING))
    accounts = gpu.ledger.accounts
    gpu.returning.watch(
        gpu.sample,
        sample,
        leaving,
        lambda process: accounts[process].booked_bytes() if process in accounts else 0,
    )


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


def _note_stowaways(core: Core, gpu: Gpu, known: dict[ProcessKey, int]) -> None:
    tolerance = core.settings.verify_tolerance_bytes
    for stranger in gpu.ledger.strangers.values():
        if stranger.process not in known or stranger.used_bytes > known[stranger.process] + tolerance:
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
        if (
            process_bytes(sample, process) is None
        ):  # listed without its bytes: no more than all that is on the card
            held_bytes = sample.used_bytes
        elif not held_bytes and process not in core.connected and core.recovering is None:
            floor = 0
        if is_hidden(sample, process):  # only the total can tell
            hidden_bytes = gpu.ledger.hidden_bytes(sample)
            held_bytes = account.residue_bytes if hidden_bytes is None else hidden_bytes
        target = max(floor, held_bytes)
        if target + tolerance < account.residue_bytes:
            gpu.ledger.set_residue(process, target, core.now)
            families.residue_fell(core, gpu, process)
            core.record_residue(gpu, process, target)


# -- verifications -------------------------------------------------------------------------------------------------
def begin_for_lease(
    core: Core, gpu: Gpu, lease: Lease, *, alive: bool, grace_s: float = 0.0, fenced_at: float = 0.0
) -> None:
    """Measure a lease's bytes away. Its charge is in the ledger and stays there until the verdict."""
    baseline = lease.baseline or gpu.sample or gpu.before_sleep
    drift.on_leaving(core, lease)
    if lease.estate is not None and (baseline is None or baseline.processes is None):
        baseline = None  # how much of a reservation was ever filled, a total cannot say
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
        exiting=lease.exiting,
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


def _read_soon(core: Core, gpu: Gpu, verification: Verification) -> None:
    """A reading at once, and the next one soon: most memory is back when its holder says so."""
    core.want_sample(gpu, core.now)
    soon = core.now + core.settings.verify_confirm_s
    verification.next_poll_at = max(soon, verification.paced_from)
    _set_poll(core, gpu)


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
    pause = next((pause for pause, until_s in rungs if waited_s < max(until_s, usual_s)), pauses[-1])
    pause = max(pause, min(gpu.reading_s / VERIFY_READING_SHARE, settings.verify_slow_poll_s))
    return min(core.now + pause, max(verification.deadline_at, core.now + pauses[0]))


def _set_poll(core: Core, gpu: Gpu) -> None:
    if gpu.verifications:
        core.timers.set(("verify", gpu.info.id), min(v.next_poll_at for v in gpu.verifications.values()))
    else:
        core.timers.clear(("verify", gpu.info.id))


def _weigh(core: Core, gpu: Gpu, verification: Verification, sample: MemorySampled) -> None:
    loading_bytes = _loading_bytes(gpu, verification, sample)
    judgement = judge(
        verification,
        gpu.ledger,
        sample,
        _grown_by_right(gpu, verification, sample) - loading_bytes,
        families.unfilled_bytes(gpu) if sample.processes is None else 0,
        core.settings.verify_tolerance_bytes,
        loading_bytes,
        _left_bytes(core, gpu, verification, sample),
    )
    if loading_bytes and not verification.settling:  # nothing is granted meanwhile, so nobody waits for it
        verification.deadline_at = max(verification.deadline_at, core.now + core.settings.verify_timeout_s)
        return
    if judgement is None:
        if verification.settling:
            verification.next_poll_at = max(core.now, sample.taken_at + core.settings.verify_confirm_s)
            _set_poll(core, gpu)
        return
    _announce(core, gpu, verification, judgement, sample)
    if judgement.resolved:
        _resolve(core, gpu, verification, judgement)


def _left_bytes(core: Core, gpu: Gpu, verification: Verification, sample: MemorySampled) -> int:
    """The most that others may have taken off the card since the baseline: who leaves, has left, shrinks, or is no longer listed."""
    baseline = verification.baseline
    if baseline is None:
        return 0
    leaving = {other.process for other in gpu.verifications.values()} - {verification.process}
    count = sum(_filled_bytes(gpu, process) for process in leaving)
    count += sum(left for at, left in gpu.left if at > baseline.taken_at)
    count += gpu.returning.since(baseline.taken_at - core.settings.verify_timeout_s)
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
        culprits=[{"pid": pid, "name": name, "bytes": count} for pid, name, count in judgement.culprits],
    )


def _filled_bytes(gpu: Gpu, process: ProcessKey) -> int:
    return gpu.ledger.filled_bytes(process) if process in gpu.ledger.accounts else 0


def _resolve(core: Core, gpu: Gpu, verification: Verification, judgement: Judgement) -> None:
    del gpu.verifications[verification.key]
    _set_poll(core, gpu)
    gpu.changed_at = core.now
    core.wake(gpu)
    process = verification.process
    held_bytes = _filled_bytes(gpu, process)
    if verification.lease is None:
        gpu.left.append((core.now, held_bytes))
        gpu.ledger.set_residue(process, 0, core.now)
        families.residue_fell(core, gpu, process)
        core.record_residue(gpu, process, 0)
        return
    drift.on_verdict(core, gpu, verification)
    residue = gpu.ledger.drop(verification.lease, judgement.residue_bytes, verification.kept_bytes, core.now)
    gpu.left.append((core.now, held_bytes - _filled_bytes(gpu, process)))
    families.gone(core, gpu, verification.lease, process)
    core.record_residue(gpu, process, residue)
    core.forget(f"lease:{verification.lease}")
    _close_eviction(core, gpu, verification, judgement)
    costs.left(core, verification.consumer)
    lease = core.leases.get(verification.lease)
    if lease is not None and lease.state is LeaseState.VERIFYING:
        standby.settle(core, lease, str(judgement.verdict))
    if core.recovering is not None:
        core.recovering.discard(verification.lease)


def _close_eviction(core: Core, gpu: Gpu, verification: Verification, judgement: Judgement) -> None:
    core.learn(verification.consumer, "verify_s", core.now - verification.confirmed_at)
    for way_out in gpu.evictions:
        if way_out.lease == verification.lease:
            way_out.verdict, way_out.verdict_at = str(judgement.verdict), core.now
            waiter = core.waiting.get(way_out.wanted_by) if way_out.wanted_by is not None else None
            for gpu_id in () if waiter is None else waiter.gpus:
                core.wake(core.gpus[gpu_id])  # if this was not enough, it may be served on another card


# -- leases that end without their holder's word ---------------------------------------------------------------------
def lose(
    core: Core,
    lease: Lease,
    to: LeaseState,
    error: Mapping[str, Any],
    *,
    alive: bool,
    grace_s: float = 0.0,
    fenced_at: float = 0.0,
) -> None:
    """A resident lease is over (expired or lost); its bytes become a debt and are measured away."""
    gpu = core.gpu_of(lease)
    crashes.failed(core, lease, str(error["message"]))
    for use in list(lease.uses.values()):
        core.unmark(lease, use)
    lease.yielded.clear()
    growth.abandon(core, lease, "the lease is over")
    gpu.ledger.to_debt(lease.id)
    core.record_lease(lease, debt=True)
    if lease.eviction is not None:
        lease.eviction.released_at = core.now
        lease.eviction.unloading_at = lease.eviction.unloading_at or core.now
    begin_for_lease(core, gpu, lease, alive=alive, grace_s=grace_s, fenced_at=fenced_at)
    eviction.part(core, gpu, lease)
    lease.move(to, core.now, str(error["message"]))
    core.end(lease, error)


def on_expiry_due(core: Core, lease_id: str) -> None:
    """A holder did not renew (who has let go has no such timer)."""
    lease = core.leases[LeaseId(lease_id)]
    if lease.state in AWAY:
        standby.give_up(core, lease, LeaseState.CANCELLED, "lease_lost", standby.NOT_BACK)
        return
    expire(core, lease, f"{lease.id} was not renewed for {lease.spec.ttl_s:g} s")


def expire(core: Core, lease: Lease, why: str) -> None:
    """The lease is over for good, perhaps before its time (an operator's word). Its holder may still be loading until it fences itself,
    so no verdict before that; one that is loaded has to be measured gone (if that can be seen), or to have fenced itself."""
    error = {
        "code": "lease_expired",
        "message": why,
        "hint": "unload, then acquire again",
        "details": {"ttl_s": lease.spec.ttl_s},
    }
    core.note("expired", lease, reason=error["message"])
    token = lease.token
    assert token is not None, f"{lease.id} expires without a token"
    core.push(
        lease,
        {"push": "lost", "lease_id": lease.id, "token": [token.epoch, token.serial], "error": error},
    )
    # a restart's deadline has the grace in it
    grace_s = core.settings.fence_grace_s if lease.attached else 0.0
    fenced_at = lease.expires_at + grace_s
    weight_bytes = core.gpu_of(lease).ledger.charge_bytes(lease.id) - lease.spec.residue_bytes
    if lease.state is LeaseState.LOADING or weight_bytes <= 2 * core.settings.verify_tolerance_bytes:
        grace_s = max(0.0, fenced_at - core.now)  # what is so small no reading can tell from nothing
    if (
        core.recovering is not None
    ):  # its bytes stay charged: nobody who fits beside them has to wait for the verdict
        core.recovering.discard(lease.id)
    lose(core, lease, LeaseState.EXPIRED, error, alive=True, grace_s=grace_s, fenced_at=fenced_at)
