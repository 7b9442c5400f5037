"""Resizing: a held lease shrinks when readings agree, and grows by a request for more bytes.

A growth is a request for the difference (`Request.extends`): it waits in the GPU's queue with the
holder's priority, has victims and a timeout like any other, and its bytes are added to the lease at
its grant. A shrink is a claim of the holder: the charge falls when two readings in a row agree, and
stays when they do not in time. The lease stays held, in use or not.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from vram_arbiter.arbiter.core.events import MemorySampled, ResizeAsked
from vram_arbiter.arbiter.core.hooks import Feature
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState, Request
from vram_arbiter.arbiter.core.model.refusals import Misfit, Refused
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests.limits import check_waiters
from vram_arbiter.arbiter.core.requests.requests import bad_state, own_lease
from vram_arbiter.arbiter.core.scheduling.admission import largest_growth_bytes
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.pushes import ResizedPush
from vram_arbiter.schemas.wire.replies import AcquireReply


@dataclass(slots=True)
class Shrink:
    """Bytes that a holder claims to have given back, until the readings agree."""

    target_bytes: int
    asked_at: float
    deadline_at: float
    agreed: bool = False  # by the newest reading that counts


@dataclass(slots=True)
class Resizing(Feature):
    """Resizes under way, by the id of the resident lease. A lease has at most one."""

    growths: dict[LeaseId, LeaseId] = field(default_factory=dict)  # lease → its growth request
    shrinks: dict[LeaseId, Shrink] = field(default_factory=dict)

    timers = frozenset({"shrink"})

    # -- the request -------------------------------------------------------------------------------
    def resize(self, core: Core, event: ResizeAsked) -> None:
        """Begin to resize a held lease; the push `resized` or `denied` follows.

        The reply says what it waits for: nothing (`held`), readings (`shrinking`) or its turn
        (`growing`). A repeat changes nothing; another size replaces the one before.
        Raises Refused.
        """
        lease = own_lease(core, event.client, event.lease, event.token)
        _check_resizable(lease)
        gpu = core.gpu_of(lease)
        target = max(event.steady_bytes, event.residue_bytes)
        charge = gpu.ledger.charge_bytes(lease.id)
        if target > charge and self._growth_target(core, lease) != target:
            _check_ever_fits(gpu, lease, target, charge)
            check_waiters(core, core.clients[event.client], lease.spec.priority)
            self._abandon(core, lease, Why.RESIZED)
            self._begin_growth(core, gpu, lease, event, target - charge)
        elif target < charge and self._shrink_target(lease) != target:
            self._abandon(core, lease, Why.RESIZED)
            self._begin_shrink(core, gpu, lease, target)
        elif target == charge:
            self._abandon(core, lease, Why.RESIZED)
        _declare(lease, event, target)
        core.record_lease(lease)  # a restart must not read a smaller holder as one that is gone
        state = self._resizing(lease) or "held"
        core.reply(event.client, event.request, AcquireReply(state, explain.view(core, lease)))

    def _growth_target(self, core: Core, lease: Lease) -> int | None:
        growth = self.growths.get(lease.id)
        if growth is None:
            return None
        charge = core.gpu_of(lease).ledger.charge_bytes(lease.id)
        return charge + core.leases[growth].request.load_peak_bytes

    def _shrink_target(self, lease: Lease) -> int | None:
        shrink = self.shrinks.get(lease.id)
        return None if shrink is None else shrink.target_bytes

    def _resizing(self, lease: Lease) -> str:
        if lease.id in self.growths:
            return "growing"
        return "shrinking" if lease.id in self.shrinks else ""

    def _abandon(self, core: Core, lease: Lease, why: Why) -> None:
        """End the resize of a lease, if there is one."""
        self._end_shrink(core, lease)
        growth_id = self.growths.get(lease.id)
        if growth_id is not None:
            growth = core.leases[growth_id]
            core.move(growth, LeaseState.CANCELLED, why)
            core.dequeue(growth)
            core.note("cancelled", growth, why=why)
            core.end(growth, None)

    # -- growing -----------------------------------------------------------------------------------
    def _begin_growth(
        self, core: Core, gpu: Gpu, lease: Lease, event: ResizeAsked, more_bytes: int
    ) -> None:
        spec = replace(
            lease.spec,
            exclusive=False,
            evictable=False,
            standby=False,
            park_bytes=0,
            gang=None,
            load_peak_bytes=more_bytes,
            steady_bytes=more_bytes,
            residue_bytes=0,
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
        self.growths[lease.id] = growth.id
        position = gpu.queue.position(growth)
        core.note("queued", growth, position=position, grows=lease.id, more_bytes=more_bytes)

    def grant(self, core: Core, gpu: Gpu, request: Lease) -> bool:
        """Add the bytes of a growth to its lease; record it before the holder is told."""
        if request.request.extends is None:
            return False
        lease, more_bytes = core.leases[request.request.extends], request.request.load_peak_bytes
        core.dequeue(request)
        core.move(request, LeaseState.RELEASED, Why.MERGED)
        core.end(request, None)
        charge = gpu.ledger.charge_of(lease.id)
        booked, approved = charge.booked_bytes + more_bytes, charge.approved_bytes + more_bytes
        gpu.ledger.rebook(lease.id, booked, approved, core.now)
        gpu.residents.enlarge(lease, core.now)
        gpu.changed_at = core.now
        _tell(core, gpu, lease, more_bytes)
        return True

    # -- shrinking ---------------------------------------------------------------------------------
    def _begin_shrink(self, core: Core, gpu: Gpu, lease: Lease, target_bytes: int) -> None:
        """Wait for readings that begin from now on: the bytes are freed already."""
        deadline_at = core.now + core.settings.verify_timeout_s
        self.watch(lease)
        self.shrinks[lease.id] = Shrink(target_bytes, core.now, deadline_at)
        lease.observed.steady_bytes = 0  # seen under another declaration: no drift from the new one
        core.timers.set(("shrink", lease.id), core.now + core.settings.verify_poll_s[0])
        core.want_sample(gpu, core.now)

    def on_timer(self, core: Core, kind: str, subject: str) -> None:
        """Read the GPU for a lease that shrinks. At the deadline its charge stays as it is."""
        lease = core.leases[LeaseId(subject)]
        gpu = core.gpu_of(lease)
        if core.now >= self.shrinks[lease.id].deadline_at:
            self._end_shrink(core, lease)
            lease.request.steady_bytes = gpu.ledger.charge_bytes(lease.id)
            _tell(core, gpu, lease, 0)
            return
        core.want_sample(gpu, core.now)
        core.timers.set(("shrink", lease.id), core.now + core.settings.verify_poll_s[-1])

    def on_sample(self, core: Core, gpu: Gpu, sample: MemorySampled) -> None:
        """Weigh a reading for the leases of its GPU that shrink."""
        for lease_id, shrink in list(self.shrinks.items()):
            lease = core.leases[lease_id]
            if lease.gpu != gpu.info.id or sample.taken_at <= shrink.asked_at:
                continue
            if not _is_freed(core, gpu, lease, shrink, sample):
                shrink.agreed = False
            elif not shrink.agreed:
                shrink.agreed = True
            else:
                before = gpu.ledger.charge_bytes(lease.id)
                self._end_shrink(core, lease)
                gpu.ledger.recharge(lease.id, shrink.target_bytes, core.now)
                gpu.changed_at = core.now
                core.wake(gpu)
                _tell(core, gpu, lease, shrink.target_bytes - before)

    def _end_shrink(self, core: Core, lease: Lease) -> None:
        if self.shrinks.pop(lease.id, None) is not None:
            core.timers.clear(("shrink", lease.id))

    # -- hooks -------------------------------------------------------------------------------------
    def on_moved(self, core: Core, lease: Lease, before: LeaseState) -> None:
        """Forget a growth that ended, and end the resize of a lease that is released."""
        if lease.request.extends is not None:
            del self.growths[lease.request.extends]
        elif lease.state is LeaseState.UNLOADING or lease.state is LeaseState.VERIFYING:
            self._abandon(core, lease, Why.LEAVES)
        elif lease.state in (LeaseState.EXPIRED, LeaseState.LOST):
            self._abandon(core, lease, Why.OVER)

    def size_changes(self, lease: Lease) -> bool:
        """Return whether the lease may show bytes that its holder has freed already."""
        return lease.id in self.shrinks

    def view(self, core: Core, lease: Lease) -> Mapping[str, object]:
        """Show a growth as one, and the direction of a lease's resize."""
        if lease.request.extends is not None:
            return {"grows": lease.request.extends}
        resizing = self._resizing(lease)
        return {"resizing": resizing} if resizing else {}


