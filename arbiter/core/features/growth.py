"""A resize under way: the waiter that stands in the queue for a lease's growth, and the measurement that a shrink waits for.

What may be asked for is decided in `resizing`. A growth is merged into its lease when it is granted; the charge of a shrink falls only when
two readings in a row say so. Knows no requests.
"""

from dataclasses import replace

from vram_arbiter.arbiter.core.events import MemorySampled, ResizeAsked
from vram_arbiter.arbiter.core.ledger.ledger import process_bytes
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState, Shrink
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import LeaseId


def abandon(core: Core, lease: Lease, why: str) -> None:
    """The resize under way is off: the lease leaves, or wants another size."""
    if lease.shrink is not None:
        _shrinks_no_more(core, core.gpu_of(lease), lease)
    if lease.growth is not None:
        growth = core.leases[lease.growth]
        lease.growth = None
        growth.move(LeaseState.CANCELLED, core.now, why)
        core.dequeue(growth)
        core.note("cancelled", growth, reason=why)
        core.end(growth, None)


# -- growing -----------------------------------------------------------------------------------------------------------
def begin(core: Core, gpu: Gpu, lease: Lease, event: ResizeAsked, more_bytes: int) -> None:
    growth = Lease(
        id=core.next_lease_id(),
        nonce=f"growth of {lease.id}",
        spec=replace(
            lease.spec,
            exclusive=False,
            evictable=False,
            standby=False,
            park_bytes=0,
            parent=None,
            gang=None,
            load_peak_bytes=more_bytes,
            steady_bytes=more_bytes,
            residue_bytes=0,
        ),
        process=lease.process,
        client=event.client,
        uid=lease.uid,
        arrived_at=core.now,
        arrival=core.next_arrival(),
        load_peak_bytes=more_bytes,
        steady_bytes=more_bytes,
        gpus=(gpu.info.id,),
        since=core.now,
        wait_timeout_s=event.wait_timeout_s,
        answered=True,
        grows=lease.id,
        story=[(core.now, LeaseState.QUEUED, f"growth of {lease.id}")],
    )
    core.add(growth)
    core.enqueue(growth)
    lease.growth = growth.id
    core.note(
        "queued",
        growth,
        position=gpu.queue.position(growth),
        grows=lease.id,
        reason=f"{lease.id} grows by {more_bytes}",
    )


def merge(core: Core, gpu: Gpu, growth: Lease) -> None:
    """The growth is granted: from now on its bytes are the lease's. The record is written before the holder hears of it."""
    assert growth.grows is not None, f"{growth.id} grows nothing"
    lease = core.leases[growth.grows]
    core.dequeue(growth)
    growth.move(LeaseState.RELEASED, core.now, f"merged into {lease.id}")
    core.end(growth, None)
    lease.growth = None
    charge, more = gpu.ledger.charge_of(lease.id), growth.load_peak_bytes
    gpu.ledger.rebook(lease.id, charge.booked_bytes + more, charge.approved_bytes + more, core.now)
    lease.resized_at = gpu.changed_at = core.now
    gpu.residents.recent[lease.id] = lease
    _tell(core, gpu, lease, more)


# -- shrinking ---------------------------------------------------------------------------------------------------------
def begin_shrink(core: Core, gpu: Gpu, lease: Lease, target_bytes: int) -> None:
    """Only readings that begin from now on count: the holder says that the bytes are gone already."""
    lease.shrink = Shrink(target_bytes, core.now, core.now + core.settings.verify_timeout_s)
    lease.steady_seen_bytes = (
        0  # what it held was declared then, and is no drift from what is declared now
    )
    gpu.shrinking[lease.id] = lease
    core.timers.set(("shrink", lease.id), core.now + core.settings.verify_poll_s[0])
    core.want_sample(gpu, core.now)


def on_shrink_due(core: Core, lease_id: str) -> None:
    """Read the card for a lease that shrinks; at the deadline it stays what it is charged."""
    lease = core.leases[LeaseId(lease_id)]
    shrink = lease.shrink
    assert shrink is not None, f"{lease_id} has a timer and does not shrink"
    gpu = core.gpu_of(lease)
    if core.now >= shrink.deadline_at:
        _shrinks_no_more(core, gpu, lease)
        lease.steady_bytes = gpu.ledger.charge_bytes(lease.id)
        _tell(core, gpu, lease, 0)
        return
    core.want_sample(gpu, core.now)
    core.timers.set(("shrink", lease.id), core.now + core.settings.verify_poll_s[-1])


def on_sample(core: Core, sample: MemorySampled) -> None:
    """Weigh a reading that counts for whoever shrinks on its card."""
    gpu = core.gpus.get(sample.gpu)
    if gpu is None or gpu.sample is not sample:
        return
    for lease in list(gpu.shrinking.values()):
        shrink = lease.shrink
        assert shrink is not None, f"{lease.id} is listed and does not shrink"
        if sample.taken_at <= shrink.asked_at:
            continue
        if not _is_gone(core, gpu, lease, shrink, sample):
            shrink.agreed = False
        elif not shrink.agreed:
            shrink.agreed = True
        else:
            before = gpu.ledger.charge_bytes(lease.id)
            _shrinks_no_more(core, gpu, lease)
            gpu.ledger.recharge(lease.id, shrink.target_bytes, core.now)
            gpu.changed_at = core.now
            core.wake(gpu)
            _tell(core, gpu, lease, shrink.target_bytes - before)


def _shrinks_no_more(core: Core, gpu: Gpu, lease: Lease) -> None:
    lease.shrink = None
    del gpu.shrinking[lease.id]
    core.timers.clear(("shrink", lease.id))


def _is_gone(core: Core, gpu: Gpu, lease: Lease, shrink: Shrink, sample: MemorySampled) -> bool:
    """The card shows no more than what would then be charged, and the process no more than its share of it, where that is listed."""
    ledger, tolerance = gpu.ledger, core.settings.verify_tolerance_bytes
    less = ledger.charge_bytes(lease.id) - shrink.target_bytes
    account = ledger.accounts[lease.process]
    held = process_bytes(sample, lease.process)
    if held is not None and held > account.booked_bytes() - less + tolerance:
        return False
    return (
        sample.used_bytes
        <= ledger.booked_bytes()
        - less
        + ledger.stowaway_bytes()
        + ledger.driver_bytes()
        + tolerance
    )


def _tell(core: Core, gpu: Gpu, lease: Lease, changed_bytes: int) -> None:
    charge = gpu.ledger.charge_bytes(lease.id)
    if lease.measured_bytes is not None:  # its own word, of before
        lease.measured_bytes = max(0, lease.measured_bytes + changed_bytes)
    core.record_lease(lease)
    token = lease.token
    assert token is not None, f"{lease.id} is resident without a token"
    pair = [token.epoch, token.serial]
    core.push(
        lease, {"push": "resized", "lease_id": lease.id, "token": pair, "charge_bytes": charge}
    )
    reason = (
        "grown"
        if changed_bytes > 0
        else "shrunk"
        if changed_bytes
        else "the bytes did not come back in time"
    )
    core.note("resized", lease, charge_bytes=charge, changed_bytes=changed_bytes, reason=reason)
