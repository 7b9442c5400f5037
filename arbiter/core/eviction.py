"""Eviction ladder of a revoked holder.

| step      | when                                                   | what                            |
| --------- | ------------------------------------------------------ | ------------------------------- |
| push      | at once, then every `revoke_resend_s` while the holder | `revoke`                        |
|           | has not acknowledged, or is at its safe point          |                                 |
| remind    | `revoke_remind_s` after the first push                 | a note                          |
| deadline  | `revoke_deadline_s` after it, and again so long after  | a note; the bytes are not       |
|           | the unloading began                                    | counted on                      |

A holder unloads by itself, at its safe point: `unloading` is refused before that. The engine waits;
ending a stuck holder is a person's order (`operators.kill`). A revoke is for someone: when nothing
wants the bytes any more and the holder has not begun to unload, it is withdrawn.

Public: `ask` revokes a holder; `push_revoke` repeats that at once; `take_back` and `settle`
withdraw revokes that nothing wants (`is_wanted`); `on_ladder_due` serves the timer.
"""

from collections.abc import Container

from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Eviction, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Order, RevokeCause, Why
from vram_arbiter.schemas.wire.notes import (
    DeadlinePassedNote,
    RemindedNote,
    RevokeAskedNote,
    RevokeWithdrawnNote,
)
from vram_arbiter.schemas.wire.pushes import RevokePush, RevokeWithdrawnPush


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
    if waiter is None:
        why = RevokeCause("operator" if order else "pressure", order=order)
    else:
        why = RevokeCause("waiter", waiter.spec.consumer)
    eviction = holder.departure.eviction = Eviction(
        lease=holder.id,
        consumer=holder.spec.consumer,
        charge_bytes=gpu.ledger.charge_bytes(holder.id),
        wanted_by=None if waiter is None else waiter.id,
        why=why,
        asked_at=core.now,
        next_push_at=core.now,
        traceparent=None if waiter is None else waiter.request.traceparent,
    )
    if waiter is not None:
        gpu.evictions.append(eviction)
    core.move(holder, LeaseState.REVOKING, Why.REVOKED)
    holder.standby.left_for = why.wanted_by
    if core.host_ram.book(holder.id, holder.spec.park_bytes) or holder.spec.standby:
        # a restart must not take a release that was asked for as one that was wished for
        core.record_lease(holder)
    gpu.want_sample(core.now, core.now)
    push_revoke(core, holder)
    asked = RevokeAskedNote(
        wanted_by=why.wanted_by,
        wanted_by_lease=eviction.wanted_by,
        uses=len(holder.uses),
        cause=why.cause,
        order=why.order,
    )
    core.note(asked, holder)


# -- withdrawn
def is_wanted(waiting: Container[LeaseId | None], gpu: Gpu, eviction: Eviction) -> bool:
    """Return whether anything wants the room of a revoked holder: its waiter waits, the GPU is
    under pressure, or an operator ordered it."""
    match eviction.why.cause:
        case "waiter":
            return eviction.wanted_by in waiting
        case "pressure":
            return gpu.ledger.pressed
        case _:
            return True


def take_back(core: Core, gpu: Gpu) -> None:
    """Let scheduling decide anew on holders that were revoked and do not unload yet, if nothing
    wants their room any more; `settle` has to follow."""
    for holder in gpu.in_state(LeaseState.REVOKING):
        asked = holder.departure.eviction
        if asked is None or is_wanted(core.waiting, gpu, asked):
            continue
        core.turn.taken_back.setdefault(holder.id, asked)
        holder.departure.eviction = None
        core.timers.cancel(("revoke", holder.id))
        core.move(holder, LeaseState.HELD, Why.WITHDRAWN)


