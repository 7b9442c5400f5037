"""Answers for people and programs: views of leases, `status`, `why`, and the record of a switch. Reads only."""

from collections.abc import Sequence
from statistics import median
from typing import Any

from arbiter.core import drift, gangs, outlook, policy, standby
from arbiter.core.lease import AWAY, LEAVING, Lease, LeaseState
from arbiter.core.state import Core, Gpu

NOTE_KINDS: tuple[str, ...] = (
    "queued", "granted", "ready", "switch", "use_began", "use_ended", "use_yielded", "revoke_asked", "revoke_acked", "reminded",
    "deadline_passed", "unloading", "released", "verified", "denied", "cancelled", "expired", "lost", "reattached", "oom",
    "pressure", "stowaway", "probe_failed", "probe_ok", "drift", "journal_failed", "recovered", "serving", "operator", "resumed",
    "standby", "parked", "orphaned", "gang", "signalled", "resized",
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


# -- views -------------------------------------------------------------------------------------------------------------
def view(core: Core, lease: Lease) -> dict[str, Any]:
    """`schemas.wire.LeaseView`."""
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
        "waited_s": (core.now if lease.state is LeaseState.QUEUED else lease.granted_at) - lease.arrived_at,
    }
    if lease.pinned is not None:
        shown["pinned"] = str(lease.pinned)
    if lease.parent is not None:
        shown["parent"] = lease.parent.id
    if lease.children:
        shown["children"] = [child.id for child in lease.children]
    if lease.gang is not None:
        shown["gang"] = (
            f"{lease.gang.name}: {lease.gang.phase}, {len(lease.gang.members)} of {lease.gang.size}"
        )
    if lease.yielded:
        shown["yielded"] = len(lease.yielded)
    if lease.grows is not None:
        shown["grows"] = lease.grows
    if lease.growth is not None or lease.shrink is not None:
        shown["resizing"] = "growing" if lease.growth is not None else "shrinking"
    if lease.spec.standby:
        shown["standby"] = True
    if lease.id in core.host.booked:
        shown["parked_bytes"] = core.host.booked[lease.id]
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
    return 0 if lease.state in AWAY else lease.load_peak_bytes


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
    if gpu.sample is not None and gpu.sample.processes is not None:
        names = {use.process.pid: (use.name, use.used_bytes) for use in gpu.sample.processes}
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


def status(core: Core) -> dict[str, Any]:
    """`schemas.wire.StatusReply`."""
    resident = [lease for lease in core.leases.values() if lease.state is not LeaseState.QUEUED]
    waiting = sorted(core.waiting.values(), key=lambda lease: (_best_position(core, lease), lease.arrival))
    return {
        "epoch": core.settings.epoch,
        "phase": "serving" if core.recovering is None else "recovering",
        "uptime_s": core.now - core.started_at,
        "gpus": [gpu_view(core, gpu) for gpu in core.gpus.values()],
        "leases": [view(core, lease) for lease in [*resident, *waiting]],
        "clients": len(core.clients),
        "host_ram": {"budget_bytes": core.host.budget_bytes, "parked_bytes": core.host.used_bytes()},
        "drained": "" if core.drain is None else str(core.drain),
    }


def _best_position(core: Core, lease: Lease) -> int:
    """Its best place in a queue; 0: it stands in none, its gang is not complete or loads already."""
    places = [core.gpus[gpu_id].queue for gpu_id in lease.gpus if lease in core.gpus[gpu_id].queue]
    return min((queue.position(lease) for queue in places), default=0)


# -- why ---------------------------------------------------------------------------------------------------------------
def why(core: Core, consumer: str) -> dict[str, Any]:
    """`schemas.wire.WhyReply`: why a consumer is not running, or that it is. A lease's id stands for that lease."""
    mine = [lease for lease in core.leases.values() if consumer in (lease.spec.consumer, lease.id)]
    return {"consumer": consumer, "leases": [_with_plan(core, lease) for lease in mine]}


def _with_plan(core: Core, lease: Lease) -> dict[str, Any]:
    """What happens next with its instant, where one is planned; it also gives an estimate where nobody was asked yet."""
    told = explain_lease(core, lease)
    told["plan"] = []
    if lease.state is LeaseState.QUEUED:
        gpu = core.gpus[lease.planned_gpu or lease.gpus[0]]
        told["plan"] = plan = outlook.steps(core, gpu, lease)
        if told["eta_s"] is None and (eta := _eta_of_plan(core, lease, plan)) is not None:
            told["eta_s"], told["eta_source"] = eta, "learnt"
    return told


def _eta_of_plan(core: Core, waiter: Lease, plan: Sequence[dict[str, Any]]) -> float | None:
    """Seconds until it is loaded if everybody who is to be asked takes as long as usual. None: never seen, or nothing planned."""
    load = core.learnt_s(waiter.spec.consumer, "load_s")
    ends: list[float] = []
    for step in plan:
        if step["action"] == "ask":
            phases = [core.learnt_s(step["consumer"], phase) for phase in ("drain_s", "unload_s", "verify_s")]
            known = [seconds for seconds in phases if seconds is not None]
            if len(known) < len(phases):
                return None
            ends.append(float(step["in_s"]) + sum(known))
    return load + max(ends) if load is not None and ends else None


