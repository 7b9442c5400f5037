"""Answers to `why`: what a lease waits for, what is in its way, and what happens next.

`explain` composes them in this order, as codes and values without words:
  1. blockers: the bytes of each holder, and the condition on which they come free
  2. situation: the one thing that the lease waits for now
  3. plan: the next steps of the arbiter, and the instants at which they are planned (`outlook`)
  4. estimate: seconds until the lease is loaded, from learned medians (`outlook`)
Reads only, and only when asked.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from heapq import nlargest

from vram_arbiter.arbiter.core import learning, standby
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import AWAY, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.report.outlook import Outlook
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.arbiter.core.scheduling.victims import Choice
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.explained import (
    Blocker,
    Condition,
    Explanation,
    LeaseDetail,
    Return,
    Situation,
    WhyReply,
)

EXPLAINED_MAX = 8
"""Leases of one answer to `why`."""

BLOCKERS_MAX = 32
"""Blockers of one waiter that are listed; of more, the largest holders."""

LONG_LOAD_S = 10.0
"""From then on the progress of a load is shown, and for how long it has not grown."""


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
    shown: list[LeaseDetail] = []
    for lease in (core.leases[LeaseId(lease_id)] for lease_id in lease_ids):
        sizes, waits = lease.spec.footprint, lease.state is LeaseState.QUEUED or lease.state in AWAY
        peak = lease.state in (LeaseState.QUEUED, LeaseState.LOADING)
        detail = LeaseDetail(
            lease_id=lease.id,
            declared_bytes=sizes.load_peak_bytes if peak else sizes.steady_bytes,
            measured_bytes=learning.held_bytes(core.gpus, lease) or None,
            why=explain(core, lease, plan=True, brief=True) if waits else None,
        )
        shown.append(detail)
    return tuple(shown)


def explain(core: Core, lease: Lease, *, plan: bool = False, brief: bool = False) -> Explanation:
    """Explain one lease: what it needs, what is in its way, and when it is loaded.

    `plan`: with the next steps. They also give an estimate where no holder was revoked yet.
    `brief`: without the blockers of a request behind others, which are the head's own.
    """
    gpu, away = _gpu_of(core.gpus, lease), lease.state in AWAY
    block = core.blocked(gpu)
    told = Explanation(
        lease_id=lease.id,
        consumer=lease.spec.consumer,
        state=lease.state,
        position=0,
        needed_bytes=0,
        free_bytes=max(0, gpu.ledger.budget_bytes - gpu.ledger.total_bytes()),
        deficit_bytes=0,
        condition=Situation.AWAY if away else Situation.RESIDENT,
        blockers=(),
        eta_s=None,
        eta_source="none",
        footprint=learning.footprint(core.footprints, core.gpus, lease),
        plan=(),
        block=status.block_view(core, gpu),
    )
    if away:
        return _explain_away(told, lease, gpu, block, core.now)
    choice = Choice.of(core)
    if lease.state is not LeaseState.QUEUED:
        eviction = lease.departure.eviction
        return replace(
            told,
            holder=_holder(choice, gpu, lease),
            revoked=None if eviction is None else eviction.why,
            drifted=bool(learning.drift_bytes(core.gpus, lease)),
        )
    position = status.position(core.gpus, lease)
    names = {client.process: client.name for client in core.clients.values()}
    told = replace(told, position=position, ahead=ahead_of(core.gpus, lease))
    told = _explain_waiter(told, lease, gpu, block, choice, names, brief=brief)
    recovered = [core.leases[one].expires_at for one in core.recovering if one in core.leases]
    outlook = Outlook(
        gpu,
        choice,
        core.timers,
        admission.front(core.gpus, gpu),
        block,
        max(recovered, default=None),
    )
    steps = outlook.steps(lease) if plan else ()
    eta_s = outlook.eta_s(lease, steps) if position <= 1 else outlook.eta_behind_s(lease)
    return replace(told, plan=steps, eta_s=eta_s, eta_source="none" if eta_s is None else "learnt")


def _gpu_of(gpus: Mapping[GpuId, Gpu], lease: Lease) -> Gpu:
    """Return where a lease is, where room is made for it, or where it may be placed first."""
    return gpus[lease.gpu or lease.request.planned_gpu or lease.request.gpus[0]]


def _explain_away(
    told: Explanation, lease: Lease, gpu: Gpu, block: Block | None, now: float
) -> Explanation:
    """Tell what a lease that is away waits for on the first GPU that it may return to."""
    head, due_at = gpu.queue.head, standby.quiet_at(gpu, lease)
    if not lease.attached:
        return replace(told, back=Return.HOLDER)
    if not lease.standby.comes_back:
        return replace(told, back=Return.ASKED)
    if head is not None:
        return replace(told, back=Return.BEHIND, ahead=head.spec.consumer)
    if block:
        return replace(told, back=Return.BLOCKED)
    if standby.left_for_is_here(gpu, lease):
        return replace(told, back=Return.LEFT_FOR, ahead=lease.standby.left_for)
    if not admission.fits(gpu, lease):
        return replace(told, back=Return.NO_ROOM)
    if due_at > now:
        return replace(told, back=Return.QUIET, due_s=due_at - now)
    return replace(told, back=Return.READING)


def _explain_waiter(
    told: Explanation,
    lease: Lease,
    gpu: Gpu,
    block: Block | None,
    choice: Choice,
    names: Mapping[ProcessKey, str],
    *,
    brief: bool,
) -> Explanation:
    request, needed = lease.request, admission.added_bytes(gpu, lease)
    deficit = max(0, needed - (gpu.ledger.budget_bytes - gpu.ledger.total_bytes()))
    raised = request.load_peak_bytes > lease.spec.footprint.load_peak_bytes
    blockers: tuple[Blocker, ...] = ()
    if told.position <= 1 or not brief:
        blockers = _blockers(choice, gpu, lease, names, deficit)
    situation = _situation(gpu, lease, told.position, block, blocked=bool(blockers))
    going = gpu.leaving() if situation is Situation.MAKING_ROOM else ()
    return replace(
        told,
        needed_bytes=needed,
        deficit_bytes=deficit,
        condition=situation,
        blockers=blockers,
        wait=request.reason,
        leaving=tuple(_holder(choice, gpu, one) for one in going),
        measuring=tuple(one.consumer for one in gpu.verifications.values()),
        expected_bytes=request.load_peak_bytes if raised else None,
    )


def ahead_of(gpus: Mapping[GpuId, Gpu], lease: Lease) -> str:
    """Return the consumer of the request before this one; "" for the head, which alone has
    blockers of its own."""
    if status.position(gpus, lease) <= 1:
        return ""
    before = _gpu_of(gpus, lease).queue.ahead_of(lease)
    return before.spec.consumer if before else "others"


# -- 1. blockers -----------------------------------------------------------------------------------
def _blockers(
    choice: Choice, gpu: Gpu, waiter: Lease, names: Mapping[ProcessKey, str], deficit: int
) -> tuple[Blocker, ...]:
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
    holders = [_holder(choice, gpu, lease, waiter) for lease in residents]
    return tuple([*holders, *_keepers(gpu, waiter, names)][:BLOCKERS_MAX])


def _holder(choice: Choice, gpu: Gpu, lease: Lease, waiter: Lease | None = None) -> Blocker:
    """Return a resident lease as it stands in a waiter's way, or for itself."""
    condition, seconds = _condition(choice, lease, waiter)
    long = condition is Condition.LOADING and choice.now - lease.granted_at >= LONG_LOAD_S
    quiet_s = choice.now - max(lease.observed.grew_at, lease.granted_at)
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
    aged = waiter.priority_at(choice.now, choice.settings.ageing_s_per_point)
    return replace(blocker, priority=lease.spec.priority, waiter_priority=aged)


