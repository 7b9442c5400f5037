"""Answers for people and programs: views of leases, `status`, `why`, and the record of a switch. Reads only."""

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge, nsmallest
from itertools import chain, islice
from math import inf
from operator import attrgetter
from statistics import median
from typing import Any

from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.model.lease import AWAY, LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report import outlook
from vram_arbiter.arbiter.core.report.blockers import (
    ago,
    gib,
    loading,
    unloading,
    uses,
    who_blocks,
)
from vram_arbiter.arbiter.core.report.standing import Standing, standing_of
from vram_arbiter.arbiter.core.scheduling import policy
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

NOTE_KINDS: tuple[str, ...] = (
    "queued", "granted", "ready", "switch", "use_began", "use_ended", "use_yielded", "revoke_asked", "revoke_acked", "reminded",
    "deadline_passed", "unloading", "released", "verified", "denied", "refused", "cancelled", "expired", "lost", "reattached", "oom",
    "pressure", "stowaway", "probe_failed", "probe_ok", "drift", "journal_failed", "recovered", "serving", "operator", "resumed",
    "standby", "parked", "gang", "signalled", "resized",
)  # fmt: skip
"""Every kind of `effects.Note`. `switch` comes with each `ready`; its field `switched` says whether anybody had to leave."""

DAEMON_KINDS: tuple[str, ...] = (
    "started",
    "stopped",
    "journal_put_aside",
    "record_stopped",
    "record_resumed",
)
"""What the daemon itself adds to the history: its starts and ends, and what is wrong with its own files."""


type PageKey = tuple[int, float, int]
"""Where `status` goes on: waiters (1) after all others (0), rank in the queues, arrival."""


EXPLAINED_MAX = 8
"""Leases of one answer to `why`."""


# -- views -------------------------------------------------------------------------------------------------------------
def view_for(core: Core, lease: Lease, reader: ProcessKey | None) -> dict[str, Any]:
    """A lease as `reader` may see it: its token is shown to the holder's process and to an operator (None) only, since a token is all
    that is needed to mark a use, which keeps a lease from being evicted."""
    shown = view(core, lease)
    if reader is not None and reader != lease.process:
        shown["token"] = None
    return shown


def view(core: Core, lease: Lease) -> dict[str, Any]:
    """`schemas.wire.LeaseView`, for the lease's holder or an operator."""
    gpu = None if lease.gpu is None else core.gpus[lease.gpu]
    shown: dict[str, Any] = {
        "lease_id": lease.id,
        "token": None if lease.token is None else [lease.token.epoch, lease.token.serial],
        "state": str(lease.state),
        "consumer": lease.spec.consumer,
        "model": str(lease.spec.key),
        "gpu": lease.gpu,
        "mode": "exclusive" if lease.spec.exclusive else "shared",
        "priority": lease.spec.priority,
        "evictable": lease.evictable,
        "charge_bytes": _charge_bytes(lease, gpu),
        "uses": len(lease.uses),
        "pid": lease.process.pid,
        "since_s": core.now - lease.since,
        "waited_s": (core.now if lease.state is LeaseState.QUEUED else lease.granted_at)
        - lease.request.arrived_at,
    }
    if lease.token is not None:
        shown["granted_s"] = core.now - lease.held_from
    if lease.pinned is not None:
        shown["pinned"] = str(lease.pinned)
    if lease.uses.paused:
        shown["yielded"] = len(lease.uses.paused)
    for feature in lease.features:
        shown.update(feature.view(core, lease))
    if lease.state is LeaseState.QUEUED:
        shown["position"] = _best_position(core, lease)
    elif lease.state is not LeaseState.VERIFYING and lease.state not in AWAY:
        if drifted := drift.drift_bytes(core, core.gpu_of(lease), lease):
            shown["drift_bytes"] = drifted
        shown["ttl_left_s"] = max(0.0, lease.expires_at - core.now)
    return shown


def _charge_bytes(lease: Lease, gpu: Gpu | None) -> int:
    """What is charged, or will be; nothing for a lease that is away."""
    if gpu is not None:
        return gpu.ledger.charge_bytes(lease.id)
    return 0 if lease.state in AWAY else lease.request.load_peak_bytes


