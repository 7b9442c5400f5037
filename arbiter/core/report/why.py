"""Answers to `why`: what a lease waits for, what is in its way, and what happens next.

`explain` composes them in this order, as codes and values without words:
  1. blockers: the bytes of each holder, and the condition on which they come free
  2. situation: the one thing that the lease waits for now
  3. plan: the next steps of the arbiter, and the instants at which they are planned
  4. estimate: seconds until the lease is loaded, from learned medians
Reads only, and only when asked: the plan costs a search for victims per instant.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from heapq import nlargest
from itertools import islice
from math import inf

from vram_arbiter.arbiter.core import learning, standby
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import AWAY, LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.scheduling import admission, victims
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.explained import (
    Because,
    Blocker,
    Condition,
    Explanation,
    LeaseDetail,
    NextAction,
    Return,
    Situation,
    Step,
    WhyReply,
)

EXPLAINED_MAX = 8
"""Leases of one answer to `why`."""

BLOCKERS_MAX = 32
"""Blockers of one waiter that are listed; of more, the largest holders."""

LONG_LOAD_S = 10.0
"""From then on the progress of a load is shown, and for how long it has not grown."""

ASK_TIMES_MAX = 16
"""Number of future eviction times to examine."""

WEIGHED_MAX = 400
"""Holders weighed over all of these times: beside many holders fewer times are examined."""

BEHIND_MAX = 4
"""Places of a queue for which an estimate is made: each costs a search for victims."""

_PHASES_LEFT = {
    LeaseState.REVOKING: ("drain_s", "unload_s", "verify_s"),
    LeaseState.UNLOADING: ("unload_s", "verify_s"),
    LeaseState.VERIFYING: ("verify_s",),
}
"""Learned phases that a leaving lease has before it."""


def why(core: Core, consumer: str) -> WhyReply:
    """Explain why a consumer is not running, or that it is. A lease's id stands for that lease.

    Of a consumer with many leases the oldest are explained: each costs a search for victims.
    """
    named = core.leases.get(LeaseId(consumer))
    mine = [one for one in core.leases.values() if one.spec.consumer == consumer]
    mine = [named] if named else mine
    told = tuple(explain(core, lease, plan=True) for lease in mine[:EXPLAINED_MAX])
    return WhyReply(consumer, told, more=len(mine[EXPLAINED_MAX:]))


def details(core: Core, lease_ids: Iterable[str]) -> tuple[LeaseDetail, ...]:
    """Return what a page of the status adds to each of its leases."""
    return tuple(_detail(core, core.leases[LeaseId(lease_id)]) for lease_id in lease_ids)


def _detail(core: Core, lease: Lease) -> LeaseDetail:
    sizes, resident = lease.spec.footprint, lease.gpu is not None
    waits = lease.state is LeaseState.QUEUED or lease.state in AWAY
    peak = lease.state in (LeaseState.QUEUED, LeaseState.LOADING)
    return LeaseDetail(
        lease_id=lease.id,
        declared_bytes=sizes.load_peak_bytes if peak else sizes.steady_bytes,
        measured_bytes=learning.held_bytes(core.gpu_of(lease), lease) or None if resident else None,
        why=explain(core, lease, plan=True, brief=True) if waits else None,
    )


def explain(core: Core, lease: Lease, *, plan: bool = False, brief: bool = False) -> Explanation:
    """Explain one lease: what it needs, what is in its way, and when it is loaded.

    `plan`: with the next steps. They also give an estimate where no holder was revoked yet.
    `brief`: without the blockers of a request behind others, which are the head's own.
    """
    gpu, away = _gpu_of(core, lease), lease.state in AWAY
    free = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
    told = Explanation(
        lease_id=lease.id,
        consumer=lease.spec.consumer,
        state=lease.state,
        position=0,
        needed_bytes=0,
        free_bytes=max(0, free),
        deficit_bytes=0,
        condition=Situation.AWAY if away else Situation.RESIDENT,
        blockers=(),
        eta_s=None,
        eta_source="none",
        footprint=learning.footprint(core, lease),
        plan=(),
        block=status.block_view(core, gpu),
    )
    if lease.state is LeaseState.QUEUED:
        return _explain_waiter(core, lease, gpu, free, told, plan=plan, brief=brief)
    if away:
        return _explain_away(core, lease, gpu, told)
    eviction = lease.departure.eviction
    return replace(
        told,
        holder=holder(core, gpu, lease),
        revoked=None if eviction is None else eviction.why,
        drifted=bool(learning.drift_bytes(core, gpu, lease)),
    )


def _gpu_of(core: Core, lease: Lease) -> Gpu:
    """Return where a lease is, where room is made for it, or where it may be placed first."""
    return core.gpus[lease.gpu or lease.request.planned_gpu or lease.request.gpus[0]]


def _explain_away(core: Core, lease: Lease, gpu: Gpu, told: Explanation) -> Explanation:
    """Tell what a lease that is away waits for on the first GPU that it may return to."""
    head, due_at = gpu.queue.head, standby.quiet_at(gpu, lease)
    if not lease.attached:
        return replace(told, back=Return.HOLDER)
    if not lease.standby.comes_back:
        return replace(told, back=Return.ASKED)
    if head is not None:
        return replace(told, back=Return.BEHIND, ahead=head.spec.consumer)
    if admission.blocked(core, gpu):
        return replace(told, back=Return.BLOCKED)
    if standby.left_for_is_here(gpu, lease):
        return replace(told, back=Return.LEFT_FOR, ahead=lease.standby.left_for)
    if not admission.fits(gpu, lease):
        return replace(told, back=Return.NO_ROOM)
    if due_at > core.now:
        return replace(told, back=Return.QUIET, due_s=due_at - core.now)
    return replace(told, back=Return.READING)


def _explain_waiter(
    core: Core,
    lease: Lease,
    gpu: Gpu,
    free: int,
    told: Explanation,
    *,
    plan: bool,
    brief: bool,
) -> Explanation:
    request, needed = lease.request, admission.added_bytes(gpu, lease)
    deficit = max(0, needed - free)
    raised = request.load_peak_bytes > lease.spec.footprint.load_peak_bytes
    position = status.position(core, lease)
    behind = brief and position > 1
    blockers = () if behind else _blockers(core, gpu, lease, deficit)
    situation = _situation(core, gpu, lease, position, blocked=bool(blockers))
    leaving = _leaving(gpu) if situation is Situation.MAKING_ROOM else ()
    steps = _steps(core, gpu, lease) if plan else ()
    eta_s = _eta_s(core, gpu, lease, steps) if position <= 1 else _eta_behind_s(core, gpu, lease)
    return replace(
        told,
        position=position,
        needed_bytes=needed,
        deficit_bytes=deficit,
        condition=situation,
        blockers=blockers,
        eta_s=eta_s,
        eta_source="none" if eta_s is None else "learnt",
        plan=steps,
        ahead=ahead_of(core, lease),
        wait=request.reason,
        leaving=tuple(holder(core, gpu, one) for one in leaving),
        measuring=tuple(one.consumer for one in gpu.verifications.values()),
        expected_bytes=request.load_peak_bytes if raised else None,
    )


def ahead_of(core: Core, lease: Lease) -> str:
    """Return the consumer of the request before this one; "" for the head, which alone has
    blockers of its own."""
    if status.position(core, lease) <= 1:
        return ""
    before = _gpu_of(core, lease).queue.ahead_of(lease)
    return core.waiting[before].spec.consumer if before else "others"


# -- 1. blockers -----------------------------------------------------------------------------------
def _blockers(core: Core, gpu: Gpu, waiter: Lease, deficit: int) -> tuple[Blocker, ...]:
    """List what holds bytes that the waiter lacks, or holds the GPU alone.

    Everything charged on the GPU is listed: holders, contexts, debts, stowaways.
    """
    loading = gpu.in_state(LeaseState.LOADING)
    alone = waiter.spec.exclusive or gpu.residents.exclusive
    if not deficit and not alone and not loading:
        return ()
    residents = list(gpu.residents.values())
    if len(residents) > BLOCKERS_MAX:
        charge_of = gpu.ledger.charge_bytes
        residents = nlargest(BLOCKERS_MAX, residents, lambda lease: charge_of(lease.id))
    holders = [holder(core, gpu, lease, waiter) for lease in residents]
    return tuple([*holders, *_keepers(core, gpu, waiter)][:BLOCKERS_MAX])


def holder(core: Core, gpu: Gpu, lease: Lease, waiter: Lease | None = None) -> Blocker:
    """Return a resident lease as it stands in a waiter's way, or for itself."""
    condition, seconds = _condition(core, lease, waiter)
    long = condition is Condition.LOADING and core.now - lease.granted_at >= LONG_LOAD_S
    quiet_s = core.now - max(lease.observed.grew_at, lease.granted_at)
    blocker = Blocker(
        lease_id=lease.id,
        consumer=lease.spec.consumer,
        bytes=gpu.ledger.charge_bytes(lease.id),
        state=lease.state,
        uses=len(lease.uses),
        label=next((use.label for use in lease.uses.values()), ""),
        condition=condition,
        seconds=seconds,
        pid=lease.process.pid if condition is Condition.HANGING else None,
        by=str(lease.pinned) if condition is Condition.PINNED and lease.pinned else "",
        loaded_bytes=lease.observed.peak_bytes if long else None,
        quiet_s=quiet_s if long and quiet_s >= LONG_LOAD_S else None,
    )
    if waiter is None or condition is not Condition.PRIORITY:
        return blocker
    aged = waiter.priority_at(core.now, core.settings.ageing_s_per_point)
    return replace(blocker, priority=lease.spec.priority, waiter_priority=aged)


