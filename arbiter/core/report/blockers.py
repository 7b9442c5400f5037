"""Who stands in a waiter's way: how many bytes each holds, and on which condition they come free. Reads only; for `explain`.

Whoever is charged on the card is named: holders, requests with reserved bytes, contexts, debts and stowaways.
"""

from collections.abc import Sequence
from heapq import nlargest
from typing import Any

from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report.standing import standing_of
from vram_arbiter.arbiter.core.scheduling import policy
from vram_arbiter.schemas.ids import ProcessKey

NAMED_MAX = 3
"""Leases that are listed by name in a sentence; the others are counted."""

BLOCKERS_MAX = 32
"""Blockers of one waiter that are told; of more, the largest holders."""

LONG_LOAD_S = 10.0
"""From then on it is said how far a load is, and for how long its bytes have not grown."""

type Blocker = dict[str, Any]


def who_blocks(core: Core, gpu: Gpu, waiter: Lease, deficit: int) -> list[Blocker]:
    """Everybody who holds bytes that the waiter lacks, or holds the card alone. `waiter`: the requests of a group count as one."""
    if waiter.id in gpu.ledger.reserved:  # it has its bytes, and waits for its turn
        return [_holder(core, gpu, waiter, lease) for lease in gpu.in_state(LeaseState.LOADING)]
    alone = waiter.spec.exclusive or any(lease.spec.exclusive for lease in gpu.residents.values())
    if not deficit and not alone and not gpu.in_state(LeaseState.LOADING):
        return []
    residents = list(gpu.residents.values())
    if len(residents) > BLOCKERS_MAX:
        residents = nlargest(
            BLOCKERS_MAX, residents, lambda lease: gpu.ledger.charge_bytes(lease.id)
        )
    holders = [_holder(core, gpu, waiter, lease) for lease in residents]
    return [*holders, *_reserved(core, gpu), *_keepers(core, gpu, waiter)][:BLOCKERS_MAX]


def _holder(core: Core, gpu: Gpu, waiter: Lease, lease: Lease) -> Blocker:
    return {
        "lease_id": lease.id,
        "consumer": lease.spec.consumer,
        "bytes": gpu.ledger.charge_bytes(lease.id),
        "state": str(lease.state),
        "uses": len(lease.uses),
        "condition": _holder_condition(core, waiter, lease),
    }


def _reserved(core: Core, gpu: Gpu) -> list[Blocker]:
    """Requests whose bytes are charged here and that wait for their turn to load. The next one has the headroom too."""
    if not gpu.ledger.reserved:
        return []
    waiting = [lease for lease in core.waiting.values() if lease.id in gpu.ledger.reserved]
    standings = [standing_of(core, lease) for lease in waiting]
    return [
        {
            "lease_id": lease.id,
            "consumer": lease.spec.consumer,
            "bytes": gpu.ledger.charge_bytes(lease.id) if index else standing.reserved_bytes,
            "state": str(lease.state),
            "uses": 0,
            "condition": f"has its bytes kept for its turn in {standing.group}",
        }
        for index, (lease, standing) in enumerate(zip(waiting, standings, strict=True))
    ]


