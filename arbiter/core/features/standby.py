"""Leases that live on without bytes on a card: on standby they come back by themselves when there is room, parked they keep their
weights in host RAM meanwhile (and come back by themselves only if they are on standby too).

Coming back is a favour, never a claim: nobody is asked to leave for it, nobody who waits is passed by, and it stays away while the
consumer that it left for is on the card. A holder that needs its lease *now* says so (`reacquire`) and is a waiter like any other.
Chooses who comes back; the grant itself is in `grants`. Must not know clients or requests beyond their ids.
"""

from collections.abc import Iterator
from functools import partial

from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.model.lease import AWAY, Departure, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.scheduling import placement, policy
from vram_arbiter.schemas.ids import ClientId, ModelKey, ProcessKey, RequestId

NOT_BACK = "its holder did not come back after the restart"


# -- going away ------------------------------------------------------------------------------------------------------
def stays_on(lease: Lease) -> bool:
    """Whether a lease goes on standby when it releases now: only one that the engine revoked.

    A holder that releases by itself does not want it back, and an operator who evicts it does not either.
    """
    asked = lease.departure.eviction is not None or lease.departure.revoked_before
    return lease.spec.standby and asked and not lease.dismissed


def next_state(lease: Lease) -> LeaseState:
    """Where a lease that let go is, or goes after its verdict."""
    if lease.state in AWAY:
        return lease.state
    if lease.parks:
        return LeaseState.PARKED
    return LeaseState.STANDBY if lease.comes_back else LeaseState.RELEASED


def settle(core: Core, lease: Lease, verdict: str) -> None:
    """Its bytes are measured gone: the end, or away."""
    if not (lease.comes_back or lease.parks):
        lease.move(LeaseState.RELEASED, core.now, verdict)
        core.end(lease, None)
        return
    gpu = core.gpu_of(lease)
    del gpu.residents[lease.id]
    core.timers.clear(("overstay", lease.id))
    core.wake(gpu)
    lease.move(next_state(lease), core.now, verdict)
    lease.departure = Departure()
    lease.gpu = lease.observed.reported_bytes = lease.request.id = None
    lease.request.load_peak_bytes, lease.request.steady_bytes = drift.expected_bytes(
        core, lease.spec
    )
    lease.request.gpus = tuple(gpu.info.id for gpu in placement.selected(core, lease.spec))
    lease.request.evicted = []
    lease.request.answered = True
    enter(core, lease)
    core.note(
        str(lease.state),
        lease,
        left_for=lease.left_for,
        parked_bytes=core.host.booked.get(lease.id, 0),
        reason=f"comes back {'by itself when there is room' if lease.comes_back else 'when its holder asks'}",
    )
    if lease.recalled is not None:
        recall, lease.recalled = lease.recalled, None
        queue_again(core, lease, lease.client, None, recall.asked_at, recall.wait_timeout_s)


def enter(core: Core, lease: Lease) -> None:
    """It is away from now on, in the journal too."""
    lease.away_since = core.now
    core.away[lease.id] = lease
    core.record_lease(lease)
    wake_all(core, lease)


def renounce(core: Core, lease: Lease) -> None:
    """A lease under measurement whose holder does not want it back, nor keeps anything of it."""
    lease.comes_back = lease.parks = False
    lease.recalled = None
    core.host.drop(lease.id)


def send_off(core: Core, lease: Lease, why: str) -> None:
    """An operator does not want it back. On standby it ends, and its holder is told; parked it stays until its holder asks."""
    if lease.state is LeaseState.PARKED:
        lease.comes_back = False
        core.record_lease(lease)
        return
    token = lease.token
    assert token is not None, f"{lease.id} is away and was never granted"
    error = {
        "code": "lease_lost",
        "message": f"{lease.id}: {why}",
        "hint": "acquire again",
        "details": {},
    }
    told = {
        "push": "lost",
        "lease_id": lease.id,
        "token": [token.epoch, token.serial],
        "error": error,
    }
    core.push(lease, told)
    give_up(core, lease, LeaseState.CANCELLED, "lease_lost", why)


def give_up(core: Core, lease: Lease, to: LeaseState, code: str, why: str) -> None:
    """A lease that is away ends; nothing has to be measured."""
    lease.move(to, core.now, why)
    core.note(str(to), lease, reason=why)
    core.end(
        lease,
        {"code": code, "message": f"{lease.id}: {why}", "hint": "acquire again", "details": {}},
    )


# -- coming back -----------------------------------------------------------------------------------------------------
def find(core: Core, process: ProcessKey, consumer: str, key: ModelKey) -> Lease | None:
    """The lease of this process for this model that is away: a new acquire takes it over."""
    if not core.away:
        return None
    return next(
        (
            lease
            for lease in core.leases_of(process)
            if lease.state in AWAY and (lease.spec.consumer, lease.spec.key) == (consumer, key)
        ),
        None,
    )


