"""Views of leases and GPUs, `status`, `why`, and the record of a switch: typed data without words.
Reads only."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from heapq import merge, nsmallest
from itertools import chain, islice
from math import inf
from operator import attrgetter
from statistics import median
from typing import Any

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.model.lease import AWAY, LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report import outlook
from vram_arbiter.arbiter.core.report.blockers import holder, who_blocks
from vram_arbiter.arbiter.core.report.standing import Standing, standing_of
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.explained import (
    Blocker,
    Explanation,
    NextAction,
    Situation,
    Step,
    WhyReply,
)
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import (
    BlockView,
    GpuView,
    HostRamView,
    LeaseView,
    ProcessView,
    Totals,
)

NOTE_KINDS: tuple[str, ...] = (
    "queued", "granted", "ready", "switch", "use_began", "use_ended", "use_yielded", "revoke_asked",
    "revoke_acked", "reminded",
    "deadline_passed", "unloading", "released", "verified", "denied", "refused", "cancelled",
    "expired", "lost", "reattached", "oom",
    "pressure", "stowaway", "probe_failed", "probe_ok", "drift", "journal_failed", "recovered",
    "serving", "operator", "resumed",
    "standby", "parked", "gang", "signalled", "resized",
)  # fmt: skip
"""Every kind of `effects.Note`. `switch` comes with each `ready`; its field `switched` says whether
anybody had to leave."""

DAEMON_KINDS: tuple[str, ...] = (
    "started",
    "stopped",
    "journal_put_aside",
    "record_stopped",
    "record_resumed",
)
"""What the daemon itself adds to the history: its starts and ends, and what is wrong with its own
files."""


type PageKey = tuple[int, float, int]
"""Where `status` goes on: waiters (1) after all others (0), rank in the queues, arrival."""


EXPLAINED_MAX = 8
"""Leases of one answer to `why`."""
MISSING_NAMED = 3
"""Holders that have not reattached and are named; the others are counted."""


# -- views
def view_for(core: Core, lease: Lease, reader: ProcessKey | None) -> LeaseView:
    """A lease as `reader` may see it.

    Its token is shown to the holder's process and to an operator (None) only: a token is all that
    is needed to mark a use, which keeps a lease from being evicted.
    """
    shown = view(core, lease)
    return shown if reader is None or reader == lease.process else replace(shown, token=None)


def view(core: Core, lease: Lease) -> LeaseView:
    """A lease as its holder or an operator may see it."""
    gpu = None if lease.gpu is None else core.gpus[lease.gpu]
    queued = lease.state is LeaseState.QUEUED
    shown: dict[str, Any] = {}
    for feature in lease.features:
        shown.update(feature.view(core, lease))
    if queued:
        shown["position"] = _best_position(core, lease)
    elif gpu is not None and lease.state is not LeaseState.VERIFYING:
        shown["drift_bytes"] = drift.drift_bytes(core, gpu, lease)
        shown["ttl_left_s"] = max(0.0, lease.expires_at - core.now)
    return LeaseView(
        lease_id=lease.id,
        token=lease.token,
        state=lease.state,
        consumer=lease.spec.consumer,
        model=str(lease.spec.key),
        gpu=lease.gpu,
        mode="exclusive" if lease.spec.exclusive else "shared",
        priority=lease.spec.priority,
        evictable=lease.evictable,
        charge_bytes=_charge_bytes(lease, gpu),
        uses=len(lease.uses),
        pid=lease.process.pid,
        since_s=core.now - lease.since,
        waited_s=(core.now if queued else lease.granted_at) - lease.request.arrived_at,
        granted_s=None if lease.token is None else core.now - lease.held_from,
        pinned="" if lease.pinned is None else str(lease.pinned),
        yielded=len(lease.uses.paused),
        **shown,
    )


def _charge_bytes(lease: Lease, gpu: Gpu | None) -> int:
    """What is charged, or will be; nothing for a lease that is away."""
    if gpu is not None:
        return gpu.ledger.charge_bytes(lease.id)
    return 0 if lease.state in AWAY else lease.request.load_peak_bytes


def gpu_view(core: Core, gpu: Gpu) -> GpuView:
    """A GPU: what is charged, measured and blocked."""
    ledger = gpu.ledger
    known = gpu.sample is not None and gpu.failed_at is None
    return GpuView(
        gpu=gpu.info.id,
        index=gpu.info.index,
        name=gpu.info.name,
        source=gpu.info.source,
        capacity_bytes=gpu.info.capacity_bytes,
        reserve_bytes=gpu.info.reserve_bytes,
        charged_bytes=ledger.booked_bytes(),
        stowaway_bytes=ledger.stowaway_bytes(),
        measured_used_bytes=gpu.sample.used_bytes if known and gpu.sample is not None else None,
        sample_age_s=None if gpu.sample is None else core.now - gpu.sample.taken_at,
        pressure_bytes=ledger.pressure_bytes(),
        blocked=block_view(core, gpu),
        processes=tuple(_processes(gpu)),
    )


def block_view(core: Core, gpu: Gpu) -> BlockView | None:
    """Why nothing is granted on a GPU now, with its values; None if grants are possible."""
    code = admission.blocked(core, gpu) or gpu.blocked
    match code:
        case None:
            return None
        case Block.RECOVERING:
            missing = core.recovering or ()
            known = [core.leases[one] for one in sorted(missing) if one in core.leases]
            names = tuple(f"{one.spec.consumer} (pid {one.process.pid})" for one in known)
            return BlockView(code, names[:MISSING_NAMED], more=len(names[MISSING_NAMED:]))
        case Block.DRAINED:
            return BlockView(code, problem=str(core.drain))
        case Block.UNREADABLE:
            return BlockView(code, problem=gpu.failure)
        case Block.LOADING:
            loading = gpu.in_state(LeaseState.LOADING)[:1]
            return BlockView(code, tuple(one.spec.consumer for one in loading))
        case Block.GANG:
            return BlockView(code, (admission.kept_by(gpu),))
        case Block.PRESSURE:
            return BlockView(code, bytes=gpu.ledger.pressure_bytes())
        case _:
            return BlockView(code)


def _processes(gpu: Gpu) -> Iterator[ProcessView]:
    listed: dict[int, ProcessUse] = {}
    if gpu.sample is not None:
        listed = {use.process.pid: use for use in gpu.sample.listed}
    for account in gpu.ledger.accounts.values():
        use = listed.get(account.process.pid)
        yield ProcessView(
            pid=account.process.pid,
            name="" if use is None else use.name,
            used_bytes=None if use is None else use.used_bytes,
            lease_ids=tuple(sorted(account.charges)),
            charged_bytes=account.booked_bytes(),
            residue_bytes=account.residue_bytes,
            stowaway=False,
        )
    for stowaway in gpu.ledger.strangers.values():
        pid, used = stowaway.process.pid, stowaway.used_bytes
        yield ProcessView(pid, stowaway.name, used, (), 0, 0, stowaway=True)


def status(
    core: Core,
    host_ram: HostRamView,
    reader: ProcessKey | None = None,
    after: PageKey | None = None,
    limit: int | None = None,
) -> StatusReply:
    """Return the status with the leases that follow `after`, at most `limit` of them.

    A page costs what it holds, however many wait: the queues are sorted already. `reader`: see
    `view_for`.
    """
    leases = list(islice(_listed(core, after, limit), limit))
    more = leases and len(leases) == limit
    return StatusReply(
        epoch=core.settings.epoch,
        phase="serving" if core.recovering is None else "recovering",
        uptime_s=core.now - core.started_at,
        gpus=tuple(gpu_view(core, gpu) for gpu in core.gpus.values()),
        leases=tuple(view_for(core, lease, reader) for lease in leases),
        totals=Totals(leases=len(core.leases), waiting=len(core.waiting)),
        clients=len(core.clients),
        host_ram=host_ram,
        drained="" if core.drain is None else str(core.drain),
        problems=(),
        next=_page_key(core, leases[-1]) if more else None,
    )


def _page_key(core: Core, lease: Lease) -> PageKey:
    if lease.state is not LeaseState.QUEUED:
        return (0, 0.0, lease.request.arrival)
    return (1, *core.gpus[lease.request.gpus[0]].queue.rank(lease))


def _listed(core: Core, after: PageKey | None, limit: int | None) -> Iterator[Lease]:
    """Leases with bytes or away by arrival, then the waiters in the order of the queues."""
    section, rank, arrival = after or (0, 0.0, 0)
    if section == 0:
        granted = chain(*(gpu.residents.values() for gpu in core.gpus.values()), _away(core))
        rest = (lease for lease in granted if lease.request.arrival > arrival)
        by_arrival = attrgetter("request.arrival")
        yield from (
            sorted(rest, key=by_arrival)
            if limit is None
            else nsmallest(limit, rest, key=by_arrival)
        )
    yield from _in_queues(core, (rank, arrival) if section else (-inf, 0))


def _away(core: Core) -> Iterator[Lease]:
    for feature in core.hooked["unplaced"]:
        yield from (one for one in feature.unplaced() if one.state is not LeaseState.QUEUED)


def _in_queues(core: Core, after: tuple[float, int]) -> Iterator[Lease]:
    """Waiters in the order of the queues, each once. Those that a feature keeps out of the queues
    are listed at their rank."""

    def rank(lease: Lease) -> tuple[float, int]:
        return core.gpus[lease.request.gpus[0]].queue.rank(lease)

    unqueued = [
        lease
        for feature in core.hooked["unplaced"]
        for lease in feature.unplaced()
        if lease.state is LeaseState.QUEUED and rank(lease) > after
    ]
    queued = [gpu.queue.after(after) for gpu in core.gpus.values()]
    last: Lease | None = None
    for lease in merge(sorted(unqueued, key=rank), *queued, key=rank):
        if lease is not last:  # else it waits for several GPUs
            yield lease
        last = lease


def _best_position(core: Core, lease: Lease) -> int:
    """Its best place in a queue; 0: it is in none."""
    places = [
        core.gpus[gpu_id].queue for gpu_id in lease.request.gpus if lease in core.gpus[gpu_id].queue
    ]
    return min((queue.position(lease) for queue in places), default=0)


# -- why
def why(core: Core, consumer: str) -> WhyReply:
    """Explain why a consumer is not running, or that it is. A lease's id stands for that lease.

    Of a consumer with many leases the oldest are explained: each costs a search for victims.
    """
    named = core.leases.get(LeaseId(consumer))
    mine = (
        [named] if named else [one for one in core.leases.values() if one.spec.consumer == consumer]
    )
    told = tuple(_with_plan(core, lease) for lease in mine[:EXPLAINED_MAX])
    return WhyReply(consumer, told, more=len(mine[EXPLAINED_MAX:]))


def _with_plan(core: Core, lease: Lease) -> Explanation:
    """Explain a lease with the steps to come; they also give an estimate where no holder was
    revoked yet."""
    told = explain_lease(core, lease)
    if lease.state is not LeaseState.QUEUED:
        return told
    standing = standing_of(core, lease)
    plan = outlook.steps(core, standing, lease)
    told = replace(told, plan=tuple(plan))
    if told.eta_s is None and (eta := _eta_of_plan(core, standing, plan)) is not None:
        return replace(told, eta_s=eta, eta_source="learnt")
    return told


def _eta_of_plan(core: Core, standing: Standing, plan: Sequence[Step]) -> float | None:
    """Seconds until it is loaded if every holder to be revoked takes as long as usual. None: never
    seen, or nothing planned."""
    load = _load_s(core, standing)
    ends: list[float] = []
    for step in plan:
        if step.action is NextAction.ASK:
            phases = [
                core.learnt_s(step.consumer, phase) for phase in ("drain_s", "unload_s", "verify_s")
            ]
            known = [seconds for seconds in phases if seconds is not None]
            if len(known) < len(phases):
                return None
            ends.append((step.in_s or 0.0) + sum(known))
    return load + max(ends) if load is not None and ends else None


def explain_lease(core: Core, lease: Lease) -> Explanation:
    """One lease: what it needs, what is in its way on which condition, and when it is loaded."""
    standing = standing_of(core, lease)
    gpu, kept = standing.gpu, standing.reserved_bytes
    free = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
    if lease.state is not LeaseState.QUEUED:
        return _explain_resident(core, standing, lease, free)
    free += kept
    added = lease.request.load_peak_bytes if kept else admission.added_bytes(gpu, standing.request)
    deficit = max(0, added - free)
    position = _place(core, standing)
    blockers = who_blocks(core, gpu, standing.request, deficit)
    leaving = _leaving(core, gpu)
    condition = _situation(core, standing, lease, position, blocked=bool(blockers))
    eta = _eta(core, standing, lease)
    raised = lease.request.load_peak_bytes > lease.spec.load_peak_bytes
    return Explanation(
        lease_id=lease.id,
        consumer=lease.spec.consumer,
        state=lease.state,
        position=position,
        needed_bytes=added,
        free_bytes=max(0, free),
        deficit_bytes=deficit,
        condition=condition,
        blockers=blockers,
        eta_s=eta,
        eta_source="none" if eta is None else "learnt",
        footprint=drift.footprint(core, lease),
        plan=(),
        ahead=behind(core, lease),
        wait=lease.request.reason,
        block=block_view(core, gpu),
        leaving=leaving if condition is Situation.MAKING_ROOM else (),
        measuring=tuple(one.consumer for one in gpu.verifications.values()),
        kept=bool(kept),
        expected_bytes=lease.request.load_peak_bytes if raised else None,
        gang=standing.gang,
    )


def _place(core: Core, standing: Standing) -> int:
    """Its place in the queue; a gang has the place of its foremost member."""
    return min(_best_position(core, member) for member in standing.fellows)


def behind(core: Core, lease: Lease) -> str:
    """Return the consumer of the request before this one, "" if there is none: only the head has
    blockers of its own."""
    standing = standing_of(core, lease)
    if _place(core, standing) <= 1:
        return ""
    foremost = min(standing.fellows, key=lambda member: _best_position(core, member))
    ahead = standing_of(core, foremost).gpu.queue.ahead_of(foremost)
    return core.waiting[ahead].spec.consumer if ahead else "others"


def blocked_for(core: Core, lease: Lease) -> BlockView | None:
    """Why nothing is granted on the GPU that a request waits for."""
    return block_view(core, standing_of(core, lease).gpu)


def _explain_resident(core: Core, standing: Standing, lease: Lease, free: int) -> Explanation:
    gpu = standing.gpu
    away = lease.state in AWAY
    return Explanation(
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
        footprint=drift.footprint(core, lease),
        plan=(),
        ahead=standing.ahead,
        block=block_view(core, gpu),
        gang=standing.gang,
        lacks=tuple(holder(core, standing_of(core, one).gpu, one) for one in standing.lacks),
        holder=None if away else holder(core, gpu, lease),
        revoked=None if lease.departure.eviction is None else lease.departure.eviction.why,
        drifted=bool(drift.drift_bytes(core, gpu, lease)),
        back=standing.back,
        due_s=standing.due_s,
    )


def _situation(
    core: Core, standing: Standing, lease: Lease, position: int, *, blocked: bool
) -> Situation:
    gpu = standing.gpu
    if standing.gang is not None and position <= 1:
        phases = {"gathering": Situation.GATHERING, "loading": Situation.GANG_LOADS}
        return phases.get(standing.gang.phase, Situation.GANG_WAITS)
    if position > 1:
        return Situation.BEHIND
    leaving = any(other.state in LEAVING for other in gpu.residents.values())
    if leaving and lease.request.planned_gpu == gpu.info.id:
        return Situation.MAKING_ROOM
    if admission.blocked(core, gpu):
        return Situation.BLOCKED
    if leaving:
        return Situation.MAKING_ROOM
    if blocked and not gpu.verifications:
        return Situation.NO_ROOM
    return Situation.MEASURING


def _leaving(core: Core, gpu: Gpu) -> tuple[Blocker, ...]:
    residents = gpu.residents.values()
    return tuple(holder(core, gpu, other) for other in residents if other.state in LEAVING)


def _load_s(core: Core, standing: Standing) -> float | None:
    """How long its load usually takes, with those of its gang that load before it. None: never
    seen, or not known yet."""
    if standing.loads is None:
        return None
    times = [core.learnt_s(one.spec.consumer, "load_s") for one in standing.loads]
    known = [seconds for seconds in times if seconds is not None]
    return sum(known) if len(known) == len(times) else None


def _eta(core: Core, standing: Standing, lease: Lease) -> float | None:
    """Seconds until it is loaded, from learnt medians. None if anything on the way was
    never seen."""
    gpu = standing.gpu
    slowest = 0.0
    for other in gpu.residents.values():
        if other.state not in LEAVING:
            continue
        phases = {
            LeaseState.REVOKING: ("drain_s", "unload_s", "verify_s"),
            LeaseState.UNLOADING: ("unload_s", "verify_s"),
            LeaseState.VERIFYING: ("verify_s",),
        }[other.state]
        times = [core.learnt_s(other.spec.consumer, phase) for phase in phases]
        known = [seconds for seconds in times if seconds is not None]
        if len(known) < len(times):
            return None
        slowest = max(slowest, sum(known) - (core.now - other.since))
    load = _load_s(core, standing)
    kept = lease.id in gpu.ledger.reserved
    if load is None or (not slowest and not kept and not admission.fits(gpu, standing.request)):
        return None
    return max(0.0, slowest) + load


def medians(core: Core) -> dict[str, dict[str, float]]:
    """What was learnt, in the shape of `Settings.learnt`."""
    return {
        consumer: {phase: median(seen) for phase, seen in phases.items()}
        for consumer, phases in core.durations.items()
    }


# -- switch
def switch_record(core: Core, lease: Lease) -> dict[str, Any]:
    """Milliseconds of a grant from the acquire to `ready`, split by phase; of several victims the
    slowest counts."""
    gone = lease.request.evicted
    first_asked = min((e.asked_at for e in gone), default=lease.granted_at)
    return {
        "switched": bool(gone),
        "evicted": [
            {
                "consumer": e.consumer,
                "lease_id": e.lease,
                "verdict": e.verdict,
                "charge_bytes": e.charge_bytes,
            }
            for e in gone
        ],
        "verified": all(e.verdict == "verified" for e in gone),
        "wait_ms": max(0.0, first_asked - lease.request.arrived_at) * 1e3,
        "drain_ms": max((_span(e.asked_at, e.unloading_at) for e in gone), default=0.0),
        "unload_ms": max((_span(e.unloading_at, e.released_at) for e in gone), default=0.0),
        "verify_ms": max((_span(e.released_at, e.verdict_at) for e in gone), default=0.0),
        "load_ms": (core.now - lease.granted_at) * 1e3,
        "total_ms": (core.now - lease.request.arrived_at) * 1e3,
    }


def _span(start: float | None, end: float | None) -> float:
    return 0.0 if start is None or end is None else max(0.0, end - start) * 1e3