def _condition(core: Core, lease: Lease, waiter: Lease | None) -> tuple[Condition, float | None]:
    """Return on which condition a holder's bytes come free, and its seconds."""
    match lease.state:
        case LeaseState.LOADING:
            return Condition.LOADING, core.now - lease.granted_at
        case LeaseState.REVOKING:
            eviction = lease.departure.eviction
            return Condition.REVOKED, core.now - (eviction.asked_at if eviction else lease.since)
        case LeaseState.UNLOADING:
            hangs = Condition.HANGING if lease.departure.hangs else Condition.UNLOADING
            return hangs, core.now - lease.since
        case LeaseState.VERIFYING:
            return Condition.MEASURED, None
    if not lease.attached:
        return Condition.NOT_BACK, lease.expires_at - core.now
    if not lease.evictable:
        return Condition.PINNED, None
    if waiter is not None:
        ends_at = victims.residency_ends_at(core, lease, waiter)
        if ends_at > core.now:
            stretched = ends_at > lease.ready_at + lease.spec.min_residency_s
            return (Condition.THRASHING if stretched else Condition.RESIDENCY), ends_at - core.now
        aged = waiter.priority_at(core.now, core.settings.ageing_s_per_point)
        if lease.uses and lease.spec.priority > aged:
            return Condition.PRIORITY, None
    if lease.uses:
        return Condition.IN_USE, core.now - next(iter(lease.uses.values())).began_at
    return Condition.IDLE, None