def queue_again(
    core: Core,
    lease: Lease,
    client: ClientId,
    request: RequestId | None,
    asked_at: float,
    wait_timeout_s: float | None,
) -> None:
    """From away into the queues, as somebody who came at `asked_at`. Without a request it is told by push."""
    del core.away[lease.id]
    lease.move(LeaseState.QUEUED, core.now, "wanted again")
    core.timers.clear(("ttl", lease.id))  # after a restart: whoever asks has come back
    lease.attached = True
    core.hand_to(lease, client)
    lease.request.id = request
    lease.request.answered = request is None
    lease.request.arrived_at = asked_at
    lease.request.arrival = core.next_arrival()
    lease.request.wait_timeout_s = wait_timeout_s
    lease.request.planned_gpu = None
    core.enqueue(lease)


def taken_back(core: Core, lease: Lease) -> bool:
    """The lease is being granted. Did it come back by itself? Then it has waited for nothing, and has no claim to stay yet."""
    lease.comes_back = lease.parks = lease.departure.revoked_before = lease.dismissed = False
    lease.uncalled = lease.returned = core.away.pop(lease.id, None) is not None
    if lease.uncalled:
        lease.request.arrived_at = core.now
    return lease.uncalled


def next_back(core: Core, gpu: Gpu) -> Lease | None:
    """Who comes back to this card, on which nobody waits: by priority, then who left first.

    One that does not fit yet keeps its turn: others pass it only where it would still fit beside them. The card has to be quiet
    for the lease's own minimum residency first: between two goals a policy is away for a moment only.
    """
    ahead: Lease | None = None
    spare_bytes = 0
    for lease in _by_turn(core, gpu):
        if ahead is not None and (
            ahead.spec.exclusive or policy.added_bytes(gpu, lease) > spare_bytes
        ):
            continue
        if policy.fits(gpu, lease):
            due_at = _quiet_at(gpu, lease)
            if due_at <= core.now:
                return lease
            core.timers.set(("return", gpu.info.id), due_at)
            return None
        if ahead is None:
            ahead = lease
            spare_bytes, _ = policy.spare_unplanned_bytes(
                gpu, lease, {}, partial(_returned_since, lease)
            )
    return None


def outlook(core: Core, lease: Lease) -> str:
    """What it waits for, in words; of several cards the first that it may return to."""
    where = "parked" if lease.state is LeaseState.PARKED else "on standby"
    return f"{where}{_outlook(core, lease)}"


def _outlook(core: Core, lease: Lease) -> str:
    if not lease.attached:
        return f", but {NOT_BACK}"
    if not lease.comes_back:
        return " in host RAM until its holder asks for it"
    gpu = core.gpus[lease.request.gpus[0]]
    blocked = policy.blocked(core, gpu)
    head = gpu.queue.head()
    if head is not None:
        return f": {head.spec.consumer} waits, and goes first"
    if blocked:
        return f": {blocked}"
    if _left_for_is_here(gpu, lease):
        return f" until {lease.left_for} has left"
    if not policy.fits(gpu, lease):
        return " until there is room; it asks nobody to leave"
    due_at = _quiet_at(gpu, lease)
    if due_at > core.now:
        return f": comes back in {due_at - core.now:.1f} s if the card stays quiet"
    return ": comes back with the next reading of the card, or after those before it"


def wake_all(core: Core, lease: Lease) -> None:
    for gpu_id in lease.request.gpus:
        core.wake(core.gpus[gpu_id])


def _by_turn(core: Core, gpu: Gpu) -> list[Lease]:
    return sorted(
        _returning(core, gpu),
        key=lambda lease: (-lease.spec.priority, lease.away_since, lease.request.arrival),
    )


def _returning(core: Core, gpu: Gpu) -> Iterator[Lease]:
    return (
        lease
        for lease in core.away.values()
        if lease.comes_back
        and lease.attached
        and gpu.info.id in lease.request.gpus
        and lease.request.load_peak_bytes <= gpu.ledger.budget_bytes
        and not _left_for_is_here(gpu, lease)
    )


def _returned_since(ahead: Lease, other: Lease) -> bool:
    """Has it come back while this one was away? It would not be asked to make room for it."""
    return other.returned and other.granted_at >= ahead.away_since


def _left_for_is_here(gpu: Gpu, lease: Lease) -> bool:
    return bool(lease.left_for) and any(
        other.spec.consumer == lease.left_for for other in gpu.residents.values()
    )


def _quiet_at(gpu: Gpu, lease: Lease) -> float:
    return max(gpu.changed_at, lease.away_since) + lease.spec.min_residency_s
