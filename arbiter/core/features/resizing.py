"""The request to change a held lease's size: it shrinks when a measurement agrees, it grows when it is its turn.

Growing is waiting: an internal waiter for the difference stands in the card's queue with the holder's priority, asks others to leave and is
backfilled like any other, and is merged into the lease when it is granted. Shrinking is being believed: the holder says that it gave bytes
back, and its charge falls only when the card says so too. Both leave the lease held, in use or not. The mechanics are in `growth`.
"""

from dataclasses import replace

from vram_arbiter.arbiter.core.events import ResizeAsked
from vram_arbiter.arbiter.core.features import growth
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu, Refused
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests.limits import check_waiters
from vram_arbiter.arbiter.core.requests.requests import bad_state, own_lease
from vram_arbiter.arbiter.core.scheduling.policy import largest_growth_bytes


def resize(core: Core, event: ResizeAsked) -> None:
    """The reply says what it takes: nothing (`held`), a measurement (`shrinking`) or a turn (`growing`); then push `resized` or `denied`.

    Said again it is the same; another figure replaces the one before.
    """
    lease = own_lease(core, event.client, event.lease, event.token)
    if lease.state in LEAVING:
        raise Refused(
            "lease_revoking",
            f"{lease.spec.consumer} was asked to leave",
            "leave; ask for the new size when it is granted again",
            state=str(lease.state),
        )
    if lease.state is not LeaseState.HELD:
        raise bad_state(lease, "only a held lease is resized")
    if lease.parent is not None or lease.estate is not None:
        raise bad_state(
            lease,
            "a lease with sub-leases, or one of them, keeps its size: carve or release instead",
        )
    gpu = core.gpu_of(lease)
    target = max(event.steady_bytes, event.residue_bytes)
    charge = gpu.ledger.charge_bytes(lease.id)
    if target > charge and not _waits_for(core, lease, target):
        _check_ever_fits(gpu, lease, target, charge)
        check_waiters(core, core.clients[event.client], lease.spec.priority)
        growth.abandon(core, lease, "another size is asked for")
        growth.begin(core, gpu, lease, event, target - charge)
    elif target < charge and (lease.shrink is None or lease.shrink.target_bytes != target):
        growth.abandon(core, lease, "another size is asked for")
        growth.begin_shrink(core, gpu, lease, target)
    elif target == charge:
        growth.abandon(core, lease, "another size is asked for")
    peak = max(event.load_peak_bytes, target)
    lease.spec = replace(
        lease.spec,
        load_peak_bytes=peak,
        steady_bytes=event.steady_bytes,
        residue_bytes=event.residue_bytes,
    )
    lease.load_peak_bytes, lease.steady_bytes = max(lease.load_peak_bytes, peak), target
    core.record_lease(lease)  # a restart must not take who gave bytes back for gone
    state = "growing" if lease.growth else "shrinking" if lease.shrink else "held"
    core.reply(event.client, event.request, {"state": state, "lease": explain.view(core, lease)})


def _waits_for(core: Core, lease: Lease, target: int) -> bool:
    if lease.growth is None:
        return False
    waiter = core.leases[lease.growth]
    return core.gpu_of(lease).ledger.charge_bytes(lease.id) + waiter.load_peak_bytes == target


def _check_ever_fits(gpu: Gpu, lease: Lease, target: int, charge: int) -> None:
    room = largest_growth_bytes(gpu, lease)
    if target - charge <= room:
        return
    raise Refused(
        "vram_insufficient",
        f"{lease.spec.consumer} would need {target} bytes; alone on its GPU it can have {charge + room}",
        "stay smaller",
        needed_bytes=target,
        capacity_bytes=gpu.info.capacity_bytes,
        reserve_bytes=gpu.info.reserve_bytes,
    )
