"""The ladder towards a holder: ask, ask again until heard, remind, deadline.

A holder is only ever *asked*. It unloads by itself at its safe point; the core refuses its
`unloading` before that. What comes after the deadline was agreed by the holder itself
(`on_overstay` of its own lease), and is never done to a process that uses anything.
"""

from typing import Literal

from vram_arbiter.arbiter.core.effects import Signal
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import Eviction, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Cause, Order, Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.pushes import DeniedPush, RevokePush


def ask(
    core: Core,
    gpu: Gpu,
    holder: Lease,
    waiter: Lease | None,
    *,
    order: Order | None = None,
) -> None:
    """Revoke a held lease: for a waiter, by an operator's `order`, or because of pressure.

    A fresh reading is taken, so that the verification has something to compare with.
    """
    cause: Cause = "operator" if order else "waiter" if waiter else "pressure"
    eviction = holder.departure.eviction = Eviction(
        lease=holder.id,
        consumer=holder.spec.consumer,
        charge_bytes=gpu.ledger.charge_bytes(holder.id),
        wanted_by=None if waiter is None else waiter.id,
        wanted_consumer="" if waiter is None else waiter.spec.consumer,
        cause=cause,
        gang="" if waiter is None or waiter.spec.gang is None else waiter.spec.gang[0],
        order=order,
        asked_at=core.now,
        next_push_at=core.now + core.settings.revoke_resend_s,
        traceparent=None if waiter is None else waiter.request.traceparent,
    )
    gpu.evictions.append(eviction)
    core.move(holder, LeaseState.REVOKING, Why.REVOKED)
    core.want_sample(gpu, core.now)
    _push_now(core, holder, eviction)
    if holder.spec.on_overstay != "wait":
        core.timers.set(("overstay", holder.id), _overstays_at(core, holder, eviction))
    core.note(
        "revoke_asked",
        holder,
        wanted_by=eviction.wanted_consumer,
        wanted_by_lease=eviction.wanted_by,
        uses=len(holder.uses),
        cause=eviction.cause,
        **({"gang": eviction.gang} if eviction.gang else {}),
    )


def push_revoke(core: Core, holder: Lease, eviction: Eviction) -> None:
    """`uses` counts what still runs on the lease, also what others marked: at 0 the holder is at
    its safe point."""
    assert holder.token is not None, f"{holder.id} is revoked without a token"
    waiter, order = None, eviction.order
    if eviction.wanted_by is not None and order is None:
        waiter = core.waiting.get(eviction.wanted_by)
    why = eviction.why
    core.push(
        holder,
        RevokePush(
            lease_id=holder.id,
            token=holder.token,
            wanted_by=why.wanted_by,
            deadline_in_s=max(0.0, eviction.asked_at + core.settings.revoke_deadline_s - core.now),
            cause=why.cause,
            gang=why.gang,
            order=order,
            priority=None if waiter is None else waiter.spec.priority,
            uses=len(holder.uses),
            park=any(feature.can_park(holder) for feature in holder.features),
            traceparent=eviction.traceparent or "",
        ),
    )


def acknowledge(core: Core, holder: Lease, eta_s: float | None) -> None:
    """The holder heard. Said once; a repeat only renews the estimate."""
    eviction = holder.departure.eviction
    if eviction is None:
        return
    eviction.safe_point_eta_s = eta_s
    if eviction.acked_at is None:
        eviction.acked_at = core.now
        core.note("revoke_acked", holder, safe_point_eta_s=eta_s, uses=len(holder.uses))


def reached_safe_point(core: Core, holder: Lease) -> None:
    """Tell a revoked holder that the last use has ended: other processes may have marked uses."""
    if (
        holder.departure.eviction is not None
        and holder.state is LeaseState.REVOKING
        and not holder.uses
    ):
        _push_now(core, holder, holder.departure.eviction)


def _push_now(core: Core, holder: Lease, eviction: Eviction) -> None:
    push_revoke(core, holder, eviction)
    eviction.next_push_at = core.now + core.settings.revoke_resend_s
    _set_timer(core, holder, eviction)


def ask_again(core: Core, holder: Lease) -> None:
    """The holder came back on another connection: what it heard on the old one does not count."""
    if holder.departure.eviction is not None and holder.state is LeaseState.REVOKING:
        holder.departure.eviction.acked_at = None
        _push_now(core, holder, holder.departure.eviction)


