"""Standby and parking: leases that live on without bytes on a GPU.

A lease on standby comes back by itself when there is room. A parked lease keeps its weights in
host RAM, and comes back by itself only if it is on standby too. Coming back is a favor, never a
claim: no holder is revoked for it, no waiter is passed by, and the lease stays away while the
consumer that it left for is on the GPU. A holder that needs its lease now acquires or reacquires
it, and waits in the queues like any other.

One `Absence` follows such a lease, from its first revoke to its end (`on_moved`):
  revoking: host RAM for its weights is booked, so that its holder can count on it
  verifying: `on_release` said whether it parks and whether it comes back; else its RAM is free
  parked, standby: its bytes are measured gone; it is away
  queued: its holder wants it back (`acquire`, `reacquire`)
  loading: it was granted, or came back by itself (`on_idle`)
  held: its weights are resident, its RAM is free
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import learning
from vram_arbiter.arbiter.core.hooks import Feature
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import (
    AWAY,
    EXPIRING,
    NONCES_MAX,
    TRANSITIONS,
    Departure,
    Lease,
    LeaseState,
)
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.arbiter.core.model.refusals import End, Misfit, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.report.why import Standing
from vram_arbiter.arbiter.core.requests.requests import (
    bad_state,
    check_waiters,
    known_by,
    lease_for,
    released,
)
from vram_arbiter.arbiter.core.scheduling import admission, grants
from vram_arbiter.schemas.ids import ClientId, LeaseId, RequestId
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.explained import Return
from vram_arbiter.schemas.wire.notes import (
    CancelledNote,
    LostNote,
    ParkedNote,
    StandbyNote,
)
from vram_arbiter.schemas.wire.pushes import GrantedPush, LostPush
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import HostRamView, LeaseView


@dataclass(slots=True)
class Absence:
    """How a lease leaves its GPU, and how it comes back."""

    left_for: str = ""  # consumer that it was last revoked for
    dismissed: bool = False  # an operator evicted it: it does not come back by itself
    comes_back: bool = False  # by itself, once its bytes are measured gone and there is room
    parks: bool = False  # its weights stay in host RAM
    parked_bytes: int = 0  # host RAM that is booked for them
    found: bool = False  # booked as found after a restart, whatever the budget is now
    since: float = 0.0  # when it was measured away
    recalled_at: float | None = None  # its holder wants it back before it is away
    returned: bool = False  # it came back by itself the last time


@dataclass(slots=True)
class Standby(Feature):
    """Leases that are away, and those that were or may soon be.

    `park_budget_bytes`: host RAM for parked weights; 0: nothing is parked.
    """

    park_budget_bytes: int
    absences: dict[LeaseId, Absence] = field(default_factory=dict)
    away: dict[LeaseId, Lease] = field(default_factory=dict)  # in the order of their leaving

    live: Mapping[LeaseId, Absence] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.live = self.absences

    def on_moved(self, core: Core, lease: Lease, before: LeaseState) -> None:
        """Follow a lease on its way: revoked, released, away, granted, ready, over."""
        absence = self.absences.get(lease.id)
        if lease.state not in AWAY:
            self.away.pop(lease.id, None)
        match lease.state:
            case LeaseState.REVOKING:
                self._on_revoked(core, lease)
            case LeaseState.PARKED | LeaseState.STANDBY:
                self._on_away(core, lease)
            case LeaseState.LOADING if absence is not None:
                absence.comes_back = absence.parks = absence.dismissed = False
                absence.returned = before in AWAY
                if absence.returned:  # it has not waited
                    lease.request.arrived_at = core.now
            case LeaseState.VERIFYING | LeaseState.HELD if absence is not None:
                if lease.state is LeaseState.HELD or not absence.parks:
                    _free(absence)
        if not TRANSITIONS[lease.state]:  # it is over
            self.absences.pop(lease.id, None)
            core.timers.cancel(("away", lease.id))

    def _of(self, lease: Lease) -> Absence:
        return self.absences.setdefault(lease.id, Absence())

    # -- host RAM ----------------------------------------------------------------------------------
    def host_ram(self) -> HostRamView:
        """Return the budget for parked weights and what is booked of it."""
        return HostRamView(self.park_budget_bytes, self._parked_bytes())

    def book(self, absence: Absence, count: int) -> bool:
        """Book host RAM in place of what is booked already. Return whether there are bytes to book
        and they fit."""
        if not count or not self._fits(absence, count):
            return False
        absence.parked_bytes, absence.found = count, False
        return True

    def can_park(self, lease: Lease) -> bool:
        """Return whether host RAM is booked for a revoked lease, or has room for another."""
        absence = self.absences.get(lease.id, Absence())
        if lease.departure.eviction is not None:
            return absence.parked_bytes > 0
        return lease.spec.park_bytes > 0 and self._fits(absence, lease.spec.park_bytes)

    def _fits(self, absence: Absence, count: int) -> bool:
        return self._parked_bytes() - absence.parked_bytes + count <= self.park_budget_bytes

    def _parked_bytes(self) -> int:
        return sum(absence.parked_bytes for absence in self.absences.values())

    # -- leaving -----------------------------------------------------------------------------------
    def _on_revoked(self, core: Core, lease: Lease) -> None:
        """Book host RAM for its weights from now on, so that the holder can count on it."""
        eviction, absence = lease.departure.eviction, self._of(lease)
        absence.left_for = "" if eviction is None else eviction.why.wanted_by
        parks = self.book(absence, lease.spec.park_bytes)
        if lease.spec.standby or parks:
            # a restart must not take a release that was asked for as one that was wished for
            core.record_lease(lease)

    def on_release(self, core: Core, event: ev.ReleaseReported, lease: Lease) -> None:
        """Decide whether a lease goes on standby or is parked. Raises Refused.

        On standby it goes if the engine revoked it, no operator: a holder that releases by itself
        does not want it back.
        """
        absence, count = self.absences.get(lease.id, Absence()), lease.spec.park_bytes
        if event.parked and (event.exiting or not count):
            raise bad_state(lease, Misfit.EXITS if event.exiting else Misfit.NO_PARK_BYTES)
        if event.parked and not absence.parked_bytes and not self.book(absence, count):
            raise Refused(no.NoHostRam(count, self.park_budget_bytes, self._parked_bytes()))
        self.absences[lease.id] = absence
        revoked = lease.departure.eviction is not None or lease.departure.revoked_before
        stays = lease.spec.standby and revoked and not absence.dismissed
        absence.parks, absence.comes_back = event.parked, stays and not event.exiting

    def next_state(self, lease: Lease) -> LeaseState | None:
        """Return where a released lease is, or goes after its verdict, if it lives on."""
        if lease.state in AWAY:
            return lease.state
        absence = self.absences.get(lease.id)
        if absence is None or not (absence.parks or absence.comes_back):
            return None
        return LeaseState.PARKED if absence.parks else LeaseState.STANDBY

    def _on_away(self, core: Core, lease: Lease) -> None:
        """Its bytes are measured gone."""
        gpu, request, absence = core.gpu_of(lease), lease.request, self._of(lease)
        gpu.residents.remove(lease)
        core.timers.cancel(("overstay", lease.id))
        core.wake(gpu)
        lease.departure = Departure()
        lease.gpu = lease.observed.reported_bytes = request.id = None
        request.gpus = tuple(gpu.info.id for gpu in admission.selected(core, lease.spec))
        request.evicted = []
        request.answered = True
        request.load_peak_bytes, request.steady_bytes = learning.expected_bytes(core, lease.spec)
        absence.since = core.now
        self.away[lease.id] = lease
        core.record_lease(lease)
        _wake(core, lease)
        note = ParkedNote if lease.state is LeaseState.PARKED else StandbyNote
        core.note(note(absence.left_for, absence.parked_bytes, absence.comes_back), lease)
        if absence.recalled_at is not None:
            asked_at, absence.recalled_at = absence.recalled_at, None
            self._queue(core, lease, lease.client, None, asked_at)

    def on_dismissed(self, core: Core, lease: Lease, order: Order) -> None:
        """Do not bring back what an operator evicts.

        On standby a lease ends; parked it stays until its holder asks.
        """
        absence = self._of(lease)
        absence.comes_back, absence.recalled_at = False, None
        if lease.state is LeaseState.STANDBY:
            refusal = no.Lost(lease.id, Why.EVICTED, order=order)
            assert lease.token is not None, f"{lease.id} is away and was never granted"
            core.push(lease, LostPush(lease.id, lease.token, refusal.view()))
            _end(core, lease, LeaseState.CANCELLED, refusal)
            return
        absence.dismissed = lease.state is not LeaseState.PARKED
        if lease.spec.standby or lease.state is LeaseState.PARKED:
            core.record_lease(lease)

    def give_up(self, core: Core, lease: Lease, to: LeaseState, refusal: End) -> bool:
        """End a lease that is away. One that is on its way there ends with its verdict."""
        if lease.state in AWAY:
            _end(core, lease, to, refusal)
            return True
        absence = self.absences.get(lease.id)
        if lease.state is not LeaseState.VERIFYING or absence is None:
            return False
        leaves = absence.comes_back or absence.parks
        absence.comes_back = absence.parks = False
        absence.recalled_at = None
        _free(absence)
        return leaves

    # -- wanted by the holder ----------------------------------------------------------------------
    def acquire(self, core: Core, event: ev.AcquireRequested) -> bool:
        """Take an acquire whose process has a lease for the model that is away. Return whether it
        has one. Raises Refused."""
        lease, spec = known_by(core, event), event.spec
        if lease is not None:
            # a restart ended its wait, if the journal knows no grant since it was asked for; a late
            # repeat of one that waited and was granted means nothing
            waits = event.nonce == lease.request.nonce
            waits = waits and lease.granted_at <= lease.request.arrived_at
            if lease.state not in AWAY or not waits:
                return False
            spec = lease.spec
        elif spec.gang is None:
            mine = core.leases_of(core.clients[event.client].process)
            model = (spec.consumer, spec.model)
            away = [one for one in mine if one.state in AWAY]
            lease = next(
                (one for one in away if (one.spec.consumer, one.spec.model) == model), None
            )
        if lease is None:
            return False
        self._call_back(core, lease, event, spec)
        return True

    def reacquire(self, core: Core, event: ev.Reacquired) -> None:
        """Queue a lease that is away, or on its way there. Raises Refused."""
        lease = lease_for(core, event)
        if lease.process != core.clients[event.client].process:
            raise Refused(no.NotHolder(lease.id, lease.process.pid))
        if lease.state in AWAY:
            self._call_back(core, lease, event, lease.spec)
            return
        if lease.state is LeaseState.VERIFYING and self.next_state(lease) is not None:
            absence = self._of(lease)
            lease.request.traceparent = event.traceparent
            if absence.recalled_at is None:
                absence.recalled_at = core.now
                lease.request.wait_timeout_s = event.wait_timeout_s
        elif lease.state is not LeaseState.QUEUED:
            raise bad_state(lease, Misfit.NOT_AWAY)
        core.hand_to(lease, event.client)
        core.reply(event.client, event.request, AcquireReply("queued", status.view(core, lease)))

    def _call_back(
        self, core: Core, lease: Lease, event: ev.AcquireRequested | ev.Reacquired, spec: LeaseSpec
    ) -> None:
        """Queue a lease that is away, as it is asked for now. Raises Refused."""
        client, request = core.clients[event.client], lease.request
        load_peak, steady = learning.expected_bytes(core, spec)
        gpus = admission.places(core, spec, load_peak)
        check_waiters(core, client, spec.priority)
        request.load_peak_bytes, request.steady_bytes = load_peak, steady
        if isinstance(event, ev.AcquireRequested) and event.nonce != request.nonce:
            _rename(core, lease, event.nonce)
            lease.spec = spec
            core.record_lease(lease)  # still away: if a restart ends the wait, it comes back so
        request.traceparent, request.gpus, request.uid = event.traceparent, gpus, client.uid
        request.wait_timeout_s = event.wait_timeout_s
        self._queue(core, lease, event.client, event.request, core.now)
        core.costs.wanted(spec.consumer, core.now)
        core.turn.unanswered.append(lease)

    def _queue(
        self, core: Core, lease: Lease, client: ClientId, asked: RequestId | None, asked_at: float
    ) -> None:
        """Queue a lease that is away. Without a request (`asked`) its grant is pushed."""
        request = lease.request
        core.move(lease, LeaseState.QUEUED, Why.WANTED)
        core.timers.cancel(("away", lease.id))  # after a restart: its holder reattached
        lease.attached = True
        core.hand_to(lease, client)
        request.id, request.answered = asked, asked is None
        request.arrived_at, request.arrival = asked_at, core.next_arrival()
        request.planned_gpu = None
        core.enqueue(lease)

    # -- coming back by itself ---------------------------------------------------------------------
    def on_idle(self, core: Core, gpu: Gpu) -> None:
        """Grant the lease that comes back to a GPU for which nothing waits.

        By priority, then in the order of their leaving. One that does not fit yet keeps its turn:
        others pass it only where it would still fit beside them. The GPU has to be quiet for the
        lease's own minimum residency first: between two goals a policy is away for a moment only.
        """
        ahead: Lease | None = None
        spare_bytes = 0
        for lease in self._by_turn(gpu):
            if ahead is not None and (
                ahead.spec.exclusive or admission.added_bytes(gpu, lease) > spare_bytes
            ):
                continue
            if admission.fits(gpu, lease):
                due_at = self._quiet_at(gpu, lease)
                if due_at <= core.now:
                    grants.grant_if_measured(core, gpu, lease)
                else:
                    core.timers.set(("return", gpu.info.id), due_at)
                return
            if ahead is None:
                ahead = lease
                passed = partial(self._returned_since, self.absences[lease.id].since)
                spare_bytes, _ = grants.spare_unplanned_bytes(gpu, lease, {}, passed)

    def _by_turn(self, gpu: Gpu) -> list[Lease]:
        """Return the leases that may return to a GPU, the first to do so first."""
        found = [
            lease
            for lease in self.away.values()
            if self.absences[lease.id].comes_back
            and lease.attached
            and gpu.info.id in lease.request.gpus
            and lease.request.load_peak_bytes <= gpu.ledger.budget_bytes
            and not self._left_for_is_here(gpu, lease)
        ]
        return sorted(
            found,
            key=lambda lease: (
                -lease.spec.priority,
                self.absences[lease.id].since,
                lease.request.arrival,
            ),
        )

    def _returned_since(self, since: float, other: Lease) -> bool:
        """Return whether a resident came back by itself after that moment."""
        absence = self.absences.get(other.id)
        return absence is not None and absence.returned and other.granted_at >= since

    def _left_for_is_here(self, gpu: Gpu, lease: Lease) -> bool:
        left_for = self.absences[lease.id].left_for
        return bool(left_for) and any(
            other.spec.consumer == left_for for other in gpu.residents.values()
        )

    def _quiet_at(self, gpu: Gpu, lease: Lease) -> float:
        return max(gpu.changed_at, self.absences[lease.id].since) + lease.spec.min_residency_s

    # -- across a restart --------------------------------------------------------------------------
    def to_record(self, lease: Lease, record: LeaseRecord) -> LeaseRecord:
        """Write down where a lease goes, or how it is away."""
        absence = self.absences.get(lease.id)
        if absence is None:
            return record
        return replace(
            record,
            comes_back=absence.comes_back,
            parks=absence.parks,
            parked_bytes=absence.parked_bytes,
            left_for=absence.left_for,
            dismissed=absence.dismissed,
        )

    def from_record(self, core: Core, lease: Lease, record: LeaseRecord) -> None:
        """Restore an absence. A lease comes back only after its holder reattached."""
        parked_bytes = record.parked_bytes
        if not (lease.spec.standby or lease.spec.park_bytes or parked_bytes or lease.state in AWAY):
            return
        self.watch(lease)
        self.absences[lease.id] = Absence(
            left_for=record.left_for,
            dismissed=record.dismissed,
            comes_back=record.comes_back,
            parks=record.parks,
            parked_bytes=parked_bytes,
            found=True,
            since=core.now,
        )
        if lease.state in AWAY:
            self.away[lease.id] = lease
            patience_s = lease.spec.ttl_s + core.settings.fence_grace_s
            core.timers.set(("away", lease.id), core.now + patience_s)

    def on_away_due(self, core: Core, lease_id: str) -> None:
        """A holder did not reattach after a restart."""
        lease = core.leases[LeaseId(lease_id)]
        _end(core, lease, LeaseState.CANCELLED, no.Lost(lease.id, Why.NOT_BACK))

    def on_reattached(self, core: Core, lease: Lease, item: ev.ReattachedLease) -> None:
        """Believe a holder whose lease, it says, is away; its release, or the grant, was lost."""
        if item.state not in AWAY:
            return
        self.watch(lease)
        if lease.state in AWAY:
            core.timers.cancel(("away", lease.id))
            _wake(core, lease)
        elif lease.token != item.token:
            core.push(lease, GrantedPush(status.view(core, lease)))
        elif lease.state in EXPIRING:
            absence = self._of(lease)
            absence.comes_back = lease.spec.standby and not absence.dismissed
            absence.parks = item.state == "parked"
            if absence.parks and not absence.parked_bytes:  # fitting or not: the budget may differ
                absence.parked_bytes, absence.found = lease.spec.park_bytes, True
            released(core, lease, exiting=False, why=Why.LET_GO_BEFORE)

    # -- reports and invariants --------------------------------------------------------------------
    def view(self, shown: LeaseView, lease: Lease) -> LeaseView:
        """Show that a lease comes back by itself, and its bytes in host RAM."""
        absence = self.absences.get(lease.id)
        parked_bytes = None if absence is None else absence.parked_bytes or None
        return replace(shown, standby=lease.spec.standby, parked_bytes=parked_bytes)

    def standing(self, core: Core, lease: Lease) -> Standing | None:
        """Tell what a lease that is away waits for on the first GPU that it may return to."""
        if lease.state not in AWAY:
            return None
        gpu, absence = core.gpus[lease.request.gpus[0]], self.absences[lease.id]
        head, due_at = gpu.queue.head, self._quiet_at(gpu, lease)
        here = Standing(gpu, lease, (lease,), (lease,))
        if not lease.attached:
            return replace(here, back=Return.HOLDER)
        if not absence.comes_back:
            return replace(here, back=Return.ASKED)
        if head is not None:
            return replace(here, back=Return.BEHIND, ahead=head.spec.consumer)
        if admission.blocked(core, gpu):
            return replace(here, back=Return.BLOCKED)
        if self._left_for_is_here(gpu, lease):
            return replace(here, back=Return.LEFT_FOR, ahead=absence.left_for)
        if not admission.fits(gpu, lease):
            return replace(here, back=Return.NO_ROOM)
        if due_at > core.now:
            return replace(here, back=Return.QUIET, due_s=due_at - core.now)
        return replace(here, back=Return.READING)

    def check(self, core: Core) -> None:
        """Check invariant 4: what is away has no GPU and does not wait; parked bytes fit."""
        fitted = [one.parked_bytes for one in self.absences.values() if not one.found]
        if sum(fitted) > self.park_budget_bytes:
            told = f"{sum(fitted)} bytes are parked, the budget is {self.park_budget_bytes}"
            raise InvariantViolation(4, told)
        for lease in self.away.values():
            if lease.state not in AWAY or lease.id not in core.leases:
                raise InvariantViolation(4, f"{lease.id} is {lease.state}, yet it counts as away")
            if lease.gpu is not None or lease.id in core.waiting:
                told = f"{lease.id} is {lease.state}, yet it has a GPU or waits for one"
                raise InvariantViolation(4, told)


def _rename(core: Core, lease: Lease, nonce: str) -> None:
    """Another acquire asks for a lease. The earlier ones are remembered, for their repeats."""
    request = lease.request
    if len(request.earlier_nonces) == NONCES_MAX:
        core.nonces.pop((lease.process, request.earlier_nonces[0]), None)
    request.earlier_nonces.append(request.nonce)
    request.nonce = nonce
    core.nonces[lease.process, nonce] = lease.id


def _free(absence: Absence) -> None:
    """Its weights are not in host RAM any more."""
    absence.parked_bytes, absence.found = 0, False


def _end(core: Core, lease: Lease, to: LeaseState, refusal: End) -> None:
    """End a lease that is away: nothing has to be measured."""
    core.move(lease, to, refusal.why)
    note = LostNote if to is LeaseState.LOST else CancelledNote
    core.note(note(refusal.why), lease)
    core.end(lease, refusal)


def _wake(core: Core, lease: Lease) -> None:
    for gpu_id in lease.request.gpus:
        core.wake(core.gpus[gpu_id])
