"""Standby and parking: leases that live on without bytes on a GPU.

A lease on standby comes back by itself when there is room. A parked lease keeps its weights in
host RAM, and comes back by itself only if it is on standby too. Coming back is a favor, never a
claim: no holder is revoked for it, no waiter is passed by, and the lease stays away while the
consumer that it left for is on the GPU. A holder that needs its lease now acquires or reacquires
it, and waits in the queues like any other.

`Lease.standby` follows such a lease from its first revoke to its end:
  revoking: host RAM for its weights is booked, so that its holder can count on it
  verifying: its release decided whether it parks and whether it comes back; else its RAM is free
  parked, standby: its bytes are measured gone; it is away (`go_away`)
  queued: its holder wants it back (`wanted`, `call_back`)
  loading: it was granted, or came back by itself (`first_to_return`)
  held: its weights are resident, its RAM is free
Its ends: `dismiss` by an operator, `give_up` by its holder, `Core.end_away`.
"""

from collections.abc import Iterable, Mapping

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import AWAY, Departure, Lease, LeaseState
from vram_arbiter.arbiter.core.model.refusals import End
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.notes import ParkedNote, StandbyNote
from vram_arbiter.schemas.wire.pushes import LostPush
from vram_arbiter.schemas.wire.requests import Acquire, Reacquire
from vram_arbiter.schemas.wire.spec import LeaseSpec


# -- leaving ---------------------------------------------------------------------------------------
def go_away(core: Core, lease: Lease, to: LeaseState, verdict: str) -> None:
    """Take a lease off its GPU, whose bytes are measured gone, and let it live on."""
    gpu, request, standby = core.gpu_of(lease), lease.request, lease.standby
    core.move(lease, to, verdict)
    gpu.residents.remove(lease)
    gpu.wake()
    lease.departure = Departure()
    lease.gpu = lease.observed.reported_bytes = request.id = None
    request.gpus = tuple(gpu.info.id for gpu in admission.selected(core.gpus, lease.spec))
    request.evicted = []
    request.load_peak_bytes, request.steady_bytes = core.footprints.expected_bytes(lease.spec)
    standby.since = core.now
    core.record_lease(lease)
    core.wake_candidates(lease)
    note = ParkedNote if to is LeaseState.PARKED else StandbyNote
    parked_bytes = core.host_ram.booked.get(lease.id, 0)
    core.note(note(standby.left_for, parked_bytes, standby.comes_back), lease)
    if standby.recalled_at is not None:
        asked_at, standby.recalled_at = standby.recalled_at, None
        core.requeue(lease, lease.client, None, asked_at)


# -- ends ------------------------------------------------------------------------------------------
def dismiss(core: Core, lease: Lease, order: Order) -> None:
    """Do not bring back what an operator evicts.

    On standby a lease ends; parked it stays until its holder asks.
    """
    standby = lease.standby
    standby.comes_back, standby.recalled_at = False, None
    if lease.state is LeaseState.STANDBY:
        refusal = no.Lost(lease.id, Why.EVICTED, order=order)
        assert lease.token is not None, f"{lease.id} is away and was never granted"
        core.push(lease, LostPush(lease.id, lease.token, refusal.view()))
        core.end_away(lease, LeaseState.CANCELLED, refusal)
        return
    standby.dismissed = lease.state is not LeaseState.PARKED
    if lease.spec.standby or lease.state is LeaseState.PARKED:
        core.record_lease(lease)


def give_up(core: Core, lease: Lease, to: LeaseState, refusal: End) -> bool:
    """End a lease that is away. One that is on its way there ends with its verdict. Return whether
    it was either."""
    if lease.state in AWAY:
        core.end_away(lease, to, refusal)
        return True
    if lease.state is not LeaseState.VERIFYING or lease.next_state is None:
        return False
    standby = lease.standby
    standby.comes_back = standby.parks = False
    standby.recalled_at = None
    core.host_ram.free(lease.id)
    core.record_lease(lease)
    return True


def on_away_due(core: Core, lease_id: str) -> None:
    """A holder did not reattach after a restart."""
    lease = core.leases[LeaseId(lease_id)]
    give_up(core, lease, LeaseState.CANCELLED, no.Lost(lease.id, Why.NOT_BACK))


