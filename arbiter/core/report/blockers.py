"""What is in a waiter's way: how many bytes each holder has, and on which condition they come free.
Reads only.

Everything charged on the GPU is listed: holders, members of a gang that wait for their turn,
contexts, debts, stowaways.
"""

from heapq import nlargest

from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report.standing import standing_of
from vram_arbiter.arbiter.core.scheduling import admission, victims
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.wire.explained import Blocker, Condition

BLOCKERS_MAX = 32
"""Blockers of one waiter that are listed; of more, the largest holders."""

LONG_LOAD_S = 10.0
"""From then on the progress of a load is shown, and for how long it has not grown."""


def who_blocks(core: Core, gpu: Gpu, waiter: Lease, deficit: int) -> tuple[Blocker, ...]:
    """List what holds bytes that the waiter lacks, or holds the GPU alone. The requests of a gang
    count as one."""
    if waiter.id in gpu.ledger.reserved:  # it has its bytes, and waits for its turn
        loading = gpu.in_state(LeaseState.LOADING)
        return tuple(holder(core, gpu, lease, waiter) for lease in loading)
    alone = waiter.spec.exclusive or any(lease.spec.exclusive for lease in gpu.residents.values())
    if not deficit and not alone and not gpu.in_state(LeaseState.LOADING):
        return ()
    residents = list(gpu.residents.values())
    if len(residents) > BLOCKERS_MAX:
        residents = nlargest(
            BLOCKERS_MAX, residents, lambda lease: gpu.ledger.charge_bytes(lease.id)
        )
    holders = [holder(core, gpu, lease, waiter) for lease in residents]
    return tuple([*holders, *_reserved(core, gpu), *_keepers(core, gpu, waiter)][:BLOCKERS_MAX])


def holder(core: Core, gpu: Gpu, lease: Lease, waiter: Lease | None = None) -> Blocker:
    """A resident lease as it stands in a waiter's way, or for itself."""
    condition, seconds = _condition(core, lease, waiter)
    long = condition is Condition.LOADING and core.now - lease.granted_at >= LONG_LOAD_S
    quiet_s = core.now - max(lease.observed.grew_at, lease.granted_at)
    compared = waiter is not None and condition is Condition.PRIORITY
    return Blocker(
        lease_id=lease.id,
        consumer=lease.spec.consumer,
        bytes=gpu.ledger.charge_bytes(lease.id),
        state=lease.state,
        uses=len(lease.uses),
        condition=condition,
        paused=len(lease.uses.paused),
        seconds=seconds,
        pid=lease.process.pid if condition is Condition.HANGING else None,
        by=_by(core, lease, condition),
        loaded_bytes=lease.observed.peak_bytes if long else None,
        quiet_s=quiet_s if long and quiet_s >= LONG_LOAD_S else None,
        priority=lease.spec.priority if compared else None,
        waiter_priority=_priority(core, waiter) if waiter is not None and compared else None,
    )


def _condition(core: Core, lease: Lease, waiter: Lease | None) -> tuple[Condition, float | None]:
    match lease.state:
        case LeaseState.LOADING:
            return Condition.LOADING, core.now - lease.granted_at
        case LeaseState.REVOKING:
            asked_at = (
                lease.departure.eviction.asked_at if lease.departure.eviction else lease.since
            )
            return Condition.REVOKED, core.now - asked_at
        case LeaseState.UNLOADING:
            hangs = Condition.HANGING if lease.departure.hangs else Condition.UNLOADING
            return hangs, core.now - lease.since
        case LeaseState.VERIFYING:
            return Condition.MEASURED, None
    if not lease.attached:
        return Condition.NOT_BACK, lease.expires_at - core.now
    if victims.protected_by(lease):
        return Condition.GANG, None
    if not lease.evictable:
        return Condition.PINNED, None
    if waiter is None:
        return (Condition.IN_USE if lease.in_use else Condition.IDLE), None
    ends_at = victims.residency_ends_at(core, lease, waiter)
    if ends_at > core.now:
        stretched = ends_at > lease.ready_at + lease.spec.min_residency_s
        return (Condition.THRASHING if stretched else Condition.RESIDENCY), ends_at - core.now
    if lease.in_use and lease.spec.priority > _priority(core, waiter):
        return Condition.PRIORITY, None
    return (Condition.IN_USE if lease.in_use else Condition.IDLE), None


def _priority(core: Core, waiter: Lease) -> int:
    return waiter.priority_at(core.now, core.settings.ageing_s_per_point)


def _by(core: Core, lease: Lease, condition: Condition) -> str:
    if condition is Condition.GANG:
        return victims.protected_by(lease)
    return str(lease.pinned) if condition is Condition.PINNED and lease.pinned else ""


def _reserved(core: Core, gpu: Gpu) -> list[Blocker]:
    """Requests whose bytes are charged here and that wait for their turn to load. The next one has
    the headroom too."""
    if not gpu.ledger.reserved:
        return []
    waiting = [lease for lease in core.waiting.values() if lease.id in gpu.ledger.reserved]
    return [
        Blocker(
            lease_id=lease.id,
            consumer=lease.spec.consumer,
            bytes=gpu.ledger.charge_bytes(lease.id)
            if index
            else standing_of(core, lease).reserved_bytes,
            state=lease.state,
            uses=0,
            condition=Condition.TURN,
            by=admission.kept_by(gpu),
        )
        for index, lease in enumerate(waiting)
    ]


def _keepers(core: Core, gpu: Gpu, waiter: Lease) -> list[Blocker]:
    """Processes without a resident lease that hold bytes: contexts of live processes, debts,
    stowaways."""
    ledger = gpu.ledger
    names = {client.process: client.name for client in core.clients.values()}
    kept: list[Blocker] = []
    for process, account in ledger.accounts.items():
        count = ledger.filled_bytes(process)
        if (
            process == waiter.process
            or not count
            or not gpu.residents.keys().isdisjoint(account.charges)
        ):
            continue
        owed = any(lease not in ledger.reserved for lease in account.charges)
        condition = _debt(gpu, process) if owed else _residue(gpu, process)
        name, state = names.get(process, f"pid {process.pid}"), "debt" if owed else "residue"
        kept.append(Blocker(None, name, count, state, 0, condition, pid=process.pid))
    for stowaway in ledger.strangers.values():
        pid = stowaway.process.pid
        if pid != waiter.process.pid:
            name, count = stowaway.name or f"pid {pid}", stowaway.used_bytes
            kept.append(Blocker(None, name, count, "stowaway", 0, Condition.STOWAWAY, pid=pid))
    return kept


def _residue(gpu: Gpu, process: ProcessKey) -> Condition:
    account = gpu.ledger.accounts[process]
    more = account.residue_bytes > account.residue_floor_bytes
    return Condition.RETAINED if more else Condition.CONTEXT


def _debt(gpu: Gpu, process: ProcessKey) -> Condition:
    """A debt of a live process that is overdue comes free only when the process frees it."""
    for verification in gpu.verifications.values():
        if verification.process == process and verification.overdue and verification.alive:
            return Condition.DEBT_KEPT
    return Condition.DEBT