def explain_lease(core: Core, lease: Lease) -> dict[str, Any]:
    """One lease: what it needs, who stands in its way on which condition, what happens next and when."""
    gpu = core.gpus[lease.gpu or lease.planned_gpu or lease.gpus[0]]
    free = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
    if lease.state is not LeaseState.QUEUED:
        return _explain_resident(core, gpu, lease, free)
    added = policy.added_bytes(gpu, lease)
    deficit = max(0, added - free)
    blockers = _blockers(core, gpu, lease, deficit)
    position = _best_position(core, lease)
    condition, then = _condition(core, gpu, lease, blockers, position)
    eta = _eta(core, gpu, lease)
    head = f"{lease.spec.consumer} needs {_gib(added)}, {_gib(max(0, free))} are free" + (
        f", {_gib(deficit)} are missing" if deficit else ""
    )
    if lease.load_peak_bytes > (declared := lease.spec.load_peak_bytes):
        head += f" ({_gib(declared)} declared, {_gib(lease.load_peak_bytes)} learnt)"
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


def wait_reason(core: Core, lease: Lease) -> str:
    """Why a waiter waits, in words. Short for those who stand behind others: only the head has blockers of its own."""
    position = _best_position(core, lease)
    if position > 1:
        return _behind(core, lease, position)
    return str(explain_lease(core, lease)["text"])


def _behind(core: Core, lease: Lease, position: int) -> str:
    ahead = core.gpus[lease.planned_gpu or lease.gpus[0]].queue.ahead_of(lease)
    return f"waits behind {core.waiting[ahead].spec.consumer if ahead else 'others'} as number {position}"


def _explain_resident(core: Core, gpu: Gpu, lease: Lease, free: int) -> dict[str, Any]:
    says = {
        LeaseState.LOADING: "it was granted and is loading",
        LeaseState.HELD: f"it is resident, {_uses(lease)}",
        LeaseState.REVOKING: f"it was asked to leave for {_wanted_by(lease)}, {_uses(lease)}",
        LeaseState.UNLOADING: "it is unloading",
        LeaseState.VERIFYING: "it let go; its bytes are being measured",
    }.get(lease.state) or standby.outlook(core, lease)
    if drift.drift_bytes(core, gpu, lease):
        held = drift.held_bytes(gpu, lease)
        says += f"; it holds {_gib(held)}, {_gib(lease.spec.steady_bytes)} were declared"
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


def _blockers(core: Core, gpu: Gpu, waiter: Lease, deficit: int) -> list[dict[str, Any]]:
    """Everybody who holds bytes that the waiter lacks, or holds the card alone."""
    alone = waiter.spec.exclusive or any(lease.spec.exclusive for lease in gpu.residents.values())
    if not deficit and not alone and not any(gpu.in_state(LeaseState.LOADING)):
        return []
    holders = [
        {
            "lease_id": lease.id,
            "consumer": lease.spec.consumer,
            "bytes": gpu.ledger.charge_bytes(lease.id),
            "state": str(lease.state),
            "uses": len(lease.uses),
            "condition": _holder_condition(core, waiter, lease),
        }
        for lease in gpu.residents.values()
    ]
    return holders + _keepers(core, gpu, waiter)


def _keepers(core: Core, gpu: Gpu, waiter: Lease) -> list[dict[str, Any]]:
    """Processes without a resident lease that hold bytes all the same: contexts of live processes, debts, stowaways."""
    keepers = {
        account.process: account.booked_bytes()
        for account in gpu.ledger.accounts.values()
        if account.process != waiter.process and gpu.residents.keys().isdisjoint(account.charges)
    }
    names = {client.process: client.name for client in core.clients.values()} if keepers else {}
    kept = [
        (names.get(process, f"pid {process.pid}"), count, "residue", "keeps its context until it exits")
        for process, count in keepers.items()
    ]
    kept += [
        (s.name or f"pid {s.process.pid}", s.used_bytes, "stowaway", "holds bytes without a lease")
        for s in gpu.ledger.strangers.values()
        if s.process.pid != waiter.process.pid
    ]
    return [
        {
            "lease_id": None,
            "consumer": name,
            "bytes": count,
            "state": state,
            "uses": 0,
            "condition": condition,
        }
        for name, count, state, condition in kept
    ]