def settle(core: Core) -> None:
    """Tell each holder that was not revoked again that it may stay; for the others the
    acknowledgement counts that they gave. Forget evictions whose waiter is gone."""
    for gpu in core.gpus.values():
        if gpu.touched:
            gpu.evictions = [one for one in gpu.evictions if one.wanted_by in core.waiting]
    for lease_id, asked in core.turn.taken_back.items():
        holder = core.leases[lease_id]
        if (anew := holder.departure.eviction) is not None:
            anew.acked_at = asked.acked_at
            continue
        holder.departure.revoked_before = True
        assert holder.token is not None, f"{holder.id} was revoked without a token"
        core.push(holder, RevokeWithdrawnPush(holder.id, holder.token))
        why, ms = asked.why, (core.now - asked.asked_at) * 1e3
        core.note(RevokeWithdrawnNote(why.wanted_by, why.cause, len(holder.uses), ms), holder)
        core.record_lease(holder)


# -- the ladder
def push_revoke(core: Core, holder: Lease, *, extra: bool = False) -> None:
    """Push `revoke` now, if the holder is being revoked, and plan the next step.

    `uses` counts what still runs on the lease, also what others marked: at 0 the holder is at its
    safe point. An `extra` push leaves the plan as it is.
    """
    eviction = holder.departure.eviction
    if eviction is None or holder.state is not LeaseState.REVOKING:
        return
    assert holder.token is not None, f"{holder.id} is revoked without a token"
    why, waiter = eviction.why, None
    if eviction.wanted_by is not None and why.order is None:
        waiter = core.waiting.get(eviction.wanted_by)
    core.push(
        holder,
        RevokePush(
            lease_id=holder.id,
            token=holder.token,
            wanted_by=why.wanted_by,
            deadline_in_s=max(0.0, eviction.asked_at + core.settings.revoke_deadline_s - core.now),
            cause=why.cause,
            order=why.order,
            priority=None if waiter is None else waiter.spec.priority,
            uses=len(holder.uses),
            park=holder.id in core.host_ram.booked,
            traceparent=eviction.traceparent or "",
        ),
    )
    if not extra:
        eviction.next_push_at = core.now + core.settings.revoke_resend_s
        core.timers.set_first(("revoke", holder.id), _next_steps(holder, eviction, core.settings))


def _next_steps(holder: Lease, eviction: Eviction, settings: Settings) -> list[float]:
    """Return the instants of the ladder that are still to come."""
    times = [] if eviction.overdue else [eviction.asked_at + settings.revoke_deadline_s]
    if not eviction.reminded:
        times.append(eviction.asked_at + settings.revoke_remind_s)
    if eviction.acked_at is None or not holder.uses:
        times.append(eviction.next_push_at)
    return times


def on_ladder_due(core: Core, lease_id: str) -> None:
    """Take the steps of the ladder that are due.

    A holder that unloads is pushed nothing more, and has a whole deadline for it. A late holder is
    noted, and other victims and other GPUs are looked for; its `revoke` stands.
    """
    holder = core.leases[LeaseId(lease_id)]
    eviction, settings = holder.departure.eviction, core.settings
    late = holder.state is LeaseState.UNLOADING
    revoking = eviction is not None and holder.state is LeaseState.REVOKING
    if late:
        holder.departure.hangs = True
    if eviction is not None and revoking:
        if core.now >= eviction.next_push_at:
            eviction.next_push_at = core.now + settings.revoke_resend_s
            if eviction.acked_at is None or not holder.uses:
                push_revoke(core, holder)
        if not eviction.reminded and core.now >= eviction.asked_at + settings.revoke_remind_s:
            eviction.reminded = True
            core.note(RemindedNote(len(holder.uses), eviction.acked_at is not None), holder)
        late = not eviction.overdue and core.now >= eviction.asked_at + settings.revoke_deadline_s
    if late:
        wanted_by = "" if eviction is None else eviction.why.wanted_by
        core.note(DeadlinePassedNote(len(holder.uses), wanted_by), holder)
        core.gpu_of(holder).wake()
    if late and eviction is not None:
        eviction.overdue = True
        if eviction.wanted_by and (waiter := core.waiting.get(eviction.wanted_by)) is not None:
            core.wake_candidates(waiter)  # another GPU may serve it now
    if eviction is not None and revoking:
        times = _next_steps(holder, eviction, settings)
        core.timers.set_first(("revoke", holder.id), times)