def on_ladder_due(core: Core, lease_id: str) -> None:
    """Take a step of the ladder.

    A holder that unloads is asked nothing more, and has a whole deadline for it.
    """
    holder = core.leases[LeaseId(lease_id)]
    eviction = holder.departure.eviction
    if holder.state is LeaseState.UNLOADING:
        _unload_hangs(core, holder)
        return
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


def _unload_hangs(core: Core, holder: Lease) -> None:
    """It unloads, and has not ended within a deadline. Others are asked in its place, and the card
    is not kept free for its bytes."""
    holder.departure.hangs = True
    if holder.departure.eviction is not None:
        holder.departure.eviction.overdue = True
    _deadline(core, holder, holder.departure.eviction)


def _deadline(core: Core, holder: Lease, eviction: Eviction | None) -> None:
    """The holder outstayed. Its waiter is denied if that is its wish; the `revoke` stands in any
    case."""
    wanted_by, consumer = (eviction.wanted_by, eviction.wanted_consumer) if eviction else (None, "")
    core.note("deadline_passed", holder, uses=len(holder.uses), wanted_by=consumer)
    core.wake(core.gpu_of(holder))
    waiter = core.waiting.get(wanted_by) if wanted_by is not None else None
    for gpu_id in () if waiter is None else waiter.request.gpus:
        core.wake(core.gpus[gpu_id])  # it may be served on another card now
    if waiter is None or not waiter.spec.deny_on_deadline:
        return
    deadline_s, uses = core.settings.revoke_deadline_s, len(holder.uses)
    deny(core, waiter, no.HolderOutstays(holder.id, holder.spec.consumer, uses, deadline_s))


def on_overstay_due(core: Core, lease_id: str) -> None:
    """Has the holder outstayed, idle, for the whole deadline since its last use or step? Then its
    process is told to end, as it agreed.

    Nothing is done to a process that uses any lease, its own or another's: that is looked at again
    later.
    """
    holder = core.leases[LeaseId(lease_id)]
    eviction = holder.departure.eviction
    if eviction is None or holder.state not in (LeaseState.REVOKING, LeaseState.UNLOADING):
        return
    due_at = _overstays_at(core, holder, eviction)
    if _process_in_use(core, holder):
        due_at = core.now + core.settings.revoke_deadline_s
    if due_at > core.now:
        core.timers.set(("overstay", holder.id), due_at)
        return
    kind: Literal["term", "kill"] = "kill" if eviction.signalled else "term"
    eviction.signalled = kind
    core.turn.effects.append(Signal(holder.process, kind))
    core.note(
        "signalled",
        holder,
        signal=kind,
        pid=holder.process.pid,
        wanted_by=eviction.wanted_consumer,
        asked_s=core.now - eviction.asked_at,
        on_overstay=holder.spec.on_overstay,
    )
    if kind == "term" and holder.spec.on_overstay == "kill":
        core.timers.set(("overstay", holder.id), core.now + core.settings.terminate_grace_s)


def _overstays_at(core: Core, holder: Lease, eviction: Eviction) -> float:
    """A whole deadline after it was asked, after its last use and after its last step towards the
    exit."""
    if eviction.signalled:
        return core.now
    return (
        max(eviction.asked_at, holder.uses.last_at, holder.since) + core.settings.revoke_deadline_s
    )


def _process_in_use(core: Core, holder: Lease) -> bool:
    return holder.process in core.users or any(
        lease.uses for lease in core.leases_of(holder.process)
    )


def deny(core: Core, waiter: Lease, refusal: Refusal) -> None:
    """End a waiter's wait with a refusal."""
    core.move(waiter, LeaseState.DENIED, refusal.code)
    core.dequeue(waiter)
    if waiter.request.answered or waiter.request.id is None:
        core.push(waiter, DeniedPush(waiter.request.extends or waiter.id, refusal.view()))
    else:  # it has only just asked
        core.refuse(waiter.client, waiter.request.id, refusal)
    core.note("denied", waiter, code=refusal.code, refusal=refusal)
    core.end(waiter, refusal)


def _set_timer(core: Core, holder: Lease, eviction: Eviction) -> None:
    times = [eviction.asked_at + core.settings.revoke_deadline_s] if not eviction.overdue else []
    if not eviction.reminded:
        times.append(eviction.asked_at + core.settings.revoke_remind_s)
    if eviction.acked_at is None or not holder.uses:
        times.append(eviction.next_push_at)
    if times:
        core.timers.set(("revoke", holder.id), min(times))
