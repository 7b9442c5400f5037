"""What an operator may do by hand: evict, pin and unpin, drain and resume, end a stuck holder, give
up the lease of a dead one, change constants.

Nothing here weakens the rules for holders: an evicted holder is *asked* and finishes what it does,
and a lease that others use is never given up. Every action is a note with the operator and the
reason; a pin and a drain are journaled, so they outlive the daemon. The role was checked where the
request came in.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, Literal

from vram_arbiter.arbiter.core import eviction, standby
from vram_arbiter.arbiter.core.effects import Signal
from vram_arbiter.arbiter.core.events import DRAIN_KEY, Asked, SettingsChanged
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import AWAY, EXPIRING, LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.records import DrainRecord
from vram_arbiter.arbiter.core.model.refusals import Impractical, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.requests.requests import over
from vram_arbiter.arbiter.core.requests.sessions import expire
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.notes import OperatorNote, SignalledNote
from vram_arbiter.schemas.wire.replies import DrainReply, OperatorReply

SILENT_SHARE = 2 / 3
"""A holder that has not been heard of for this share of its ttl has missed a renewal, and may be
declared dead."""


def order_lease(core: Core, asked: Asked, request: w.ByHandOn) -> None:
    """Do what an operator orders for a lease, note it and answer. Raises Refused, and then nothing
    has changed."""
    lease = find(core, request.target)
    TO_LEASE[type(request)](core, lease, Order(asked.operator, request.reason))
    view = status.view(core, lease) if lease.id in core.leases else None
    core.reply(asked.client, asked.id, OperatorReply(lease.state, view))


def order_all(core: Core, asked: Asked, request: w.Drain | w.Resume) -> None:
    """Do what an operator orders for all GPUs, note it and answer."""
    TO_ALL[type(request)](core, Order(asked.operator, request.reason))
    core.reply(asked.client, asked.id, DrainReply("" if core.drain is None else str(core.drain)))


def on_settings(core: Core, event: SettingsChanged) -> None:
    """Replace constants. What is under way keeps the timers that are set."""
    core.settings = replace(core.settings, **event.changed)  # type: ignore[arg-type]


def find(core: Core, target: str) -> Lease:
    """Return a live lease by its id, or by its consumer's name if that has exactly one. Raises
    Refused."""
    lease = core.leases.get(LeaseId(target))
    if lease is not None:
        return lease
    named = [lease for lease in core.leases.values() if lease.spec.consumer == target]
    resident = [lease for lease in named if lease.state is not LeaseState.QUEUED] or named
    if len(resident) == 1:
        return resident[0]
    if resident:
        raise Refused(no.Ambiguous(target, tuple(lease.id for lease in resident)))
    if target in core.ended:
        raise Refused(no.TargetOver.of(over(core.ended, LeaseId(target)).refusal))
    raise Refused(no.NoTarget(target))


def evict(core: Core, lease: Lease, order: Order) -> None:
    """Ask a holder to leave, as the engine would for a waiter. In use, it finishes first. Asking
    twice is fine.

    What an operator evicts does not come back by itself: a lease on standby ends with it, a parked
    one waits for its holder.
    """
    if lease.state in AWAY:
        core.note(OperatorNote("evict", order.by, order.reason), lease)
        _dismiss(core, lease, order)
        return
    if lease.state in LEAVING:
        _dismiss(core, lease, order)
        # A holder may let a waiter wait that it would not keep an operator waiting for.
        eviction.push_revoke(core, lease, extra=True)
        core.note(OperatorNote("evict", order.by, order.reason, repeated=True), lease)
        return
    if lease.state is not LeaseState.HELD:
        raise _impractical(lease, Impractical.NOT_RESIDENT)
    if lease.pinned is not None:
        raise _impractical(lease, Impractical.PINNED_BY_OPERATOR)
    if not lease.evictable:
        raise _impractical(lease, Impractical.PINNED_BY_HOLDER)
    eviction.ask(core, core.gpu_of(lease), lease, None, order=order)
    _dismiss(core, lease, order)
    core.note(OperatorNote("evict", order.by, order.reason, uses=len(lease.uses)), lease)


def _dismiss(core: Core, lease: Lease, order: Order) -> None:
    asked = lease.departure.eviction
    if asked is not None:
        asked.why = replace(asked.why, cause="operator", order=order)
    standby.dismiss(core, lease, order)


def kill(core: Core, lease: Lease, order: Order) -> None:
    """End the process of a stuck holder: SIGTERM, and SIGKILL when it is asked for again.

    Its lease is lost with it, and its bytes are measured gone as ever. Refused while another
    process uses one of its leases, or it uses one of another process: a robot may be moving.
    """
    if lease.state not in EXPIRING:
        raise _impractical(lease, Impractical.NOT_HELD)
    process = lease.process
    uses = [use for one in core.leases_of(process) for use in one.uses.values()]
    used = core.users.get(process, {}).values()
    if any(use.process != process for use in uses) or any(one.process != process for one in used):
        raise _impractical(lease, Impractical.OTHERS_USE)
    signal: Literal["term", "kill"] = "kill" if process in core.terminated else "term"
    core.terminated.add(process)
    core.turn.effects.append(Signal(process, signal))
    core.note(SignalledNote(signal, process.pid, order.by, order.reason), lease)


def pin(core: Core, lease: Lease, order: Order) -> None:
    """Protect a lease from eviction until it is unpinned. A waiter may be pinned too: the pin holds
    from its grant on."""
    if lease.state in LEAVING:
        raise _impractical(lease, Impractical.LEAVING)
    _set_pin(core, lease, order)
    core.note(OperatorNote("pin", order.by, order.reason), lease)


def unpin(core: Core, lease: Lease, order: Order) -> None:
    """Undo an operator's pin. What the holder itself asked for stands."""
    if lease.pinned is None:
        raise _impractical(lease, Impractical.NOT_PINNED)
    _set_pin(core, lease, None)
    core.note(OperatorNote("unpin", order.by, order.reason), lease)


