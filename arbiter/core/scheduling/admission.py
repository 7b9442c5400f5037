"""Admission: whether a request fits on a GPU, by the ledger and by the newest reading.

Public: `blocked`, `leaving`, `room_is_coming`, `residue_under_measurement`, `joining`, `fits`,
`added_bytes`, `largest_growth_bytes` (ledger); `measured_room_bytes`, `measured_need_bytes`,
`sample_is_behind` (reading). Changes nothing.
"""

from collections.abc import Mapping

from vram_arbiter.arbiter.core.ledger.ledger import NOTHING
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block

_LEAVING = (LeaseState.REVOKING, LeaseState.UNLOADING, LeaseState.VERIFYING)  # in a fixed order


def blocked(core: Core, gpu: Gpu) -> Block | None:
    """Return why nothing can be granted on a GPU now, for any request; None if grants are possible."""
    if core.recovering is not None:
        return Block.RECOVERING
    if core.drain is not None:
        return Block.DRAINED
    if gpu.failed_at is not None:
        return Block.UNREADABLE
    if gpu.sample is None:
        return Block.UNREAD
    if gpu.in_state(LeaseState.LOADING):
        return Block.LOADING
    if gpu.keeper is not None:
        return Block.GANG
    return Block.PRESSURE if gpu.pressed else None


def kept_by(gpu: Gpu) -> str:
    """Return the name of the group that a feature keeps a GPU for; "" if none does."""
    return "" if gpu.keeper is None else gpu.keeper.blocks(gpu)


def leaving(gpu: Gpu) -> dict[LeaseId, int]:
    """Return leases whose bytes are pending free, with what each retains; not those that are late."""
    going: dict[LeaseId, int] = {}
    for lease in gpu.in_state(*_LEAVING):
        verification = gpu.verifications.get(lease.id)
        overdue = lease.departure.hangs or bool(
            lease.departure.eviction and lease.departure.eviction.overdue
        )
        late = verification.overdue if verification else overdue
        if not late:
            going[lease.id] = lease.residue_bytes
    for verification in gpu.verifications.values():  # debts
        if (
            verification.lease is not None
            and verification.lease not in gpu.residents
            and not verification.overdue
        ):
            going[verification.lease] = verification.retained_bytes
    return going


def room_is_coming(gpu: Gpu) -> bool:
    """Return whether a lease unloads or is verified, and is not late with it."""
    for lease in gpu.in_state(LeaseState.UNLOADING, LeaseState.VERIFYING):
        verification = gpu.verifications.get(lease.id)
        if not (verification.overdue if verification else lease.departure.hangs):
            return True
    return False


def residue_under_measurement(gpu: Gpu) -> bool:
    """Return whether a dead process's retained bytes are measured: no holder is revoked meanwhile."""
    return any(v.lease is None and not v.overdue for v in gpu.verifications.values())


def joining(lease: Lease) -> Mapping[ProcessKey, int]:
    """What a grant charges, by process: one lease's load peak, or what the leases of a group need
    together.
    """
    return (
        {lease.process: lease.request.load_peak_bytes}
        if lease.request.needs is None
        else lease.request.needs
    )


def fits(gpu: Gpu, lease: Lease, going: Mapping[LeaseId, int] = NOTHING) -> bool:
    """Return whether the ledger holds this request at its load peak, once leases in `going` left."""
    if lease.spec.exclusive:
        if any(other not in going for other in gpu.ledger.leases()):
            return False
    elif gpu.residents.exclusive and any(
        other not in going and other != lease.request.extends for other in gpu.residents.exclusive
    ):
        return False
    elif gpu.verifications and any(
        v.exclusive and v.lease not in going for v in gpu.verifications.values()
    ):
        return False  # an exclusive lease is over, and not measured gone yet
    return gpu.ledger.total_if(going, joining(lease)) <= gpu.ledger.budget_bytes


def largest_growth_bytes(gpu: Gpu, lease: Lease) -> int:
    """Return the most that a resident could ever get on top, once every other lease has ended."""
    going = {other.id: 0 for other in gpu.residents.values() if other is not lease}
    return gpu.ledger.budget_bytes - gpu.ledger.total_if(going)


def added_bytes(gpu: Gpu, lease: Lease) -> int:
    """Return what a grant adds to the ledger: the load peak less the retained bytes it replaces."""
    return gpu.ledger.total_if(joining=joining(lease)) - gpu.ledger.total_bytes()


def measured_room_bytes(core: Core, gpu: Gpu) -> int | None:
    """Free bytes by the newest reading, less the leases that it cannot have seen. None: no reading
    young enough.

    A lease that became ready since counts with its load peak: what it freed at the end of its load
    may not be back yet.
    """
    sample = gpu.sample
    if (
        sample is None
        or gpu.failed_at is not None
        or core.now - sample.taken_at > core.settings.sample_max_age_s
    ):
        return None
    if any(
        debt.confirmed_at > sample.taken_at and not debt.baseline_comparable
        for debt in gpu.verifications.values()
        if debt.lease not in gpu.residents
    ):
        return None  # a lease granted and lost since may still be there, with its load peak
    unseen = sum(
        max(gpu.ledger.charge_bytes(lease.id), lease.request.load_peak_bytes)
        for lease in gpu.residents.unseen(sample.taken_at)
    )
    return min(gpu.info.capacity_bytes, sample.total_bytes) - sample.used_bytes - unseen


def measured_need_bytes(gpu: Gpu, lease: Lease) -> int:
    """What the reading must have free: what a grant charges, less what the processes already hold
    (their contexts).
    """
    if lease.request.needs is None:
        return _unheld_bytes(gpu, lease.process, lease.request.load_peak_bytes)
    return sum(_unheld_bytes(gpu, process, count) for process, count in lease.request.needs.items())


def _unheld_bytes(gpu: Gpu, process: ProcessKey, count: int) -> int:
    account = gpu.ledger.accounts.get(process)
    if account is not None and any(lease not in gpu.ledger.reserved for lease in account.charges):
        return count  # what it holds is of its leases; reserved bytes are not held by anyone yet
    own = None if gpu.sample is None else gpu.sample.bytes_of(process)
    if own is None:
        own = account.residue_bytes if account is not None else 0
    return max(0, count - own)


def sample_is_behind(gpu: Gpu) -> bool:
    """Return whether a grant, a `ready` or a verdict came after the newest reading began."""
    return gpu.sample is None or gpu.sample.taken_at < gpu.changed_at
