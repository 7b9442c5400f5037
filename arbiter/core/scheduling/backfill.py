"""Backfill: a later request is granted if it cannot delay the head.

Public: `choose`, `spare_unplanned_bytes`. Changes nothing.
"""

from collections.abc import Callable, Mapping
from math import inf

from vram_arbiter.arbiter.core.hooks import owner_of
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.scheduling.admission import (
    added_bytes,
    fits,
    joining,
    residue_under_measurement,
    room_is_coming,
)
from vram_arbiter.arbiter.core.scheduling.victims import as_leaving
from vram_arbiter.schemas.ids import LeaseId


def choose(
    core: Core, gpu: Gpu, head: Lease, going: Mapping[LeaseId, int], *, planned: bool
) -> Lease | None:
    """Return the first request behind `head` that fits, evicts no holder and cannot delay the head;
    None: there is none.

    `going`: leases whose bytes are on their way back. `planned`: with them gone the head fits.
    """
    if len(gpu.queue) < 2 or head.spec.exclusive or not core.settings.scheduling.backfill:
        return None
    fold = largest_fold_bytes(gpu)
    smallest, free = (
        gpu.queue.smallest_need_bytes() - fold,
        gpu.ledger.budget_bytes - gpu.ledger.total_bytes(),
    )
    if smallest > free:
        return None
    if room_is_coming(gpu):
        return None  # the head's room is about to come; a load now would only be in its way
    if planned:
        spare, stuck = spare_beside_bytes(gpu, head, going), False
    else:
        spare, stuck = spare_unplanned_bytes(
            gpu, head, going, lambda lease: passed(gpu, lease, head)
        )
        if stuck and residue_under_measurement(gpu):
            return None
    if smallest > spare:
        return None
    most = min(free, spare) + fold
    alone = not gpu.ledger.leases()
    for lease in gpu.queue.behind_head():
        if lease.request.load_peak_bytes > most or (lease.spec.exclusive and not alone):
            continue  # seen at a glance: thousands may wait
        if lease is head or owner_of(lease) or (stuck and not _may_be_asked(core, lease)):
            continue
        if added_bytes(gpu, lease) <= spare and fits(gpu, lease):
            return lease
    return None


def _may_be_asked(core: Core, lease: Lease) -> bool:
    """Return whether it may be revoked later: the head may need its bytes once a stowaway leaves."""
    return (
        lease if lease.request.extends is None else core.leases[lease.request.extends]
    ).evictable


def largest_fold_bytes(gpu: Gpu) -> int:
    """Return the most by which a need may shrink through what its process already holds here."""
    ledger = gpu.ledger
    folded = [
        account.residue_bytes + account.measured_bytes for account in ledger.accounts.values()
    ]
    return max(
        [*folded, *(stranger.used_bytes for stranger in ledger.strangers.values())], default=0
    )


def spare_beside_bytes(gpu: Gpu, head: Lease, freed: Mapping[LeaseId, int]) -> int:
    """Return what a later request may take without delaying the head, once leases in `freed` left."""
    return gpu.ledger.budget_bytes - gpu.ledger.total_if(freed, joining(head))


def spare_unplanned_bytes(
    gpu: Gpu, head: Lease, going: Mapping[LeaseId, int], stays: Callable[[Lease], bool]
) -> tuple[int, bool]:
    """Return the same for a head without a plan, and whether it waits for bytes of no holder.

    Every lease may leave some day, except those that took their room while the head waited before
    them (`stays`). If the head would not fit even then, it is served when stowaways leave, and else
    when processes with retained bytes end. Only what remains beside it on that day may be taken
    now.
    """
    ledger, joins = gpu.ledger, joining(head)
    everything = _ever_freed(gpu, head, going, None)
    day = ledger.total_if(everything, joins)
    stay_bytes = ledger.total_if(_ever_freed(gpu, head, going, stays), joins) - day
    stuck = day > ledger.budget_bytes
    if day > ledger.budget_bytes:
        day = ledger.total_if(everything, joins, stowaways=False)
    if day > ledger.budget_bytes:
        day = sum(joins.values())
    return ledger.budget_bytes - day - stay_bytes, stuck


def passed(gpu: Gpu, lease: Lease, head: Lease) -> bool:
    """Return whether a lease was granted or grew while `head` waited before it."""
    overtook = lease.granted_at >= head.request.arrived_at and gpu.queue.precedes(head, lease)
    return overtook or gpu.residents.enlarged.get(lease.id, -inf) >= head.request.arrived_at


def _ever_freed(
    gpu: Gpu, head: Lease, going: Mapping[LeaseId, int], stays: Callable[[Lease], bool] | None
) -> dict[LeaseId, int]:
    """All leases but the one that `head` extends, and those that stay."""
    leave = [
        lease
        for lease in gpu.residents.values()
        if lease.id != head.request.extends and not (stays and stays(lease))
    ]
    return {**as_leaving(leave), **going}
