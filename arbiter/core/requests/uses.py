"""Uses: busy intervals on a lease, marked by any client that knows its exact token (that is how a
runner marks a goal on its policy sidecar's lease). A lease in use is not at its safe point.

A use that yields pauses: it stays known, but no departure waits for its end. Beginning it again
resumes it, unless its holder was asked to leave meanwhile. Must not know why a holder is asked to
leave (`eviction`).

What others than the holder mark outlives the daemon: the journal names one use of each such
process, which is enough to know the processes to wait for. It is written when a process begins to
use a lease and when that use ends, not for what it does there at the same time.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from vram_arbiter.arbiter.core.events import UseBegan, UseEnded, UseYielded
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState, Use
from vram_arbiter.arbiter.core.model.refusals import Misfit, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.requests.limits import check_uses
from vram_arbiter.arbiter.core.requests.requests import bad_state, client_of, lease_for, note_ended
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import ClientId, LeaseId, ProcessKey, UseId
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.replies import UsesReply

FROM_JOURNAL: Final = ClientId("")
"""The client of a use that was marked before a restart, until its process says it again."""


def begin(core: Core, event: UseBegan) -> None:
    """Mark a use, or resume one that pauses. Refused once the holder was asked to leave."""
    client = client_of(core, event.client)
    lease = lease_for(core, event.lease, event.token)
    key = (client.process, event.use)
    if key in lease.uses:  # a repeat, perhaps on a new connection: it ends with that one
        known = lease.uses[key]
        lease.uses[key] = replace(known, client=client.id)
        core.reply(event.client, event.request, UsesReply(len(lease.uses)))
        if known.client == FROM_JOURNAL:
            _note_begun(core, lease, known, resumed=True)
        return
    if lease.state in LEAVING:
        revoked = None if lease.departure.eviction is None else lease.departure.eviction.why
        raise Refused(no.Revoked(lease.spec.consumer, lease.state, "use", revoked))
    if lease.state is not LeaseState.HELD:
        raise bad_state(lease, Misfit.NOT_HELD)
    paused = lease.uses.paused.get(key)
    if paused is None:
        check_uses(core, lease, client)
    core.mark(lease, paused or Use(event.use, client.id, client.process, event.label, core.now))
    use = lease.uses[key] = replace(lease.uses[key], client=client.id)
    lease.uses.last_at = core.now
    if _is_kept(lease, use):
        core.record_lease(lease)  # before the reply: from then on its user counts on it
    core.reply(event.client, event.request, UsesReply(len(lease.uses)))
    _note_begun(core, lease, use, resumed=paused is not None)


def _note_begun(core: Core, lease: Lease, use: Use, *, resumed: bool) -> None:
    core.note(
        "use_began", lease, use_id=use.id, label=use.label, uses=len(lease.uses), resumed=resumed
    )


def _is_kept(lease: Lease, use: Use) -> bool:
    """Is it the one of its process that the journal has of this lease? Never one of the holder's
    own: those cost no write."""
    return use.process != lease.process and use in lease.users()


def yield_(core: Core, event: UseYielded) -> None:
    """Pause a use of one's own; said again it is fine. A lease without busy uses is at its safe
    point."""
    client = client_of(core, event.client)
    lease = lease_for(core, event.lease, event.token)
    key = (client.process, event.use)
    use = lease.uses.get(key)
    if use is not None:
        _unmark(core, lease, use)
        lease.uses.paused[key] = replace(use, client=client.id)
        lease.uses.last_at = core.now
        core.note("use_yielded", lease, use_id=use.id, label=use.label, uses=len(lease.uses))
        _safe_point(core, lease)
    elif key not in lease.uses.paused:
        raise bad_state(lease, Misfit.NO_SUCH_USE, event.use)
    core.reply(event.client, event.request, UsesReply(len(lease.uses)))


def end(core: Core, event: UseEnded) -> None:
    """End a use; one that is not there (any more) is fine."""
    client = client_of(core, event.client)
    lease = lease_for(core, event.lease, event.token)
    key = (client.process, event.use)
    use = lease.uses.get(key) or lease.uses.paused.get(key)
    if use is not None:
        end_use(core, lease, use, Why.ENDED)
    core.reply(event.client, event.request, UsesReply(len(lease.uses)))


def end_use(core: Core, lease: Lease, use: Use, why: Why, by: str = "") -> None:
    """A use is over, whether it was busy or paused."""
    key = (use.process, use.id)
    busy = key in lease.uses
    if busy:
        _unmark(core, lease, use)
        lease.uses.last_at = core.now
    else:
        del lease.uses.paused[key]
    note_ended(core, lease, use, why, by)
    if busy:
        _safe_point(core, lease)


def _unmark(core: Core, lease: Lease, use: Use) -> None:
    """Not busy any more, in the journal neither."""
    kept = _is_kept(lease, use)
    core.unmark(lease, use)
    if kept:
        core.record_lease(lease)


def _safe_point(core: Core, lease: Lease) -> None:
    if not lease.uses:
        eviction.reached_safe_point(core, lease)
        core.wake(core.gpu_of(lease))


# -- after a restart
def restore(core: Core, lease: Lease, users: Sequence[Sequence[Any]]) -> None:
    """Others used a recovered lease. It stays in use until they say so again (`begin`), end it or
    die; a process that is silent for as long as a holder may be is not waited for any longer."""
    for pid, start_ticks, use_id, label in users:
        process = ProcessKey(int(pid), int(start_ticks))
        core.mark(lease, Use(UseId(str(use_id)), FROM_JOURNAL, process, str(label), core.now))
    if users:
        await_users(core, lease)


def await_users(core: Core, lease: Lease) -> None:
    """They have from now on as long as a client without an arbiter keeps what it has."""
    patience_s = max(lease.spec.ttl_s, defaults.LEASE_TTL_S) + core.settings.fence_grace_s
    core.timers.set(("users", lease.id), core.now + patience_s)


def on_users_due(core: Core, lease_id: str) -> None:
    """Forget uses of processes that have not come back by now."""
    lease = core.leases[LeaseId(lease_id)]
    for use in [use for use in lease.uses.values() if use.client == FROM_JOURNAL]:
        end_use(core, lease, use, Why.USER_NOT_BACK)