def _keepers(core: Core, gpu: Gpu, waiter: Lease) -> list[Blocker]:
    """List processes without a resident lease that hold bytes: contexts of live processes, debts,
    stowaways."""
    ledger = gpu.ledger
    names = {client.process: client.name for client in core.clients.values()}
    kept: list[Blocker] = []
    for process, account in ledger.accounts.items():
        count, pid = account.charged_bytes, process.pid
        resident = not gpu.residents.keys().isdisjoint(account.charges)
        if process == waiter.process or not count or resident:
            continue
        if account.charges:
            debts = [one for one in gpu.verifications.values() if one.process == process]
            keeps = any(one.overdue and one.alive for one in debts)
            state, condition = "debt", Condition.DEBT_KEPT if keeps else Condition.DEBT
        else:
            more = account.retained_bytes > account.retained_floor_bytes
            state, condition = "residue", Condition.RETAINED if more else Condition.CONTEXT
        name = names.get(process, f"pid {pid}")
        kept.append(Blocker(None, name, count, state, 0, condition, pid=pid))
    for stowaway in ledger.stowaways.values():
        pid = stowaway.process.pid
        if pid != waiter.process.pid:
            name, count = stowaway.name or f"pid {pid}", stowaway.held_bytes
            kept.append(Blocker(None, name, count, "stowaway", 0, Condition.STOWAWAY, pid=pid))
    return kept


# -- 2. situation ----------------------------------------------------------------------------------
def _situation(core: Core, gpu: Gpu, lease: Lease, position: int, *, blocked: bool) -> Situation:
    """Return the one thing that a request waits for now."""
    if position > 1:
        return Situation.BEHIND
    leaving = _leaving(gpu)
    if leaving and lease.request.planned_gpu == gpu.info.id:
        return Situation.MAKING_ROOM
    if admission.blocked(core, gpu):
        return Situation.BLOCKED
    if leaving:
        return Situation.MAKING_ROOM
    return Situation.NO_ROOM if blocked and not gpu.verifications else Situation.MEASURING


