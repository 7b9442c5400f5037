"""Standby and parking: leases that live on without bytes on a GPU.

A lease on standby comes back by itself when there is room. A parked lease keeps its weights in
host RAM, and comes back by itself only if it is on standby too. Coming back is a favor, never a
claim: no holder is revoked for it, no waiter is passed by, and the lease stays away while the
consumer that it left for is on the GPU. A holder that needs its lease now acquires or reacquires
it, and waits in the queues like any other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from vram_arbiter.arbiter.core.events import (
    AcquireRequested,
    LeaseSpec,
    Reacquired,
    ReattachedLease,
    ReleaseReported,
)
from vram_arbiter.arbiter.core.features.parking import HostRam
from vram_arbiter.arbiter.core.hooks import Feature
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.learning import costs, drift
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import (
    AWAY,
    EXPIRING,
    NONCES_MAX,
    Departure,
    Lease,
    LeaseState,
)
from vram_arbiter.arbiter.core.model.refusals import End, Misfit, Refused
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.report.standing import Standing
from vram_arbiter.arbiter.core.requests.limits import check_waiters
from vram_arbiter.arbiter.core.requests.requests import (
    bad_state,
    client_of,
    lease_for,
    let_go,
    spec_of,
)
from vram_arbiter.arbiter.core.scheduling import admission, backfill, grants, placement
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.explained import Return
from vram_arbiter.schemas.wire.pushes import GrantedPush, LostPush
from vram_arbiter.schemas.wire.replies import AcquireReply


@dataclass(frozen=True, slots=True)
class Recall:
    """A wait that begins once the lease is measured away."""

    asked_at: float
    wait_timeout_s: float | None


@dataclass(slots=True)
class Absence:
    """How a lease leaves its GPU, and how it comes back."""

    left_for: str = ""  # consumer that it was last revoked for
    dismissed: bool = False  # an operator evicted it: it does not come back by itself
    comes_back: bool = False  # by itself, once its bytes are measured gone and there is room
    parks: bool = False  # its weights stay in host RAM
    since: float = 0.0  # when it was measured away
    recall: Recall | None = None  # its holder wants it back before it is away
    returned: bool = False  # it came back by itself the last time
    unused: bool = False  # and was not used since


@dataclass(slots=True)
class Standby(Feature):
    """Leases that are away, and what is known of those that were or may soon be."""

    host: HostRam
    absences: dict[LeaseId, Absence] = field(default_factory=dict)
    away: dict[LeaseId, Lease] = field(default_factory=dict)  # in the order of their leaving

    timers = frozenset({"away", "return"})

    def _of(self, lease: Lease) -> Absence:
        return self.absences.setdefault(lease.id, Absence())

    def on_request(self, core: Core, request: Lease) -> bool:
        """Watch a request whose lease may go on standby or be parked."""
        if _concerns(request.spec):
            self.watch(request)
        return False

    # -- leaving
    def on_release(self, core: Core, event: ReleaseReported, lease: Lease) -> None:
        """Decide whether a lease goes on standby or is parked. Raises Refused."""
        if event.parked:
            self._book(lease, exiting=event.exiting)
        absence = self._of(lease)
        absence.parks = event.parked
        absence.comes_back = self._stays(lease, absence) and not event.exiting

    def _stays(self, lease: Lease, absence: Absence) -> bool:
        """Return whether a released lease goes on standby: if the engine revoked it, no operator.

        A holder that releases by itself does not want it back.
        """
        revoked = lease.departure.eviction is not None or lease.departure.revoked_before
        return lease.spec.standby and revoked and not absence.dismissed

    def _book(self, lease: Lease, *, exiting: bool) -> None:
        """Book host RAM for the weights that a holder says it keeps there."""
        count = lease.spec.park_bytes
        if exiting or not count:
            raise bad_state(lease, Misfit.EXITS if exiting else Misfit.NO_PARK_BYTES)
        if lease.id in self.host.booked or self.host.book(lease.id, count):
            return
        budget, booked = self.host.budget_bytes, self.host.used_bytes()
        raise Refused(no.NoHostRam(count, budget, booked))

    def next_state(self, lease: Lease) -> LeaseState | None:
        """Return where a released lease is, or goes after its verdict, if it lives on."""
        if lease.state in AWAY:
            return lease.state
        absence = self.absences.get(lease.id)
        if absence is None or not (absence.parks or absence.comes_back):
            return None
        return LeaseState.PARKED if absence.parks else LeaseState.STANDBY

    def on_moved(self, core: Core, lease: Lease, before: LeaseState) -> None:
        """Follow a lease on its way: revoked, released, away, granted, ready, over."""
        match lease.state:
            case LeaseState.REVOKING:
                self._on_revoked(core, lease)
            case LeaseState.VERIFYING:
                absence = self.absences.get(lease.id)
                if absence is None or not absence.parks:
                    self.host.drop(lease.id)
            case LeaseState.PARKED | LeaseState.STANDBY:
                self._on_away(core, lease)
            case LeaseState.LOADING:
                self._on_granted(core, lease)
            case LeaseState.HELD:
                self.host.drop(lease.id)
            case LeaseState.QUEUED | LeaseState.UNLOADING:
                pass
            case _:
                self.absences.pop(lease.id, None)
                self.away.pop(lease.id, None)
                self.host.drop(lease.id)
                core.timers.clear(("away", lease.id))

    def _on_revoked(self, core: Core, lease: Lease) -> None:
        """Book host RAM for its weights from now on, so that the holder can count on it."""
        eviction = lease.departure.eviction
        self._of(lease).left_for = "" if eviction is None else eviction.wanted_consumer
        parks = self.host.book(lease.id, lease.spec.park_bytes)
        if lease.spec.standby or parks:
            # a restart must not take a release that was asked for as one that was wished for
            core.record_lease(lease)

    def _on_away(self, core: Core, lease: Lease) -> None:
        """Its bytes are measured gone."""
        gpu, absence = core.gpu_of(lease), self._of(lease)
        del gpu.residents[lease.id]
        core.timers.clear(("overstay", lease.id))
        core.wake(gpu)
        lease.departure = Departure()
        lease.gpu = lease.observed.reported_bytes = lease.request.id = None
        lease.request.gpus = tuple(gpu.info.id for gpu in placement.selected(core, lease.spec))
        lease.request.evicted = []
        lease.request.answered = True
        _expect(core, lease)
        self._enter(core, lease)
        core.note(
            str(lease.state),
            lease,
            left_for=absence.left_for,
            parked_bytes=self.host.booked.get(lease.id, 0),
            comes_back=absence.comes_back,
        )
        if absence.recall is not None:
            recall, absence.recall = absence.recall, None
            self._queue(core, lease, lease.client, None, recall.asked_at, recall.wait_timeout_s)

    def _enter(self, core: Core, lease: Lease) -> None:
        """The lease is away from now on, in the journal too."""
        self._of(lease).since = core.now
        self.away[lease.id] = lease
        core.record_lease(lease)
        _wake(core, lease)

    def on_dismissed(self, core: Core, lease: Lease, order: Order) -> None:
        """Do not bring back what an operator evicts.

        On standby a lease ends; parked it stays until its holder asks.
        """
        absence = self._of(lease)
        absence.comes_back, absence.recall = False, None
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
        absence.recall = None
        self.host.drop(lease.id)
        return leaves

    # -- wanted by the holder
    def on_acquire(self, core: Core, event: AcquireRequested, known: Lease | None) -> bool:
        """Take an acquire whose process has a lease for the model that is away."""
        if known is not None:
            if known.state not in AWAY or not _still_waits(known, event):
                return False
            self._want_back(core, known, event)
            return True
        process = client_of(core, event.client).process
        lease = None if event.spec.gang is not None else self._find(core, process, event.spec)
        if lease is None:
            return False
        spec = spec_of(core, event)
        gpus = _places(core, event, spec)
        _rename(core, lease, event.nonce)
        lease.spec = spec
        _expect(core, lease)
        core.record_lease(
            lease
        )  # still away: if a restart ends the wait, it is this that comes back
        self._call_back(core, lease, event, gpus)
        return True

    def reacquire(self, core: Core, event: Reacquired) -> None:
        """Queue a lease that is away, or on its way there. Raises Refused."""
        client = client_of(core, event.client)
        lease = lease_for(core, event.lease, event.token)
        if lease.process != client.process:
            raise Refused(no.NotHolder(lease.id, lease.process.pid))
        if lease.state in AWAY:
            self._want_back(core, lease, event)
            return
        if lease.state is LeaseState.VERIFYING and self.next_state(lease) is not None:
            absence = self._of(lease)
            lease.request.traceparent = event.traceparent
            absence.recall = absence.recall or Recall(core.now, event.wait_timeout_s)
        elif lease.state is not LeaseState.QUEUED:
            raise bad_state(lease, Misfit.NOT_AWAY)
        core.hand_to(lease, client.id)
        core.reply(event.client, event.request, AcquireReply("queued", explain.view(core, lease)))

    def _find(self, core: Core, process: ProcessKey, spec: LeaseSpec) -> Lease | None:
        if not self.away:
            return None
        return next(
            (
                lease
                for lease in core.leases_of(process)
                if lease.state in AWAY
                and (lease.spec.consumer, lease.spec.key) == (spec.consumer, spec.key)
            ),
            None,
        )

    def _want_back(self, core: Core, lease: Lease, event: AcquireRequested | Reacquired) -> None:
        """Queue a lease that is away, as it was last asked for."""
        self._call_back(core, lease, event, _places(core, event, lease.spec))

    def _call_back(
        self,
        core: Core,
        lease: Lease,
        event: AcquireRequested | Reacquired,
        gpus: tuple[GpuId, ...],
    ) -> None:
        lease.request.traceparent = event.traceparent
        lease.request.gpus = gpus
        lease.request.uid = client_of(core, event.client).uid
        _expect(core, lease)
        self._queue(core, lease, event.client, event.request, core.now, event.wait_timeout_s)
        costs.wanted(core, lease.spec.consumer)
        core.turn.unanswered.append(lease)

    def _queue(
        self,
        core: Core,
        lease: Lease,
        client: ClientId,
        request: RequestId | None,
        asked_at: float,
        wait_timeout_s: float | None,
    ) -> None:
        """Queue a lease that is away as of `asked_at`. Without a request its grant is pushed."""
        del self.away[lease.id]
        core.move(lease, LeaseState.QUEUED, Why.WANTED)
        core.timers.clear(("away", lease.id))  # after a restart: its holder reattached
        lease.attached = True
        core.hand_to(lease, client)
        lease.request.id = request
        lease.request.answered = request is None
        lease.request.arrived_at = asked_at
        lease.request.arrival = core.next_arrival()
        lease.request.wait_timeout_s = wait_timeout_s
        lease.request.planned_gpu = None
        core.enqueue(lease)

    # -- coming back by itself
    def serve(self, core: Core, gpu: Gpu, head: Lease | None) -> None:
        """Grant the lease that comes back to a GPU for which nothing waits."""
        back = None if head is not None else self._next_back(core, gpu)
        if back is not None:
            grants.grant_if_measured(core, gpu, back)

    def _on_granted(self, core: Core, lease: Lease) -> None:
        """A grant ends the absence. A lease that came back by itself has not waited."""
        absence = self.absences.get(lease.id)
        if absence is None:
            return
        absence.comes_back = absence.parks = absence.dismissed = False
        absence.returned = absence.unused = self.away.pop(lease.id, None) is not None
        if absence.returned:
            lease.request.arrived_at = core.now

    def on_used(self, lease: Lease) -> None:
        """A lease that came back by itself was wanted."""
        absence = self.absences.get(lease.id)
        if absence is not None:
            absence.unused = False

    def unclaimed(self, lease: Lease) -> bool:
        """Return whether a lease came back by itself and was not used since."""
        absence = self.absences.get(lease.id)
        return absence is not None and absence.unused

    def _next_back(self, core: Core, gpu: Gpu) -> Lease | None:
        """Return the lease that comes back now: by priority, then in the order of their leaving.

        One that does not fit yet keeps its turn: others pass it only where it would still fit
        beside them. The GPU has to be quiet for the lease's own minimum residency first: between
        two goals a policy is away for a moment only.
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
                    return lease
                core.timers.set(("return", gpu.info.id), due_at)
                return None
            if ahead is None:
                ahead = lease
                passed = partial(self._returned_since, self.absences[lease.id].since)
                spare_bytes, _ = backfill.spare_unplanned_bytes(gpu, lease, {}, passed)
        return None

    def _by_turn(self, gpu: Gpu) -> list[Lease]:
        return sorted(
            (lease for lease in self.away.values() if self._may_return(gpu, lease)),
            key=lambda lease: (
                -lease.spec.priority,
                self.absences[lease.id].since,
                lease.request.arrival,
            ),
        )

    def _may_return(self, gpu: Gpu, lease: Lease) -> bool:
        return (
            self.absences[lease.id].comes_back
            and lease.attached
            and gpu.info.id in lease.request.gpus
            and lease.request.load_peak_bytes <= gpu.ledger.budget_bytes
            and not self._left_for_is_here(gpu, lease)
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

    def on_timer(self, core: Core, kind: str, subject: str) -> None:
        """A GPU was quiet for long enough, or a holder did not reattach after a restart."""
        if kind == "return":
            core.wake(core.gpus[GpuId(subject)])
            return
        lease = core.leases[LeaseId(subject)]
        _end(core, lease, LeaseState.CANCELLED, no.Lost(lease.id, Why.NOT_BACK))

    # -- across a restart
    def to_record(self, lease: Lease) -> Mapping[str, Any]:
        """Write down where a lease goes, or how it is away."""
        absence = self.absences.get(lease.id)
        if absence is None:
            return {}
        return {
            "comes_back": absence.comes_back,
            "parks": absence.parks,
            "parked_bytes": self.host.booked.get(lease.id, 0),
            "left_for": absence.left_for,
            "dismissed": absence.dismissed,
        }

    def from_record(self, core: Core, lease: Lease, record: Mapping[str, Any]) -> None:
        """Restore an absence. A lease comes back only after its holder reattached."""
        parked_bytes = int(record.get("parked_bytes", 0))
        if not (_concerns(lease.spec) or parked_bytes or lease.state in AWAY):
            return
        self.watch(lease)
        self.absences[lease.id] = Absence(
            left_for=str(record.get("left_for", "")),
            dismissed=bool(record.get("dismissed", False)),
            comes_back=bool(record.get("comes_back", False)),
            parks=bool(record.get("parks", False)),
            since=core.now,
        )
        self.host.find(lease.id, parked_bytes)
        if lease.state in AWAY:
            self.away[lease.id] = lease
            patience_s = lease.spec.ttl_s + core.settings.fence_grace_s
            core.timers.set(("away", lease.id), core.now + patience_s)

    def on_reattached(self, core: Core, lease: Lease, item: ReattachedLease) -> None:
        """Believe a holder whose lease, it says, is away; its release, or the grant, was lost."""
        if item.away or _concerns(lease.spec):
            self.watch(lease)
        if not item.away:
            return
        if lease.state in AWAY:
            if lease.id not in self.away:  # adopted: the journal did not know it
                comes_back = lease.spec.standby or not item.parked
                self.absences[lease.id] = Absence(comes_back=comes_back, parks=item.parked)
                if item.parked:
                    self.host.find(lease.id, lease.spec.park_bytes)
                self._enter(core, lease)
            core.timers.clear(("away", lease.id))
            _wake(core, lease)
        elif lease.token != item.token:
            core.push(lease, GrantedPush(explain.view(core, lease)))
        elif lease.state in EXPIRING:
            absence = self._of(lease)
            absence.comes_back = lease.spec.standby and not absence.dismissed
            absence.parks = item.parked
            if item.parked:
                self.host.find(lease.id, lease.spec.park_bytes)
            let_go(core, lease, exiting=False, why=Why.LET_GO_BEFORE)

    # -- answers
    def can_park(self, lease: Lease) -> bool:
        """Return whether host RAM is booked for a revoked lease, or has room for another."""
        if lease.departure.eviction is not None:
            return lease.id in self.host.booked
        return lease.spec.park_bytes > 0 and self.host.fits(lease.id, lease.spec.park_bytes)

    def unplaced(self) -> Iterable[Lease]:
        """Leases that are away are on no GPU and in no queue."""
        return self.away.values()

    def check(self, core: Core, *, everything: bool) -> None:
        """Check invariant 4: what is away has no GPU and does not wait; parked bytes fit."""
        parked = self.host.granted_bytes() if self.host.booked else 0
        if parked > self.host.budget_bytes:
            raise InvariantViolation(
                4, f"{parked} bytes are parked, the budget is {self.host.budget_bytes}"
            )
        for lease in self.away.values():
            if lease.state not in AWAY or lease.id not in core.leases:
                raise InvariantViolation(4, f"{lease.id} is {lease.state}, yet it counts as away")
            if lease.gpu is not None or lease.id in core.waiting:
                raise InvariantViolation(
                    4, f"{lease.id} is {lease.state}, yet it has a GPU or waits for one"
                )

    def view(self, core: Core, lease: Lease) -> Mapping[str, object]:
        """Show that a lease comes back by itself, and its bytes in host RAM."""
        shown: dict[str, object] = {"standby": True} if lease.spec.standby else {}
        if lease.id in self.host.booked:
            shown["parked_bytes"] = self.host.booked[lease.id]
        return shown

    def standing(self, core: Core, lease: Lease) -> Standing | None:
        """Tell what a lease that is away waits for on the first GPU that it may return to."""
        if lease.state not in AWAY:
            return None
        gpu = core.gpus[lease.request.planned_gpu or lease.request.gpus[0]]
        back, ahead, due_s = self._outlook(core, lease)
        return Standing(gpu, lease, (lease,), (lease,), back=back, ahead=ahead, due_s=due_s)

    def _outlook(self, core: Core, lease: Lease) -> tuple[Return, str, float | None]:
        """Return what a lease that is away waits for, the consumer before it, and in how many
        seconds it returns."""
        absence = self.absences[lease.id]
        if not lease.attached:
            return Return.HOLDER, "", None
        if not absence.comes_back:
            return Return.ASKED, "", None
        gpu = core.gpus[lease.request.gpus[0]]
        if (head := gpu.queue.head()) is not None:
            return Return.BEHIND, head.spec.consumer, None
        if admission.blocked(core, gpu):
            return Return.BLOCKED, "", None
        if self._left_for_is_here(gpu, lease):
            return Return.LEFT_FOR, absence.left_for, None
        if not admission.fits(gpu, lease):
            return Return.NO_ROOM, "", None
        due_at = self._quiet_at(gpu, lease)
        if due_at > core.now:
            return Return.QUIET, "", due_at - core.now
        return Return.READING, "", None


def _concerns(spec: LeaseSpec) -> bool:
    return spec.standby or spec.park_bytes > 0


def _still_waits(lease: Lease, event: AcquireRequested) -> bool:
    """Return whether the newest acquire of a lease that is away still waits.

    A restart ended its wait: what came back from the journal was, as far as known, not granted
    since it was asked for. A late repeat of one that waited and was granted means nothing.
    """
    return event.nonce == lease.request.nonce and lease.granted_at <= lease.request.arrived_at


def _places(core: Core, event: AcquireRequested | Reacquired, spec: LeaseSpec) -> tuple[GpuId, ...]:
    """Return the GPUs that a lease may come back to on request. Raises Refused."""
    gpus = placement.places(core, spec, drift.expected_bytes(core, spec)[0])
    check_waiters(core, client_of(core, event.client), spec.priority)
    return gpus


def _rename(core: Core, lease: Lease, nonce: str) -> None:
    """Another acquire asks for a lease. The earlier ones are remembered, for their repeats."""
    request = lease.request
    if len(request.earlier_nonces) == NONCES_MAX:
        core.nonces.pop((lease.process, request.earlier_nonces[0]), None)
    request.earlier_nonces.append(request.nonce)
    request.nonce = nonce
    core.nonces[lease.process, nonce] = lease.id


def _expect(core: Core, lease: Lease) -> None:
    request = lease.request
    request.load_peak_bytes, request.steady_bytes = drift.expected_bytes(core, lease.spec)


def _end(core: Core, lease: Lease, to: LeaseState, refusal: End) -> None:
    """End a lease that is away: nothing has to be measured."""
    core.move(lease, to, refusal.why)
    core.note(str(to), lease, why=refusal.why)
    core.end(lease, refusal)


def _wake(core: Core, lease: Lease) -> None:
    for gpu_id in lease.request.gpus:
        core.wake(core.gpus[gpu_id])
