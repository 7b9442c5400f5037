"""Resizing: a held lease shrinks when readings agree, and grows by a request for more bytes.

A growth is a request for the difference (`Request.extends`): it waits in the GPU's queue with the
holder's priority, has victims and a timeout like any other, and its bytes are added to the lease at
its grant. A shrink is a claim of the holder: the charge falls when two readings in a row agree, and
stays when they do not in time. The lease stays held, in use or not.
"""

from dataclasses import dataclass, field, replace

from vram_arbiter.arbiter.core.events import MemorySampled, ResizeAsked
from vram_arbiter.arbiter.core.hooks import Feature
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState, Request
from vram_arbiter.arbiter.core.model.refusals import Misfit, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.requests.requests import (
    bad_state,
    cancel_waiter,
    check_waiters,
    own_lease,
)
from vram_arbiter.arbiter.core.scheduling.admission import largest_growth_bytes
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.notes import QueuedNote, ResizedNote
from vram_arbiter.schemas.wire.pushes import ResizedPush
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import Footprint
from vram_arbiter.schemas.wire.views import LeaseView


@dataclass(slots=True)
class Resize:
    """A resize under way: a growth that waits for its grant, or a shrink for readings."""

    target_bytes: int
    asked_at: float
    growth: LeaseId | None = None  # the request for more bytes; None: the lease shrinks
    agreed: bool = False  # by the newest reading that counts


@dataclass(slots=True)
class Resizing(Feature):
    """Resizes under way, by the id of the resident lease. A lease has at most one."""

    resizes: dict[LeaseId, Resize] = field(default_factory=dict)

    def resize(self, core: Core, event: ResizeAsked) -> None:
        """Begin to resize a held lease; the push `resized` or `denied` follows.

        The reply says what it waits for: nothing (`held`), readings (`shrinking`) or its turn
        (`growing`). A repeat changes nothing; another size replaces the one before.
        Raises Refused.
        """
        lease = own_lease(core, event)
        if lease.state in LEAVING:
            raise Refused(no.Revoked(lease.spec.consumer, lease.state, "resize"))
        if lease.state is not LeaseState.HELD:
            raise bad_state(lease, Misfit.NOT_RESIZABLE)
        gpu, under_way = core.gpu_of(lease), self.resizes.get(lease.id)
        target = max(event.footprint.steady_bytes, event.footprint.residue_bytes)
        more = target - gpu.ledger.charge_bytes(lease.id)
        if under_way is None or under_way.target_bytes != target:
            if more > 0:
                _check_ever_fits(gpu, lease, target, more)
                check_waiters(core, core.clients[event.client], lease.spec.priority)
            self._abandon(core, lease, Why.RESIZED)
            if more > 0:
                self._begin_growth(core, gpu, lease, event, target, more)
            elif more < 0:
                self._begin_shrink(core, gpu, lease, target)
        _declare(lease, event, target)
        core.record_lease(lease)  # a restart must not read a smaller holder as one that is gone
        state = self._direction(lease) or "held"
        core.reply(event.client, event.request, AcquireReply(state, status.view(core, lease)))

    def _direction(self, lease: Lease) -> str:
        resize = self.resizes.get(lease.id)
        return "" if resize is None else "growing" if resize.growth else "shrinking"

    def _abandon(self, core: Core, lease: Lease, why: Why) -> None:
        """End the resize of a lease, if there is one."""
        resize = self.resizes.pop(lease.id, None)
        if resize is None:
            return
        if resize.growth is None:
            lease.observed.shrinks = False
            core.timers.cancel(("shrink", lease.id))
            return
        cancel_waiter(core, core.leases[resize.growth], why)

    def on_moved(self, core: Core, lease: Lease, before: LeaseState) -> None:
        """Forget a growth that ended, and end the resize of a lease that is released."""
        if lease.request.extends is not None:
            self.resizes.pop(lease.request.extends, None)
        elif lease.state in (LeaseState.UNLOADING, LeaseState.VERIFYING):
            self._abandon(core, lease, Why.LEAVES)
        elif lease.state in (LeaseState.EXPIRED, LeaseState.LOST):
            self._abandon(core, lease, Why.OVER)

    def view(self, shown: LeaseView, lease: Lease) -> LeaseView:
        """Show a growth as one, and the direction of a lease's resize."""
        return replace(shown, grows=lease.request.extends, resizing=self._direction(lease))

    # -- growing -----------------------------------------------------------------------------------
    def _begin_growth(
        self, core: Core, gpu: Gpu, lease: Lease, event: ResizeAsked, target: int, more_bytes: int
    ) -> None:
        """Queue a request for the difference."""
        spec = replace(
            lease.spec,
            mode="shared",
            evictable=False,
            standby=False,
            park_bytes=0,
            gang=None,
            footprint=Footprint(more_bytes, more_bytes, 0),
        )
        growth = Lease(
            id=core.next_lease_id(),
            spec=spec,
            process=lease.process,
            client=event.client,
            request=Request(
                nonce=f"growth of {lease.id}",
                arrived_at=core.now,
                arrival=core.next_arrival(),
                load_peak_bytes=more_bytes,
                steady_bytes=more_bytes,
                gpus=(gpu.info.id,),
                uid=lease.request.uid,
                answered=True,
                wait_timeout_s=event.wait_timeout_s,
                extends=lease.id,
            ),
            story=[(core.now, LeaseState.QUEUED, Why.GROWTH)],
        )
        self.watch(growth)
        self.watch(lease)
        core.add(growth)
        core.enqueue(growth)
        self.resizes[lease.id] = Resize(target, core.now, growth.id)
        position = gpu.queue.position(growth)
        queued = QueuedNote(position, None, "", grows=lease.id, more_bytes=more_bytes)
        core.note(queued, growth)

    def grant(self, core: Core, gpu: Gpu, request: Lease) -> bool:
        """Add the bytes of a growth to its lease; record it before the holder is told."""
        if request.request.extends is None:
            return False
        lease, more_bytes = core.leases[request.request.extends], request.request.load_peak_bytes
        core.dequeue(request)
        core.move(request, LeaseState.RELEASED, Why.MERGED)
        core.end(request, None)
        charge = gpu.ledger.charges[lease.id]
        charged, approved = charge.charged_bytes + more_bytes, charge.approved_bytes + more_bytes
        gpu.ledger.recharge(lease.id, charged, core.now, approved)
        lease.observed.enlarged_at = core.now
        gpu.residents.recent[lease.id] = lease
        gpu.changed_at = core.now
        _tell(core, gpu, lease, more_bytes)
        return True

    # -- shrinking ---------------------------------------------------------------------------------
    def _begin_shrink(self, core: Core, gpu: Gpu, lease: Lease, target: int) -> None:
        """Wait for readings that begin from now on: the bytes are freed already."""
        self.watch(lease)
        self.resizes[lease.id] = Resize(target, core.now)
        lease.observed.shrinks = True
        lease.observed.steady_bytes = 0  # seen under another declaration: no drift from the new one
        core.timers.set(("shrink", lease.id), core.now + core.settings.verify_poll_s[0])
        core.want_sample(gpu, core.now)

    def on_shrink_due(self, core: Core, lease_id: str) -> None:
        """Read the GPU for a lease that shrinks. At the deadline its charge stays as it is."""
        lease = core.leases[LeaseId(lease_id)]
        gpu, resize = core.gpu_of(lease), self.resizes[lease.id]
        if core.now >= resize.asked_at + core.settings.verify_timeout_s:
            self._abandon(core, lease, Why.OVER)
            lease.request.steady_bytes = gpu.ledger.charge_bytes(lease.id)
            _tell(core, gpu, lease, 0)
            return
        core.want_sample(gpu, core.now)
        core.timers.set(("shrink", lease.id), core.now + core.settings.verify_poll_s[-1])

    def on_reading(self, core: Core, gpu: Gpu, sample: MemorySampled) -> None:
        """Weigh a reading that counts for the leases of its GPU that shrink: two must agree."""
        for lease_id, resize in list(self.resizes.items()):
            lease = core.leases[lease_id]
            here = lease.gpu == gpu.info.id and resize.growth is None
            if not here or sample.taken_at <= resize.asked_at:
                continue
            less = gpu.ledger.charge_bytes(lease.id) - resize.target_bytes
            agreed_before = resize.agreed
            resize.agreed = _is_freed(core, gpu, lease, less, sample)
            if agreed_before and resize.agreed:
                self._abandon(core, lease, Why.RESIZED)
                gpu.ledger.recharge(lease.id, resize.target_bytes, core.now)
                gpu.changed_at = core.now
                core.wake(gpu)
                _tell(core, gpu, lease, -less)