# -- 3. plan ---------------------------------------------------------------------------------------
def _steps(core: Core, gpu: Gpu, waiter: Lease) -> tuple[Step, ...]:
    """Return the next steps for a request, the nearest first, those without an instant last."""
    request, first = waiter.request, admission.front(core, gpu)
    found = _steps_of_head(core, gpu, waiter) if first is waiter else []
    if request.wait_timeout_s is not None:
        at = request.arrived_at + request.wait_timeout_s
        found.append(_step(core, NextAction.GIVE_UP, waiter, at, Because.TIMEOUT))
    return tuple(sorted(found, key=lambda step: inf if step.in_s is None else step.in_s))


def _steps_of_head(core: Core, gpu: Gpu, waiter: Lease) -> list[Step]:
    if not core.serving:
        ends = [core.leases[lease].expires_at for lease in core.recovering if lease in core.leases]
        at = max(ends, default=None)
        return [_step(core, NextAction.SERVE, None, at, Because.ACCOUNTED)]
    if gpu.failed_at is not None or gpu.sample is None:
        return [_next_reading(core, gpu, Because.UNREADABLE)]
    leaving = [_of_leaving(core, gpu, waiter, lease) for lease in _leaving(gpu)]
    found = _ends_of_loads(core, gpu) + leaving
    if found or admission.blocked(core, gpu):
        return found
    if admission.fits(gpu, waiter, admission.leaving(gpu)):
        return [_next_reading(core, gpu, Because.MEASUREMENT)]
    return _asks(core, gpu, waiter)


