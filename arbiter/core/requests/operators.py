"""What an operator may do by hand: evict, pin and unpin, drain and resume, give up the lease of a
dead holder.

Nothing here weakens the rules for holders: an evicted holder is *asked* and finishes what it does,
and a lease in use is never given up. Every action is a note with the operator and the reason; a pin
and a drain are journalled, so they outlive the daemon. The role was checked where the request came
in.
"""

from collections.abc import Mapping
from typing import Any

from vram_arbiter.arbiter.core.events import OperatorAsked
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import AWAY, EXPIRING, LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.refusals import Impractical, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests.expiry import expire
from vram_arbiter.arbiter.core.requests.requests import client_of, ended_error
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.replies import DrainReply, OperatorReply

DRAIN_KEY = "drain"
"""Journal key of a drain."""
SILENT_SHARE = 2 / 3
"""A holder that has not been heard of for this share of its ttl has missed a renewal, and may be
declared dead."""


def on_operator(core: Core, event: OperatorAsked) -> None:
    """Do it, note it, answer. Raises Refused, and then nothing has changed."""
    client_of(core, event.client)
    order = Order(event.by, event.reason)
    match event.action:
        case "drain":
            drain(core, order)
        case "resume":
            resume(core, order)
        case _:
            lease = find(core, event.target)
            {"evict": evict, "pin": pin, "unpin": unpin, "release_dead": release_dead}[
                event.action
            ](core, lease, order)
            view = explain.view(core, lease) if lease.id in core.leases else None
            core.reply(event.client, event.request, OperatorReply(lease.state, view))
            return
    core.reply(event.client, event.request, DrainReply(drained(core)))


def find(core: Core, target: str) -> Lease:
    """A live lease by its id, or by its consumer's name if that has exactly one. Refuses what names
    none or several."""
    lease = core.leases.get(LeaseId(target))
    if lease is not None:
        return lease
    named = [lease for lease in core.leases.values() if lease.spec.consumer == target]
    resident = [lease for lease in named if lease.state is not LeaseState.QUEUED] or named
    if len(resident) == 1:
        return resident[0]
    if resident:
        raise Refused(no.Ambiguous(target, tuple(lease.id for lease in resident)))
    ended = core.ended.get(LeaseId(target))
    if ended is None:
        raise Refused(no.NoTarget(target))
    raise Refused(no.TargetOver.of(ended_error(ended).refusal))


def evict(core: Core, lease: Lease, order: Order) -> None:
    """Ask a holder to leave, as the engine would for a waiter. In use, it finishes first. Asking
    twice is fine.

    What an operator sends away does not come back by itself: a lease on standby ends with it, a
    parked one waits for its holder.
    """
    if lease.state in AWAY:
        _note(core, "evict", order, lease)
        _dismiss(core, lease, order)
        return
    if lease.state in LEAVING:
        _dismiss(core, lease, order)
        if lease.state is LeaseState.REVOKING and lease.departure.eviction is not None:
            # A holder may let a waiter wait that it would not keep an operator waiting for.
            eviction.push_revoke(core, lease, lease.departure.eviction)
        _note(core, "evict", order, lease, repeated=True)
        return
    if lease.state is not LeaseState.HELD:
        raise _impractical(lease, Impractical.NOT_RESIDENT)
    if not lease.evictable:
        by_operator = lease.pinned is not None
        raise _impractical(
            lease,
            Impractical.PINNED_BY_OPERATOR if by_operator else Impractical.PINNED_BY_HOLDER,
        )
    gpu = core.gpu_of(lease)
    eviction.ask(core, gpu, lease, None, order=order)
    _dismiss(core, lease, order)
    _note(core, "evict", order, lease, uses=len(lease.uses))


def _dismiss(core: Core, lease: Lease, order: Order) -> None:
    if lease.departure.eviction is not None:
        lease.departure.eviction.order = order
    for feature in lease.features:
        feature.on_dismissed(core, lease, order)


def pin(core: Core, lease: Lease, order: Order) -> None:
    """Protect a lease from eviction until it is unpinned. A waiter may be pinned too: it holds from
    its grant on."""
    if lease.state in LEAVING:
        raise _impractical(lease, Impractical.LEAVING)
    lease.pinned = order
    _pins_changed(core, lease)
    _note(core, "pin", order, lease)


def unpin(core: Core, lease: Lease, order: Order) -> None:
    """Undo an operator's pin. What the holder itself asked for stands."""
    if lease.pinned is None:
        raise _impractical(lease, Impractical.NOT_PINNED)
    lease.pinned = None
    _pins_changed(core, lease)
    _note(core, "unpin", order, lease)


def release_dead(core: Core, lease: Lease, order: Order) -> None:
    """Give up a lease whose holder is not heard of, before its time to live is over. Its bytes are
    measured gone as ever."""
    if lease.state not in EXPIRING:
        raise _impractical(lease, Impractical.NOT_HELD)
    if lease.uses:
        raise _impractical(lease, Impractical.IN_USE)
    silent_s = core.now - (lease.expires_at - lease.spec.ttl_s)
    if lease.attached and silent_s < lease.spec.ttl_s * SILENT_SHARE:
        raise _impractical(lease, Impractical.HOLDER_LIVES, silent_s)
    _note(core, "release_dead", order, lease, silent_s=silent_s)
    expire(core, lease, order)


def drain(core: Core, order: Order) -> None:
    """No new grants; what is held is kept, waiters wait. A second drain replaces the reason."""
    core.drain = order
    core.journal(DRAIN_KEY, {"by": order.by, "reason": order.reason})
    _wake_all(core)
    _note(core, "drain", order)


def resume(core: Core, order: Order) -> None:
    """Grant again. Fine where nothing was drained."""
    if core.drain is not None:
        core.drain = None
        core.forget(DRAIN_KEY)
        _wake_all(core)
    _note(core, "resume", order)


def restore_drain(core: Core, record: Mapping[str, Any]) -> None:
    """A drain that was in force when the daemon ended still is."""
    core.drain = Order(str(record["by"]), str(record["reason"]))


def drained(core: Core) -> str:
    """Return the operator that drained the arbiter and the reason; "" while it grants."""
    return "" if core.drain is None else str(core.drain)


def _pins_changed(core: Core, lease: Lease) -> None:
    if lease.state in AWAY:
        core.record_lease(lease)
    if lease.gpu is None:
        return
    core.gpu_of(lease).residents.refresh(lease)
    core.record_lease(lease)
    core.wake(core.gpu_of(lease))


def _wake_all(core: Core) -> None:
    for gpu in core.gpus.values():
        core.wake(gpu)


def _note(core: Core, action: str, order: Order, lease: Lease | None = None, **facts: Any) -> None:
    core.note("operator", lease, action=action, by=order.by, reason=order.reason, **facts)


def _impractical(lease: Lease, problem: Impractical, silent_s: float | None = None) -> Refused:
    evictable = lease.spec.evictable if problem is Impractical.NOT_PINNED else lease.evictable
    return Refused(no.BadTargetState(lease.id, lease.state, problem, evictable, silent_s))