def _check_ever_fits(gpu: Gpu, lease: Lease, target: int, more_bytes: int) -> None:
    room = largest_growth_bytes(gpu, lease)
    if more_bytes > room:
        capacity, reserve = gpu.info.capacity_bytes, gpu.info.reserve_bytes
        most = target - more_bytes + room
        raise Refused(no.GrowthTooLarge(lease.spec.consumer, target, most, capacity, reserve))


def _declare(lease: Lease, event: ResizeAsked, target: int) -> None:
    """Make the new size the declared one."""
    peak = max(event.footprint.load_peak_bytes, target)
    lease.spec = replace(lease.spec, footprint=replace(event.footprint, load_peak_bytes=peak))
    lease.request.load_peak_bytes = max(lease.request.load_peak_bytes, peak)
    lease.request.steady_bytes = target


def _is_freed(core: Core, gpu: Gpu, lease: Lease, less: int, sample: MemorySampled) -> bool:
    """Return whether a reading shows no more than the charges, less what the holder gave back.

    On the GPU, and for the process if the reading lists it.
    """
    ledger, tolerance = gpu.ledger, core.settings.verify_tolerance_bytes
    held = gpu.shown_bytes(lease.process)
    if held is not None and held > ledger.charged_to(lease.process) - less + tolerance:
        return False
    unattributed = ledger.stowaway_bytes + ledger.driver_bytes
    return sample.used_bytes <= ledger.charged_bytes - less + unattributed + tolerance


def _tell(core: Core, gpu: Gpu, lease: Lease, changed_bytes: int) -> None:
    """Record the charge of a lease, and push it to its holder."""
    charge = gpu.ledger.charge_bytes(lease.id)
    if lease.observed.reported_bytes is not None:  # measured by the holder before the resize
        lease.observed.reported_bytes = max(0, lease.observed.reported_bytes + changed_bytes)
    core.record_lease(lease)
    token = lease.token
    assert token is not None, f"{lease.id} is resident without a token"
    core.push(lease, ResizedPush(lease.id, token, charge))
    core.note(ResizedNote(charge, changed_bytes), lease)