# -- wanted by the holder --------------------------------------------------------------------------
def wanted(mine: Iterable[Lease], request: Acquire, known: Lease | None) -> Lease | None:
    """Return the lease that is away and that an acquire wants back; None: there is none.

    That is the one of its nonce (`known`), or the first of its process (`mine`) for the same model.
    """
    if known is not None:
        # a restart ended its wait, if the journal knows no grant since it was asked for; a late
        # repeat of one that waited and was granted means nothing
        waits = known.granted_at <= known.request.arrived_at
        waits = waits and request.nonce == known.request.nonce and known.state in AWAY
        return known if waits else None
    model = (request.spec.consumer, request.spec.model)
    away = [lease for lease in mine if lease.state in AWAY]
    return next((one for one in away if (one.spec.consumer, one.spec.model) == model), None)


def call_back(
    core: Core, lease: Lease, asked: ev.Asked, wish: Acquire | Reacquire, spec: LeaseSpec
) -> None:
    """Queue a lease that is away, as it is asked for now. Raises Refused."""
    client, request = core.clients[asked.client], lease.request
    load_peak, steady = core.footprints.expected_bytes(spec)
    gpus = admission.places(core.gpus, spec, load_peak)
    admission.check_waiters(core.settings, core.waiting, client, spec.priority)
    request.load_peak_bytes, request.steady_bytes = load_peak, steady
    if isinstance(wish, Acquire) and wish.nonce != request.nonce:
        core.rename(lease, wish.nonce)
        lease.spec = spec
        core.record_lease(lease)  # still away: if a restart ends the wait, it comes back so
    request.traceparent, request.gpus, request.uid = asked.traceparent, gpus, client.uid
    request.wait_timeout_s = wish.wait_timeout_s
    core.requeue(lease, asked.client, asked.id, core.now)
    core.costs.wanted(spec.consumer, core.now)
    core.turn.unanswered = lease


# -- coming back by itself -------------------------------------------------------------------------
def first_to_return(away: Mapping[LeaseId, Lease], gpu: Gpu) -> Lease | None:
    """Return the lease that comes back next to a GPU for which nothing waits; None: none fits.

    By priority, then in the order of their leaving. One that does not fit yet keeps its turn:
    others pass it only where it would still fit beside them.
    """
    in_turn = _by_turn(away, gpu)
    if not in_turn or admission.fits(gpu, in_turn[0]):
        return next(iter(in_turn), None)
    ahead, *others = in_turn
    if ahead.spec.exclusive:
        return None
    since = ahead.standby.since
    spare_bytes, _ = admission.spare_unplanned_bytes(
        gpu, ahead, {}, lambda one: one.standby.returned and one.granted_at >= since
    )
    beside = (one for one in others if admission.added_bytes(gpu, one) <= spare_bytes)
    return next((one for one in beside if admission.fits(gpu, one)), None)


def quiet_at(gpu: Gpu, lease: Lease) -> float:
    """Return when a GPU was quiet for the lease's minimum residency, before which it does not come
    back: between two goals a policy is away for a moment only."""
    return max(gpu.changed_at, lease.standby.since) + lease.spec.min_residency_s


def left_for_is_here(gpu: Gpu, lease: Lease) -> bool:
    """Return whether the consumer that a lease left for is on a GPU."""
    left_for = lease.standby.left_for
    return any(other.spec.consumer == left_for for other in gpu.residents.values())


def _by_turn(away: Mapping[LeaseId, Lease], gpu: Gpu) -> list[Lease]:
    """Return the leases that may return to a GPU, the first to do so first."""
    found = [
        lease
        for lease in away.values()
        if lease.standby.comes_back
        and lease.attached
        and gpu.info.id in lease.request.gpus
        and lease.request.load_peak_bytes <= gpu.ledger.budget_bytes
        and not left_for_is_here(gpu, lease)
    ]
    return sorted(
        found,
        key=lambda lease: (-lease.spec.priority, lease.standby.since, lease.request.arrival),
    )