def gpu_view(core: Core, gpu: Gpu) -> dict[str, Any]:
    """`schemas.wire.GpuView`."""
    ledger = gpu.ledger
    known = gpu.sample is not None and gpu.failed_at is None
    return {
        "gpu": gpu.info.id,
        "index": gpu.info.index,
        "name": gpu.info.name,
        "source": gpu.info.source,
        "capacity_bytes": gpu.info.capacity_bytes,
        "reserve_bytes": gpu.info.reserve_bytes,
        "charged_bytes": ledger.booked_bytes(),
        "stowaway_bytes": ledger.stowaway_bytes(),
        "measured_used_bytes": gpu.sample.used_bytes if known and gpu.sample is not None else None,
        "sample_age_s": None if gpu.sample is None else core.now - gpu.sample.taken_at,
        "pressure_bytes": ledger.pressure_bytes(),
        "blocked": policy.blocked(core, gpu) or gpu.blocked,
        "processes": _processes(gpu),
    }


def _processes(gpu: Gpu) -> list[dict[str, Any]]:
    names: dict[int, tuple[str, int | None]] = {}
    if gpu.sample is not None:
        names = {use.process.pid: (use.name, use.used_bytes) for use in gpu.sample.listed}
    shown = [
        {
            "pid": account.process.pid,
            "name": names.get(account.process.pid, ("", None))[0],
            "used_bytes": names.get(account.process.pid, ("", None))[1],
            "lease_ids": sorted(account.charges),
            "charged_bytes": account.booked_bytes(),
            "residue_bytes": account.residue_bytes,
            "stowaway": False,
        }
        for account in gpu.ledger.accounts.values()
    ]
    shown += [
        {
            "pid": stranger.process.pid,
            "name": stranger.name,
            "used_bytes": stranger.used_bytes,
            "lease_ids": [],
            "charged_bytes": 0,
            "residue_bytes": 0,
            "stowaway": True,
        }
        for stranger in gpu.ledger.strangers.values()
    ]
    return shown


def status(
    core: Core,
    host_ram: Mapping[str, int],
    reader: ProcessKey | None = None,
    after: PageKey | None = None,
    limit: int | None = None,
) -> dict[str, Any]:
    """Return `schemas.wire.StatusReply` with the leases that follow `after`, at most `limit` of them.

    A page costs what it holds, however many wait: the queues are sorted already. `reader`: see `view_for`.
    """
    leases = list(islice(_listed(core, after, limit), limit))
    shown: dict[str, Any] = {
        "epoch": core.settings.epoch,
        "phase": "serving" if core.recovering is None else "recovering",
        "uptime_s": core.now - core.started_at,
        "gpus": [gpu_view(core, gpu) for gpu in core.gpus.values()],
        "leases": [view_for(core, lease, reader) for lease in leases],
        "totals": {"leases": len(core.leases), "waiting": len(core.waiting)},
        "clients": len(core.clients),
        "host_ram": dict(host_ram),
        "drained": "" if core.drain is None else str(core.drain),
    }
    if leases and len(leases) == limit:
        shown["next"] = list(_page_key(core, leases[-1]))
    return shown


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
    """Waiters in the order of the queues, each once. Those that a feature keeps out of the queues are listed at their rank."""

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


# -- why ---------------------------------------------------------------------------------------------------------------
def why(core: Core, consumer: str) -> dict[str, Any]:
    """`schemas.wire.WhyReply`: why a consumer is not running, or that it is. A lease's id stands for that lease.

    Of a consumer with many leases the oldest are explained: each costs a search for what may make room.
    """
    named = core.leases.get(LeaseId(consumer))
    mine = (
        [named] if named else [one for one in core.leases.values() if one.spec.consumer == consumer]
    )
    told: dict[str, Any] = {
        "consumer": consumer,
        "leases": [_with_plan(core, lease) for lease in mine[:EXPLAINED_MAX]],
    }
    if more := len(mine[EXPLAINED_MAX:]):
        told["more"] = more
    return told


def _with_plan(core: Core, lease: Lease) -> dict[str, Any]:
    """What happens next with its instant, where one is planned; it also gives an estimate where nobody was asked yet."""
    told = explain_lease(core, lease)
    told["plan"] = []
    if lease.state is LeaseState.QUEUED:
        standing = standing_of(core, lease)
        told["plan"] = plan = outlook.steps(core, standing, lease)
        if told["eta_s"] is None and (eta := _eta_of_plan(core, standing, plan)) is not None:
            told["eta_s"], told["eta_source"] = eta, "learnt"
    return told