def _keepers(core: Core, gpu: Gpu, waiter: Lease) -> list[Blocker]:
    """Processes without a resident lease that hold bytes all the same: contexts of live processes, debts, stowaways."""
    ledger = gpu.ledger
    names = {client.process: client.name for client in core.clients.values()}
    kept: list[tuple[str, int, str, str]] = []
    for process, account in ledger.accounts.items():
        count = ledger.filled_bytes(process)
        if (
            process == waiter.process
            or not count
            or not gpu.residents.keys().isdisjoint(account.charges)
        ):
            continue
        owed = any(lease not in ledger.reserved for lease in account.charges)
        state, condition = (
            ("debt", _debt_condition(gpu, process))
            if owed
            else ("residue", _residue_condition(gpu, process))
        )
        kept.append((names.get(process, f"pid {process.pid}"), count, state, condition))
    kept += [
        (s.name or f"pid {s.process.pid}", s.used_bytes, "stowaway", "holds bytes without a lease")
        for s in ledger.strangers.values()
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


def _residue_condition(gpu: Gpu, process: ProcessKey) -> str:
    account = gpu.ledger.accounts[process]
    if account.residue_bytes <= account.residue_floor_bytes:
        return "keeps its context until it exits"
    return (
        f"keeps more than its context until its process (pid {process.pid}) gives it back or ends"
    )


def _debt_condition(gpu: Gpu, process: ProcessKey) -> str:
    """Bytes that are not measured gone although there was time enough are no matter of patience any more."""
    for verification in gpu.verifications.values():
        if verification.process == process and verification.overdue and verification.alive:
            return f"is over, and its process (pid {process.pid}) keeps its bytes until it lets go or ends"
    return "is over, its bytes are being measured"


def _holder_condition(core: Core, waiter: Lease, holder: Lease) -> str:
    if holder.state is LeaseState.LOADING:
        return loading(core, holder)
    if holder.state in LEAVING:
        return {
            LeaseState.REVOKING: f"was asked to leave {ago(core, holder)}, {uses(holder)}",
            LeaseState.UNLOADING: unloading(core, holder),
            LeaseState.VERIFYING: "let go, its bytes are being measured",
        }[holder.state]
    if not holder.attached:
        left_s = holder.expires_at - core.now
        return f"has not come back since the restart, is given up in {left_s:.1f} s"
    if protected := next(filter(None, (one.protects(holder) for one in holder.features)), ""):
        return protected
    if not holder.evictable:
        return f"is pinned by {holder.pinned}" if holder.pinned else "is pinned"
    ends_at = policy.residency_ends_at(core, holder, waiter)
    if ends_at > core.now:
        stretched = ends_at > holder.ready_at + holder.spec.min_residency_s
        why = "they keep throwing each other out" if stretched else "minimum residency"
        return f"may stay {ends_at - core.now:.1f} s more ({why})"
    priority = waiter.priority_at(core.now, core.settings.ageing_s_per_point)
    if holder.in_use and holder.spec.priority > priority:
        return f"is in use and has priority {holder.spec.priority}, the waiter {priority}"
    return "is in use" if holder.in_use else "is idle and may be asked"


# -- words -------------------------------------------------------------------------------------------------------------
def named(leases: Sequence[Lease]) -> str:
    """`policy (L1-3), reward (L1-4)`, at most so many."""
    shown = [f"{lease.spec.consumer} ({lease.id})" for lease in leases[:NAMED_MAX]]
    more = len(leases) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def loading(core: Core, lease: Lease) -> str:
    """How far a load is, as readings show it: nobody can know how long it may take, but everybody can see that nothing moves."""
    took_s = core.now - lease.granted_at
    if took_s < LONG_LOAD_S:
        return "is loading"
    told = f"is loading for {took_s:.0f} s, {gib(lease.observed.peak_bytes)} so far"
    quiet_s = core.now - max(lease.observed.grew_at, lease.granted_at)
    return told if quiet_s < LONG_LOAD_S else f"{told}, nothing new for {quiet_s:.0f} s"


def unloading(core: Core, lease: Lease) -> str:
    """One that hangs is nobody's hope any more, but its bytes are charged until they are gone or its process is."""
    if not lease.departure.hangs:
        return "is unloading"
    return f"is unloading for {core.now - lease.since:.0f} s and may hang: end its process (pid {lease.process.pid})"


def uses(lease: Lease) -> str:
    paused = f", {len(lease.uses.paused)} paused" if lease.uses.paused else ""
    running = (
        f"{len(lease.uses)} use{'' if len(lease.uses) == 1 else 's'} running"
        if lease.uses
        else "idle"
    )
    return running + paused


def ago(core: Core, holder: Lease) -> str:
    asked_at = holder.departure.eviction.asked_at if holder.departure.eviction else holder.since
    return f"{core.now - asked_at:.1f} s ago"


def gib(count: int) -> str:
    return f"{count / 2**30:.2f} GiB"