def _holder_condition(core: Core, waiter: Lease, holder: Lease) -> str:
    if holder.state is LeaseState.LOADING:
        return "is loading"
    if holder.state in LEAVING:
        return {
            LeaseState.REVOKING: f"was asked to leave {_ago(core, holder)}, {_uses(holder)}",
            LeaseState.UNLOADING: "is unloading",
            LeaseState.VERIFYING: "let go, its bytes are being measured",
        }[holder.state]
    if not holder.root.may_leave:
        return f"is pinned by {holder.pinned}" if holder.pinned else "is pinned"
    root = holder.root
    ends_at = policy.residency_ends_at(core, root, waiter)
    if ends_at > core.now:
        stretched = ends_at > root.ready_at + root.spec.min_residency_s
        why = "they keep throwing each other out" if stretched else "minimum residency"
        return f"may stay {ends_at - core.now:.1f} s more ({why})"
    priority = waiter.priority_at(core.now, core.settings.ageing_s_per_point)
    if root.in_use and root.spec.priority > priority:
        return f"is in use and has priority {root.spec.priority}, the waiter {priority}"
    return "is in use" if root.in_use else "is idle and may be asked"


def _condition(
    core: Core, gpu: Gpu, lease: Lease, blockers: Sequence[dict[str, Any]], position: int
) -> tuple[str, str]:
    """(short condition, what happens next in words)."""
    if lease.gang is not None and position <= 1:
        return f"gang {lease.gang.phase}", gangs.outlook(lease.gang, lease)
    leaving = [other for other in gpu.residents.values() if other.state in LEAVING]
    if position > 1:
        return "queued", _behind(core, lease, position)
    if leaving and lease.planned_gpu == gpu.info.id:
        return "room is being made", "; ".join(_leaving_next(core, gpu, other) for other in leaving)
    blocked = policy.blocked(core, gpu)
    if blocked:
        return "blocked", f"waits: {blocked}"
    if leaving:
        return "room is being made", "; ".join(_leaving_next(core, gpu, other) for other in leaving)
    if gpu.verifications:
        names = ", ".join(v.consumer for v in gpu.verifications.values())
        return "measuring", f"waits until the bytes of {names} are measured gone"
    if blockers:
        return "no room", "waits for " + ", ".join(f"{b['consumer']} ({b['condition']})" for b in blockers)
    return "measuring", lease.reason or "waits for a reading of the card"


def _leaving_next(core: Core, gpu: Gpu, holder: Lease) -> str:
    charge = _gib(gpu.ledger.charge_bytes(holder.id))
    name = holder.spec.consumer
    if holder.state is LeaseState.REVOKING and holder.busy_uses():
        running = holder.busy_uses()
        plural = "use" if running == 1 else "uses"
        return (
            f"waits for {name} to finish {running} {plural} (asked {_ago(core, holder)}), "
            f"then it unloads and {charge} are verified"
        )
    if holder.state is LeaseState.REVOKING:
        return f"waits for {name} to unload (asked {_ago(core, holder)}), then {charge} are verified"
    if holder.state is LeaseState.UNLOADING:
        return f"{name} unloads, then {charge} are verified"
    return f"{charge} of {name} are being verified"


def _eta(core: Core, gpu: Gpu, lease: Lease) -> float | None:
    """Seconds until it is loaded, from learnt medians. None if anything on the way was never seen."""
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
    load = core.learnt_s(lease.spec.consumer, "load_s")
    if load is None or (not slowest and not policy.fits(gpu, lease)):
        return None
    return max(0.0, slowest) + load


def medians(core: Core) -> dict[str, dict[str, float]]:
    """What was learnt, in the shape of `Settings.learnt`."""
    return {
        consumer: {phase: median(seen) for phase, seen in phases.items()}
        for consumer, phases in core.durations.items()
    }


def _uses(lease: Lease) -> str:
    paused = f", {len(lease.yielded)} paused" if lease.yielded else ""
    running = f"{len(lease.uses)} use{'' if len(lease.uses) == 1 else 's'} running" if lease.uses else "idle"
    return running + paused


def _wanted_by(lease: Lease) -> str:
    if lease.departing:
        return "its own wish, once its sub-leases have left"
    return (lease.eviction.wanted_consumer if lease.eviction else "") or "relief of pressure"


def _ago(core: Core, holder: Lease) -> str:
    asked_at = holder.eviction.asked_at if holder.eviction else holder.since
    return f"{core.now - asked_at:.1f} s ago"


def _gib(count: int) -> str:
    return f"{count / 2**30:.2f} GiB"


# -- switch --------------------------------------------------------------------------------------------------------------
def switch_record(core: Core, lease: Lease) -> dict[str, Any]:
    """Milliseconds of a grant from the acquire to `ready`, split by phase; of several victims the slowest counts."""
    gone = lease.evicted
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
        "wait_ms": max(0.0, first_asked - lease.arrived_at) * 1e3,
        "drain_ms": max((_span(e.asked_at, e.unloading_at) for e in gone), default=0.0),
        "unload_ms": max((_span(e.unloading_at, e.released_at) for e in gone), default=0.0),
        "verify_ms": max((_span(e.released_at, e.verdict_at) for e in gone), default=0.0),
        "load_ms": (core.now - lease.granted_at) * 1e3,
        "total_ms": (core.now - lease.arrived_at) * 1e3,
    }


def _span(start: float | None, end: float | None) -> float:
    return 0.0 if start is None or end is None else max(0.0, end - start) * 1e3