def _asks(core: Core, gpu: Gpu, waiter: Lease) -> list[Step]:
    """Return which holders will be revoked, and when: at the first instant at which a sufficient
    set may be."""
    going = admission.leaving(gpu)
    times = sorted({core.now, *victims.ask_times(core, gpu, waiter)})
    for at in times[: max(1, min(ASK_TIMES_MAX, WEIGHED_MAX // (1 + len(gpu.residents))))]:
        chosen = victims.choose_victims(core, gpu, waiter, going, at)
        if chosen is not None:
            return [
                _step(core, NextAction.ASK, victim, at, _ripens(core, waiter, victim, at))
                for victim in chosen
            ]
    if missing := [lease for lease in gpu.in_state(LeaseState.HELD) if not lease.attached]:
        last = max(missing, key=lambda lease: lease.expires_at)
        return [_step(core, NextAction.WAIT, last, last.expires_at, Because.NOT_BACK)]
    return [_step(core, NextAction.WAIT, None, None, Because.NO_VICTIM)]


def _ripens(core: Core, waiter: Lease, victim: Lease, at: float) -> Because:
    """Return why a holder can be revoked at an instant and not before."""
    if at <= core.now:
        return Because.NEXT_READING
    if at == victims.residency_ends_at(core, victim, waiter):
        return Because.RESIDENCY
    return Because.AGEING if victim.uses else Because.TOGETHER


def _of_leaving(core: Core, gpu: Gpu, waiter: Lease, leaving: Lease) -> Step:
    """Return the step of a holder whose room is being made."""
    verification = gpu.verifications.get(leaving.id)
    if verification is not None:
        latest_s = max(0.0, verification.deadline_at - core.now) or None
        because = Because.VERDICT if latest_s else Because.MEASURED_GONE
        step = _step(core, NextAction.MEASURE, leaving, verification.next_poll_at, because)
        return replace(step, latest_s=latest_s)
    eviction = leaving.departure.eviction
    if eviction is None or eviction.overdue:
        because = Because.HANGING if leaving.departure.hangs else Because.LEAVING
        return _step(core, NextAction.WAIT, leaving, None, because)
    unloads = leaving.state is LeaseState.UNLOADING
    at = (leaving.since if unloads else eviction.asked_at) + core.settings.revoke_deadline_s
    step = _step(core, NextAction.DEADLINE, leaving, at, Because.WAITS_ON)
    return replace(step, waiter=waiter.spec.consumer)


def _ends_of_loads(core: Core, gpu: Gpu) -> list[Step]:
    steps: list[Step] = []
    for lease in gpu.in_state(LeaseState.LOADING):
        end = lease.granted_at + (core.costs.learnt_s(lease.spec.consumer, "load_s") or 0.0)
        at = end if end > core.now else None
        steps.append(_step(core, NextAction.LOADED, lease, at, Because.ONE_LOAD))
    return steps


def _next_reading(core: Core, gpu: Gpu, because: Because) -> Step:
    times = [core.timers.get((kind, gpu.info.id)) for kind in ("verify", "probe")]
    at = min((time for time in times if time is not None), default=None)
    return _step(core, NextAction.READ, None, at, because)


def _step(
    core: Core, action: NextAction, lease: Lease | None, at: float | None, because: Because
) -> Step:
    """Return a step with, or of, a lease. `at` None: no instant is planned."""
    consumer, lease_id = ("", None) if lease is None else (lease.spec.consumer, lease.id)
    return Step(
        action, consumer, lease_id, None if at is None else max(0.0, at - core.now), because
    )


# -- 4. estimate -----------------------------------------------------------------------------------
def _eta_s(core: Core, gpu: Gpu, waiter: Lease, steps: Sequence[Step]) -> float | None:
    """Return the seconds until a request is loaded, if every phase takes as long as usual.

    None: a phase on the way was never seen, or nothing is planned.
    """
    load_s = core.costs.learnt_s(waiter.spec.consumer, "load_s")
    if load_s is None:
        return None
    emptied_s = _emptied_s(core, gpu)
    if emptied_s or (emptied_s is not None and admission.fits(gpu, waiter)):
        turn_s = _loaded_s(core, gpu)
        return None if turn_s is None else max(emptied_s, turn_s) + load_s
    left_s = 0.0
    asked = [step for step in steps if step.action is NextAction.ASK]
    for step in asked:
        usual_s = _usual_s(core, step.consumer, LeaseState.REVOKING)
        if usual_s is None:
            return None
        left_s = max(left_s, (step.in_s or 0.0) + usual_s)
    return load_s + left_s if asked else None


def _eta_behind_s(core: Core, gpu: Gpu, lease: Lease) -> float | None:
    """Return the seconds until a request behind others is loaded: they load first, one by one.

    None: as for `_eta_s`, or one of those ahead has to leave for it, at a time that nothing tells.
    """
    queued = list(islice(gpu.queue, BEHIND_MAX))
    if lease not in queued:
        return None
    head, *others = together = queued[: queued.index(lease) + 1]
    if any(one.spec.exclusive for one in together):
        return None
    steps = _steps(core, gpu, head)
    going = admission.leaving(gpu)
    going |= {one: core.leases[one].residue_bytes for one in _asked(steps)}
    joining: Counter[ProcessKey] = Counter()
    for one in together:
        joining.update(dict(admission.joining(one)))
    if gpu.ledger.total_if(going, joining.items()) > gpu.ledger.budget_bytes:
        return None
    loads = [core.costs.learnt_s(one.spec.consumer, "load_s") for one in others]
    known = [_eta_s(core, gpu, head, steps), *loads]
    return sum(one for one in known if one is not None) if None not in known else None


def _asked(steps: Sequence[Step]) -> list[LeaseId]:
    return [LeaseId(one.lease_id) for one in steps if one.action is NextAction.ASK and one.lease_id]


def _loaded_s(core: Core, gpu: Gpu) -> float | None:
    """Return the seconds until the loads in progress are over; None: one was never seen, or takes
    longer than usual."""
    times = [step.in_s for step in _ends_of_loads(core, gpu)]
    return None if None in times else max((one for one in times if one is not None), default=0.0)


def _emptied_s(core: Core, gpu: Gpu) -> float | None:
    """Return the seconds until the last of the leaving holders is measured gone."""
    slowest_s = 0.0
    for one in _leaving(gpu):
        usual_s = _usual_s(core, one.spec.consumer, one.state)
        if usual_s is None:
            return None
        slowest_s = max(slowest_s, usual_s - (core.now - one.since))
    return slowest_s


def _usual_s(core: Core, consumer: str, state: LeaseState) -> float | None:
    """Return how long a consumer takes from a state until its bytes are measured gone."""
    times = [core.costs.learnt_s(consumer, phase) for phase in _PHASES_LEFT[state]]
    known = [seconds for seconds in times if seconds is not None]
    return sum(known) if len(known) == len(times) else None


def _leaving(gpu: Gpu) -> list[Lease]:
    return [lease for lease in gpu.residents.values() if lease.state in LEAVING]
