"""What an operator may do by hand: evict, pin and unpin, drain and resume, give up the lease of a dead holder.

Nothing here weakens the rules for holders: an evicted holder is *asked* and finishes what it does, and a lease in use is never
given up. Every action is a note that says who and why; a pin and a drain are journalled, so they outlive the daemon.
The role was checked where the request came in.
"""

from collections.abc import Mapping
from typing import Any

from vram_arbiter.arbiter.core.events import OperatorAsked
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.model.lease import AWAY, EXPIRING, LEAVING, Lease, LeaseState, Order
from vram_arbiter.arbiter.core.model.state import Core, Refused
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests.expiry import expire
from vram_arbiter.arbiter.core.requests.requests import client_of, ended_error
from vram_arbiter.schemas.ids import LeaseId

DRAIN_KEY = "drain"
"""Journal key of a drain."""
SILENT_SHARE = 2 / 3
"""A holder that has not been heard of for this share of its ttl has missed a renewal, and may be declared dead."""


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
            body = (
                {"lease": explain.view(core, lease)} if lease.id in core.leases else {"lease": None}
            )
            core.reply(event.client, event.request, {"state": str(lease.state), **body})
            return
    core.reply(event.client, event.request, {"drained": drained(core)})


def find(core: Core, target: str) -> Lease:
    """A live lease by its id, or by its consumer's name if that has exactly one. Refuses what names none or several."""
    lease = core.leases.get(LeaseId(target))
    if lease is not None:
        return lease
    named = [lease for lease in core.leases.values() if lease.spec.consumer == target]
    resident = [lease for lease in named if lease.state is not LeaseState.QUEUED] or named
    if len(resident) == 1:
        return resident[0]
    if resident:
        raise Refused(
            "bad_request",
            f"{target} has {len(resident)} leases",
            "name one of them: " + ", ".join(lease.id for lease in resident),
            leases=[lease.id for lease in resident],
        )
    ended = core.ended.get(LeaseId(target))
    if ended is not None:
        why = ended_error(ended)
        raise Refused(
            why.code, why.message, "it is over; its story is in `vramctl history`", **why.details
        )
    raise Refused(
        "unknown_lease", f"there is no lease or consumer {target!r}", "see `vramctl status`"
    )


def evict(core: Core, lease: Lease, order: Order) -> None:
    """Ask a holder to leave, as the engine would for a waiter. In use, it finishes first. Asking twice is fine.

    What an operator sends away does not come back by itself: a lease on standby ends with it, a parked one waits for its holder.
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
        raise _refused_state(lease, "only a resident lease can be evicted")
    if not lease.evictable:
        by = "an operator pinned it" if lease.pinned else "its holder asked never to be evicted"
        hint = (
            "unpin it first"
            if lease.pinned
            else "end its program: a pinned holder is never made to leave"
        )
        raise Refused(
            "bad_state",
            f"{lease.id} is pinned: {by}",
            hint,
            state=str(lease.state),
        )
    gpu = core.gpu_of(lease)
    eviction.ask(core, gpu, lease, None, f"evicted by {order}", order=order)
    _dismiss(core, lease, order)
    _note(core, "evict", order, lease, uses=len(lease.uses))


def _dismiss(core: Core, lease: Lease, order: Order) -> None:
    if lease.departure.eviction is not None:
        lease.departure.eviction.order = order
    for feature in lease.features:
        feature.on_dismissed(core, lease, f"evicted by {order}")


def pin(core: Core, lease: Lease, order: Order) -> None:
    """Nobody makes this lease leave until it is unpinned. A waiter may be pinned too: it holds from its grant on."""
    if lease.state in LEAVING:
        raise _refused_state(lease, "it was asked to leave already")
    lease.pinned = order
    _pins_changed(core, lease)
    _note(core, "pin", order, lease)


def unpin(core: Core, lease: Lease, order: Order) -> None:
    """Undo an operator's pin. What the holder itself asked for stands."""
    if lease.pinned is None:
        hint = (
            "nothing to undo"
            if lease.spec.evictable
            else "its holder asked never to be evicted; that is its own to change"
        )
        raise Refused("bad_state", f"no operator pinned {lease.id}", hint, state=str(lease.state))
    lease.pinned = None
    _pins_changed(core, lease)
    _note(core, "unpin", order, lease)


def release_dead(core: Core, lease: Lease, order: Order) -> None:
    """Give up a lease whose holder is not heard of, before its time to live is over. Its bytes are measured gone as ever."""
    if lease.state not in EXPIRING:
        raise _refused_state(lease, "nobody holds it")
    if lease.uses:
        raise _refused_state(lease, "it is in use; a holder in use is never given up")
    silent_s = core.now - (lease.expires_at - lease.spec.ttl_s)
    if lease.attached and silent_s < lease.spec.ttl_s * SILENT_SHARE:
        raise Refused(
            "bad_state",
            f"the holder of {lease.id} was heard of {silent_s:.1f} s ago: it is not dead",
            "evict it instead" if lease.evictable else "end its program: it is pinned",
            state=str(lease.state),
            silent_s=silent_s,
        )
    _note(core, "release_dead", order, lease, silent_s=silent_s)
    expire(core, lease, f"{lease.id} was given up by {order}")


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
    """Who drained the arbiter and why; "" while it grants."""
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


def _refused_state(lease: Lease, what: str) -> Refused:
    return Refused(
        "bad_state",
        f"{lease.id} is {lease.state}: {what}",
        "see `vramctl status`",
        state=str(lease.state),
    )
