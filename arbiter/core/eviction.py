"""The ladder towards a holder: ask, ask again until heard, remind, deadline.

A holder is only ever *asked*. It unloads by itself at its safe point; the core refuses its `unloading` before that.
"""

from collections.abc import Mapping
from typing import Any

from arbiter.core.lease import Eviction, Lease, LeaseState
from arbiter.core.state import Core, Gpu
from schemas.ids import LeaseId


def ask(core: Core, gpu: Gpu, holder: Lease, waiter: Lease | None, reason: str) -> None:
    """Send the first `revoke` and start the ladder. A fresh reading is taken, so that there is something to compare with."""
    holder.left_for = "" if waiter is None else waiter.spec.consumer
    holder.eviction = Eviction(
        lease=holder.id,
        consumer=holder.spec.consumer,
        charge_bytes=gpu.ledger.charge_bytes(holder.id),
        wanted_by=None if waiter is None else waiter.id,
        wanted_consumer=holder.left_for,
        reason=reason,
        asked_at=core.now,
        next_push_at=core.now + core.settings.revoke_resend_s,
    )
    gpu.evictions.append(holder.eviction)
    holder.move(LeaseState.REVOKING, core.now, reason)
    parks = core.host.book(holder.id, holder.spec.park_bytes)
    if (
        holder.spec.standby or parks
    ):  # a restart must not take a release that was asked for as one that was wished for
        core.record_lease(holder)
    core.want_sample(gpu, core.now)
    _push_now(core, holder, holder.eviction)
    core.note(
        "revoke_asked",
        holder,
        wanted_by=holder.eviction.wanted_consumer,
        wanted_by_lease=holder.eviction.wanted_by,
        uses=len(holder.uses),
        reason=reason,
    )


def push_revoke(core: Core, holder: Lease, eviction: Eviction) -> None:
    """`uses` counts what still runs on the lease, also what others marked: at 0 the holder is at its safe point."""
    assert holder.token is not None, f"{holder.id} is revoked without a token"
    core.push(
        holder,
        {
            "push": "revoke",
            "lease_id": holder.id,
            "token": [holder.token.epoch, holder.token.serial],
            "reason": eviction.reason,
            "wanted_by": eviction.wanted_consumer,
            "deadline_in_s": max(0.0, eviction.asked_at + core.settings.revoke_deadline_s - core.now),
            "uses": len(holder.uses),
            "park": holder.id in core.host.booked,
        },
    )


def acknowledge(core: Core, holder: Lease, eta_s: float | None) -> None:
    """The holder heard. Said once; a repeat only renews the estimate."""
    eviction = holder.eviction
    if eviction is None:
        return
    eviction.safe_point_eta_s = eta_s
    if eviction.acked_at is None:
        eviction.acked_at = core.now
        core.note("revoke_acked", holder, safe_point_eta_s=eta_s, uses=len(holder.uses))


def reached_safe_point(core: Core, holder: Lease) -> None:
    """The last use ended while the holder is asked to leave: tell it, it may not know of uses that others marked."""
    if holder.eviction is not None and holder.state is LeaseState.REVOKING:
        _push_now(core, holder, holder.eviction)


def _push_now(core: Core, holder: Lease, eviction: Eviction) -> None:
    push_revoke(core, holder, eviction)
    eviction.next_push_at = core.now + core.settings.revoke_resend_s
    _set_timer(core, holder, eviction)


def ask_again(core: Core, holder: Lease) -> None:
    """The holder came back on another connection: what it heard on the old one does not count."""
    if holder.eviction is not None and holder.state is LeaseState.REVOKING:
        holder.eviction.acked_at = None
        _push_now(core, holder, holder.eviction)


def on_ladder_due(core: Core, lease_id: str) -> None:
    """A step of the ladder. Steps are for holders that have not begun to unload."""
    holder = core.leases[LeaseId(lease_id)]
    eviction = holder.eviction
    if eviction is None or holder.state is not LeaseState.REVOKING:
        return
    settings = core.settings
    if core.now >= eviction.next_push_at:
        eviction.next_push_at = core.now + settings.revoke_resend_s
        if eviction.acked_at is None or not holder.uses:
            push_revoke(core, holder, eviction)
    if not eviction.reminded and core.now >= eviction.asked_at + settings.revoke_remind_s:
        eviction.reminded = True
        core.note("reminded", holder, uses=len(holder.uses), acked=eviction.acked_at is not None)
    if not eviction.overdue and core.now >= eviction.asked_at + settings.revoke_deadline_s:
        eviction.overdue = True
        _deadline(core, holder, eviction)
    _set_timer(core, holder, eviction)


def _deadline(core: Core, holder: Lease, eviction: Eviction) -> None:
    """The holder outstayed. Its waiter is denied if that is its wish; the `revoke` stands in any case."""
    core.note("deadline_passed", holder, uses=len(holder.uses), wanted_by=eviction.wanted_consumer)
    core.wake(core.gpu_of(holder))
    waiter = core.waiting.get(eviction.wanted_by) if eviction.wanted_by is not None else None
    if waiter is None or not waiter.spec.deny_on_deadline:
        return
    message = f"{holder.spec.consumer} did not leave within {core.settings.revoke_deadline_s:g} s"
    deny(
        core,
        waiter,
        {
            "code": "holder_busy",
            "message": message,
            "hint": "try again later, or wait: on_deadline=wait",
            "details": {"lease_id": holder.id, "consumer": holder.spec.consumer, "uses": len(holder.uses)},
        },
    )


def deny(core: Core, waiter: Lease, error: Mapping[str, Any]) -> None:
    """End a waiter's wait with a typed error."""
    waiter.move(LeaseState.DENIED, core.now, str(error["message"]))
    core.dequeue(waiter)
    core.push(waiter, {"push": "denied", "lease_id": waiter.id, "error": error})
    core.note("denied", waiter, code=error["code"], reason=error["message"])
    core.end(waiter, error)


def _set_timer(core: Core, holder: Lease, eviction: Eviction) -> None:
    times = [eviction.asked_at + core.settings.revoke_deadline_s] if not eviction.overdue else []
    if not eviction.reminded:
        times.append(eviction.asked_at + core.settings.revoke_remind_s)
    if eviction.acked_at is None or not holder.uses:
        times.append(eviction.next_push_at)
    if times:
        core.timers.set(("revoke", holder.id), min(times))