def _check_resizable(lease: Lease) -> None:
    if lease.state in LEAVING:
        raise Refused(no.Revoked(lease.spec.consumer, lease.state, "resize"))
    if lease.state is not LeaseState.HELD:
        raise bad_state(lease, Misfit.NOT_RESIZABLE)


def _check_ever_fits(gpu: Gpu, lease: Lease, target: int, charge: int) -> None:
    room = largest_growth_bytes(gpu, lease)
    if target - charge <= room:
        return
    sizes = (target, charge + room, gpu.info.capacity_bytes, gpu.info.reserve_bytes)
    raise Refused(no.GrowthTooLarge(lease.spec.consumer, *sizes))


def _declare(lease: Lease, event: ResizeAsked, target: int) -> None:
    """Make the new size the declared one."""
    peak = max(event.load_peak_bytes, target)
    lease.spec = replace(
        lease.spec,
        load_peak_bytes=peak,
        steady_bytes=event.steady_bytes,
        residue_bytes=event.residue_bytes,
    )
    lease.request.load_peak_bytes, lease.request.steady_bytes = (
        max(lease.request.load_peak_bytes, peak),
        target,
    )


def _is_freed(core: Core, gpu: Gpu, lease: Lease, shrink: Shrink, sample: MemorySampled) -> bool:
    """Return whether a reading shows no more than the charges after the shrink.

    On the GPU, and for the process if the reading lists it.
    """
    ledger, tolerance = gpu.ledger, core.settings.verify_tolerance_bytes
    less = ledger.charge_bytes(lease.id) - shrink.target_bytes
    held = sample.bytes_of(lease.process)
    if held is not None and held > ledger.booked_by(lease.process) - less + tolerance:
        return False
    unattributed = ledger.stowaway_bytes() + ledger.driver_bytes()
    return sample.used_bytes <= ledger.booked_bytes() - less + unattributed + tolerance


def _tell(core: Core, gpu: Gpu, lease: Lease, changed_bytes: int) -> None:
    """Record the charge of a lease, and push it to its holder."""
    charge = gpu.ledger.charge_bytes(lease.id)
    if lease.observed.reported_bytes is not None:  # measured by the holder before the resize
        lease.observed.reported_bytes = max(0, lease.observed.reported_bytes + changed_bytes)
    core.record_lease(lease)
    token = lease.token
    assert token is not None, f"{lease.id} is resident without a token"
    core.push(lease, ResizedPush(lease.id, token, charge))
    core.note("resized", lease, charge_bytes=charge, changed_bytes=changed_bytes)
