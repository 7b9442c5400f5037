"""What the arbiter does next for a waiter, and at which instant where that is planned: typed steps
without words.

Reads only, for answers to `why`. Not on the path of a decision: looking ahead costs a search for
victims per instant.
"""

from math import inf

from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report.standing import Standing
from vram_arbiter.arbiter.core.scheduling import admission, placement, victims
from vram_arbiter.schemas.wire.explained import Because, NextAction, Step

LOOKED_AT_MAX = 16
"""Number of future eviction times to examine."""
LOOKS_AT_HOLDERS_MAX = 400
"""Beside many holders fewer instants are looked at: each look weighs all of them."""


def steps(core: Core, standing: Standing, waiter: Lease) -> list[Step]:
    """For a queued lease, the nearest first; what has no instant comes last."""
    gpu = standing.gpu
    if not any(waiter in core.gpus[gpu_id].queue for gpu_id in waiter.request.gpus):
        found = _of_unqueued(core, gpu, standing, waiter)
    else:
        first = placement.front(core, gpu)
        mine = any(first is one for one in standing.fellows)
        found = _of_head(core, gpu, standing.request) if mine else []
    if waiter.request.wait_timeout_s is not None:
        at = waiter.request.arrived_at + waiter.request.wait_timeout_s
        found.append(_step(core, NextAction.GIVE_UP, waiter, at, Because.TIMEOUT))
    return sorted(found, key=lambda step: inf if step.in_s is None else step.in_s)


def _of_unqueued(core: Core, gpu: Gpu, standing: Standing, waiter: Lease) -> list[Step]:
    """Of a request that waits for the rest of its gang, or with its bytes reserved for its turn to
    load."""
    found: list[Step] = []
    if waiter.id in gpu.ledger.reserved:
        found = [_load_ends(core, lease) for lease in gpu.in_state(LeaseState.LOADING)]
        found = found or [_next_reading(core, gpu, Because.KEPT)]
    if standing.gives_up is not None:
        at, because = standing.gives_up
        gang = "" if standing.gang is None else standing.gang.id
        found.append(_step(core, NextAction.BREAK, None, at, because, gang=gang))
    return found


def _load_ends(core: Core, lease: Lease) -> Step:
    return _step(core, NextAction.LOADED, lease, _learnt_end(core, lease), Because.ONE_LOAD)


def _of_head(core: Core, gpu: Gpu, waiter: Lease) -> list[Step]:
    if core.recovering is not None:
        ends = [core.leases[lease].expires_at for lease in core.recovering if lease in core.leases]
        at = max(ends, default=None)
        return [_step(core, NextAction.SERVE, None, at, Because.ACCOUNTED)]
    if gpu.failed_at is not None or gpu.sample is None:
        return [_next_reading(core, gpu, Because.UNREADABLE)]
    found = [_load_ends(core, lease) for lease in gpu.in_state(LeaseState.LOADING)]
    found += [_leaving(core, gpu, waiter, lease) for lease in gpu.in_state(*LEAVING)]
    going = admission.leaving(gpu)
    if found or admission.blocked(core, gpu):
        return found
    if admission.fits(gpu, waiter, going):
        return [_next_reading(core, gpu, Because.MEASUREMENT)]
    return _asking(core, gpu, waiter)


def _asking(core: Core, gpu: Gpu, waiter: Lease) -> list[Step]:
    """Which holders will be revoked, and when: at the first instant at which a sufficient set may
    be.
    """
    going = admission.leaving(gpu)
    looks = max(1, min(LOOKED_AT_MAX, LOOKS_AT_HOLDERS_MAX // (1 + len(gpu.residents))))
    for at in sorted({core.now, *victims.ask_times(core, gpu, waiter)})[:looks]:
        chosen = victims.choose_victims(core, gpu, waiter, going, at)
        if chosen is not None:
            return [
                _step(core, NextAction.ASK, victim, at, _because(core, waiter, victim, at))
                for victim in chosen
            ]
    if missing := [lease for lease in gpu.in_state(LeaseState.HELD) if not lease.attached]:
        last = max(missing, key=lambda lease: lease.expires_at)
        return [_step(core, NextAction.WAIT, last, last.expires_at, Because.NOT_BACK)]
    return [_step(core, NextAction.WAIT, None, None, Because.NO_VICTIM)]


def _because(core: Core, waiter: Lease, victim: Lease, at: float) -> Because:
    if at <= core.now:
        return Because.NEXT_READING
    if at == victims.residency_ends_at(core, victim, waiter):
        return Because.RESIDENCY
    return Because.AGEING if victim.in_use else Because.TOGETHER


def _leaving(core: Core, gpu: Gpu, waiter: Lease, holder: Lease) -> Step:
    verification = gpu.verifications.get(holder.id)
    if verification is not None:
        latest = max(0.0, verification.deadline_at - core.now)
        because = Because.VERDICT if latest else Because.MEASURED_GONE
        at = verification.next_poll_at
        return _step(core, NextAction.MEASURE, holder, at, because, latest_s=latest or None)
    eviction = holder.departure.eviction
    if eviction is None or eviction.overdue:
        because = Because.HANGING if holder.departure.hangs else Because.LEAVING
        return _step(core, NextAction.WAIT, holder, None, because)
    unloads = holder.state is LeaseState.UNLOADING
    began_at = holder.since if unloads else eviction.asked_at
    at = began_at + core.settings.revoke_deadline_s
    because = Because.DENIED if waiter.spec.deny_on_deadline else Because.WAITS_ON
    return _step(core, NextAction.DEADLINE, holder, at, because, waiter=waiter.spec.consumer)


def _next_reading(core: Core, gpu: Gpu, because: Because) -> Step:
    times = [core.timers.due((kind, gpu.info.id)) for kind in ("verify", "probe")]
    at = min((time for time in times if time is not None), default=None)
    return _step(core, NextAction.READ, None, at, because)


def _learnt_end(core: Core, lease: Lease) -> float | None:
    end = lease.granted_at + (core.learnt_s(lease.spec.consumer, "load_s") or 0.0)
    return end if end > core.now else None


def _step(
    core: Core,
    action: NextAction,
    lease: Lease | None,
    at: float | None,
    because: Because,
    *,
    gang: str = "",
    waiter: str = "",
    latest_s: float | None = None,
) -> Step:
    return Step(
        action=action,
        consumer="" if lease is None else lease.spec.consumer,
        lease_id=None if lease is None else lease.id,
        in_s=None if at is None else max(0.0, at - core.now),
        because=because,
        gang=gang,
        waiter=waiter,
        latest_s=latest_s,
    )