def _eta_of_plan(core: Core, standing: Standing, plan: Sequence[dict[str, Any]]) -> float | None:
    """Seconds until it is loaded if everybody who is to be asked takes as long as usual. None: never seen, or nothing planned."""
    load = _load_s(core, standing)
    ends: list[float] = []
    for step in plan:
        if step["action"] == "ask":
            phases = [
                core.learnt_s(step["consumer"], phase)
                for phase in ("drain_s", "unload_s", "verify_s")
            ]
            known = [seconds for seconds in phases if seconds is not None]
            if len(known) < len(phases):
                return None
            ends.append(float(step["in_s"]) + sum(known))
    return load + max(ends) if load is not None and ends else None


def explain_lease(core: Core, lease: Lease) -> dict[str, Any]:
    """One lease: what it needs, who stands in its way on which condition, what happens next and when."""
    standing = standing_of(core, lease)
    gpu, kept = standing.gpu, standing.reserved_bytes
    free = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
    if lease.state is not LeaseState.QUEUED:
        return _explain_resident(core, standing, lease, free)
    free += kept
    added = lease.request.load_peak_bytes if kept else policy.added_bytes(gpu, standing.request)
    deficit = max(0, added - free)
    blockers = who_blocks(core, gpu, standing.request, deficit)
    position = _place(core, standing)
    condition, then = _condition(core, standing, lease, blockers, position)
    eta = _eta(core, standing, lease)
    together = f" with {standing.group}" if standing.request.request.needs is not None else ""
    head = f"{lease.spec.consumer}{together} needs {gib(added)}, {gib(max(0, free))} are free{' or kept for it' if kept else ''}"
    head += f", {gib(deficit)} are missing" if deficit else ""
    if lease.request.load_peak_bytes > (declared := lease.spec.load_peak_bytes):
        head += f" ({gib(declared)} declared, {gib(lease.request.load_peak_bytes)} learnt)"
    return {
        "lease_id": lease.id,
        "state": str(lease.state),
        "position": position,
        "needed_bytes": added,
        "free_bytes": max(0, free),
        "deficit_bytes": deficit,
        "condition": condition,
        "blockers": blockers,
        "next": then,
        "eta_s": eta,
        "eta_source": "none" if eta is None else "learnt",
        "footprint": drift.footprint(core, lease),
        "text": f"{head}: {then}",
    }


def _place(core: Core, standing: Standing) -> int:
    """Its place in the queue; a group has the place of its foremost member."""
    return min(_best_position(core, member) for member in standing.fellows)


def wait_reason(core: Core, lease: Lease) -> str:
    """Why a waiter waits, in words. Short for those who stand behind others: only the head has blockers of its own."""
    standing = standing_of(core, lease)
    position = _place(core, standing)
    if position > 1:
        return _behind(core, standing, position)
    return str(explain_lease(core, lease)["text"])


def _behind(core: Core, standing: Standing, position: int) -> str:
    who = f"waits as one of {standing.group}" if standing.group else "waits"
    foremost = min(standing.fellows, key=lambda member: _best_position(core, member))
    ahead = standing_of(core, foremost).gpu.queue.ahead_of(foremost)
    return f"{who} behind {core.waiting[ahead].spec.consumer if ahead else 'others'} as number {position}"


def _explain_resident(core: Core, standing: Standing, lease: Lease, free: int) -> dict[str, Any]:
    gpu = standing.gpu
    says = {
        LeaseState.LOADING: f"it was granted and {loading(core, lease)}",
        LeaseState.HELD: f"it is resident, {uses(lease)}",
        LeaseState.REVOKING: f"it was asked to leave for {_wanted_by(lease)}, {uses(lease)}",
        LeaseState.UNLOADING: f"it {unloading(core, lease)}",
        LeaseState.VERIFYING: "it let go; its bytes are being measured",
    }.get(lease.state, "")
    says = "; ".join(filter(None, (says, standing.outlook)))
    if drift.drift_bytes(core, gpu, lease):
        held = drift.held_bytes(gpu, lease)
        says += f"; it holds {gib(held)}, {gib(lease.spec.steady_bytes)} were declared"
    return {
        "lease_id": lease.id,
        "state": str(lease.state),
        "position": 0,
        "needed_bytes": 0,
        "free_bytes": max(0, free),
        "deficit_bytes": 0,
        "condition": str(lease.state),
        "blockers": [],
        "next": says,
        "eta_s": None,
        "eta_source": "none",
        "footprint": drift.footprint(core, lease),
        "text": f"{lease.spec.consumer}: {says}",
    }