def _condition(
    choice: Choice, lease: Lease, waiter: Lease | None
) -> tuple[Condition, float | None]:
    """Return on which condition a holder's bytes come free, and its seconds."""
    match lease.state:
        case LeaseState.LOADING:
            return Condition.LOADING, choice.now - lease.granted_at
        case LeaseState.REVOKING:
            eviction = lease.departure.eviction
            return Condition.REVOKED, choice.now - (eviction.asked_at if eviction else lease.since)
        case LeaseState.UNLOADING:
            hangs = Condition.HANGING if lease.departure.hangs else Condition.UNLOADING
            return hangs, choice.now - lease.since
        case LeaseState.VERIFYING:
            return Condition.MEASURED, None
    if not lease.attached:
        return Condition.NOT_BACK, lease.expires_at - choice.now
    if not lease.evictable:
        return Condition.PINNED, None
    if waiter is not None:
        ends_at = choice.residency_ends_at(lease, waiter)
        if ends_at > choice.now:
            stretched = ends_at > lease.ready_at + lease.spec.min_residency_s
            return (Condition.THRASHING if stretched else Condition.RESIDENCY), ends_at - choice.now
        aged = waiter.priority_at(choice.now, choice.settings.ageing_s_per_point)
        if lease.uses and lease.spec.priority > aged:
            return Condition.PRIORITY, None
    if lease.uses:
        return Condition.IN_USE, choice.now - next(iter(lease.uses.values())).began_at
    return Condition.IDLE, None


def _keepers(gpu: Gpu, waiter: Lease, names: Mapping[ProcessKey, str]) -> list[Blocker]:
    """List processes without a resident lease that hold bytes: contexts of live processes, debts,
    stowaways."""
    ledger = gpu.ledger
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
def _situation(
    gpu: Gpu, lease: Lease, position: int, block: Block | None, *, blocked: bool
) -> Situation:
    """Return the one thing that a request waits for now."""
    if position > 1:
        return Situation.BEHIND
    leaving = gpu.leaving()
    if leaving and lease.request.planned_gpu == gpu.info.id:
        return Situation.MAKING_ROOM
    if block:
        return Situation.BLOCKED
    if leaving:
        return Situation.MAKING_ROOM
    return Situation.NO_ROOM if blocked and not gpu.verifications else Situation.MEASURING