def _set_pin(core: Core, lease: Lease, pinned: Order | None) -> None:
    lease.pinned = pinned
    if lease.gpu is not None:
        core.gpu_of(lease).wake()
    if lease.gpu is not None or lease.state in AWAY:
        core.record_lease(lease)


def release_dead(core: Core, lease: Lease, order: Order) -> None:
    """Give up a lease whose holder is not heard of, before its time to live is over. Its bytes are
    measured gone as ever."""
    if lease.state not in EXPIRING:
        raise _impractical(lease, Impractical.NOT_HELD)
    if lease.uses:
        raise _impractical(lease, Impractical.IN_USE)
    silent_s = max(0.0, core.now - (lease.expires_at - lease.spec.ttl_s))
    if lease.attached and silent_s < lease.spec.ttl_s * SILENT_SHARE:
        raise _impractical(lease, Impractical.HOLDER_LIVES, silent_s)
    note = OperatorNote("release_dead", order.by, order.reason, silent_s=silent_s)
    core.note(note, lease)
    expire(core, lease.id, order)


def drain(core: Core, order: Order) -> None:
    """Grant nothing more; what is held is kept, waiters wait. A second drain replaces the
    reason."""
    core.drain = order
    core.journal(DRAIN_KEY, DrainRecord(order.by, order.reason))
    core.wake_all()
    core.note(OperatorNote("drain", order.by, order.reason))


def resume(core: Core, order: Order) -> None:
    """Grant again. Fine where nothing was drained."""
    if core.drain is not None:
        core.drain = None
        core.forget(DRAIN_KEY)
        core.wake_all()
    core.note(OperatorNote("resume", order.by, order.reason))


def _impractical(lease: Lease, problem: Impractical, silent_s: float | None = None) -> Refused:
    evictable = lease.spec.evictable if problem is Impractical.NOT_PINNED else lease.evictable
    return Refused(no.BadTargetState(lease.id, lease.state, problem, evictable, silent_s))


TO_LEASE: Final[Mapping[type, Callable[[Core, Lease, Order], None]]] = {
    w.Evict: evict,
    w.Kill: kill,
    w.Pin: pin,
    w.Unpin: unpin,
    w.ReleaseDead: release_dead,
}
TO_ALL: Final[Mapping[type, Callable[[Core, Order], None]]] = {w.Drain: drain, w.Resume: resume}