def _condition(
    core: Core,
    standing: Standing,
    lease: Lease,
    blockers: Sequence[dict[str, Any]],
    position: int,
) -> tuple[str, str]:
    """(short condition, what happens next in words)."""
    gpu = standing.gpu
    if standing.condition and position <= 1:
        return standing.condition, standing.outlook
    leaving = [other for other in gpu.residents.values() if other.state in LEAVING]
    if position > 1:
        return "queued", _behind(core, standing, position)
    if leaving and lease.request.planned_gpu == gpu.info.id:
        return "room is being made", "; ".join(_leaving_next(core, gpu, other) for other in leaving)
    blocked = policy.blocked(core, gpu)
    if blocked:
        loads = [
            f"{one.spec.consumer} {loading(core, one)}"
            for one in gpu.in_state(LeaseState.LOADING)[:1]
        ]
        return (
            "blocked",
            f"waits: {loads[0] if loads and loads[0].startswith(blocked) else blocked}",
        )
    if leaving:
        return "room is being made", "; ".join(_leaving_next(core, gpu, other) for other in leaving)
    if gpu.verifications:
        names = ", ".join(v.consumer for v in gpu.verifications.values())
        return "measuring", f"waits until the bytes of {names} are measured gone"
    if blockers:
        return "no room", "waits for " + ", ".join(
            f"{b['consumer']} ({b['condition']})" for b in blockers
        )
    return "measuring", lease.request.reason or "waits for a reading of the card"


def _leaving_next(core: Core, gpu: Gpu, holder: Lease) -> str:
    charge = gib(gpu.ledger.charge_bytes(holder.id))
    name = holder.spec.consumer
    if holder.state is LeaseState.REVOKING and holder.uses:
        running = len(holder.uses)
        plural = "use" if running == 1 else "uses"
        return (
            f"waits for {name} to finish {running} {plural} (asked {ago(core, holder)}), "
            f"then it unloads and {charge} are verified"
        )
    if holder.state is LeaseState.REVOKING:
        return f"waits for {name} to unload (asked {ago(core, holder)}), then {charge} are verified"
    if holder.state is LeaseState.UNLOADING:
        return f"{name} {unloading(core, holder) if holder.departure.hangs else 'unloads'}, then {charge} are verified"
    return f"{charge} of {name} are being verified"


def _load_s(core: Core, standing: Standing) -> float | None:
    """How long its load usually takes, with those of its group that load before it. None: never seen, or not known yet."""
    if standing.loads is None:
        return None
    times = [core.learnt_s(one.spec.consumer, "load_s") for one in standing.loads]
    known = [seconds for seconds in times if seconds is not None]
    return sum(known) if len(known) == len(times) else None


def _eta(core: Core, standing: Standing, lease: Lease) -> float | None:
    """Seconds until it is loaded, from learnt medians. None if anything on the way was never seen."""
    gpu = standing.gpu
    slowest = 0.0
    for holder in gpu.residents.values():
        if holder.state not in LEAVING:
            continue
        phases = {
            LeaseState.REVOKING: ("drain_s", "unload_s", "verify_s"),
            LeaseState.UNLOADING: ("unload_s", "verify_s"),
            LeaseState.VERIFYING: ("verify_s",),
        }[holder.state]
        times = [core.learnt_s(holder.spec.consumer, phase) for phase in phases]
        known = [seconds for seconds in times if seconds is not None]
        if len(known) < len(times):
            return None
        slowest = max(slowest, sum(known) - (core.now - holder.since))
    load = _load_s(core, standing)
    kept = lease.id in gpu.ledger.reserved
    if load is None or (not slowest and not kept and not policy.fits(gpu, standing.request)):
        return None
    return max(0.0, slowest) + load


def medians(core: Core) -> dict[str, dict[str, float]]:
    """What was learnt, in the shape of `Settings.learnt`."""
    return {
        consumer: {phase: median(seen) for phase, seen in phases.items()}
        for consumer, phases in core.durations.items()
    }


def _wanted_by(lease: Lease) -> str:
    return (
        lease.departure.eviction.wanted_consumer if lease.departure.eviction else ""
    ) or "relief of pressure"


# -- switch --------------------------------------------------------------------------------------------------------------
def switch_record(core: Core, lease: Lease) -> dict[str, Any]:
    """Milliseconds of a grant from the acquire to `ready`, split by phase; of several victims the slowest counts."""
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
