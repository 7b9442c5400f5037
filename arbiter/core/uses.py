"""Uses: busy intervals on a lease, marked by anyone who knows its exact token (that is how a runner marks a goal on its policy
sidecar's lease). A lease in use is not at its safe point.

A use that yields pauses: it stays known, but nobody waits for its end. Beginning it again resumes it, unless its holder was
asked to leave meanwhile. Must not know why anybody is asked to leave (`eviction`).
"""

from dataclasses import replace

from arbiter.core import eviction
from arbiter.core.events import UseBegan, UseEnded, UseYielded
from arbiter.core.lease import LEAVING, Lease, LeaseState, Use
from arbiter.core.requests import bad_state, client_of, lease_for, note_ended
from arbiter.core.state import Core, Refused


def begin(core: Core, event: UseBegan) -> None:
    """Mark a use, or resume one that pauses. Nobody may once the holder was asked to leave."""
    client = client_of(core, event.client)
    lease = lease_for(core, event.lease, event.token)
    key = (client.process, event.use)
    if key in lease.uses:  # a repeat, perhaps on a new connection: it ends with that one
        lease.uses[key] = replace(lease.uses[key], client=client.id)
        core.reply(event.client, event.request, {"uses": len(lease.uses)})
        return
    if lease.state in LEAVING:
        raise Refused(
            "lease_revoking",
            f"{lease.spec.consumer} was asked to leave",
            "wait until it is granted again",
            state=str(lease.state),
        )
    if lease.state is not LeaseState.HELD:
        raise bad_state(lease, "only a held lease can be used")
    paused = lease.yielded.get(key)
    if paused is None and len(lease.uses) + len(lease.yielded) >= core.settings.uses_per_lease_max:
        raise Refused(
            "limit_exceeded", f"{lease.id} has too many uses", "end some", limit="uses_per_lease_max"
        )
    core.mark(lease, paused or Use(event.use, client.id, client.process, event.label, core.now))
    lease.uses[key] = replace(lease.uses[key], client=client.id)
    lease.last_used_at = core.now
    core.reply(event.client, event.request, {"uses": len(lease.uses)})
    core.note(
        "use_began",
        lease,
        use_id=event.use,
        label=lease.uses[key].label,
        uses=len(lease.uses),
        resumed=paused is not None,
    )


def yield_(core: Core, event: UseYielded) -> None:
    """Pause a use of one's own; said again it is fine. A lease without busy uses is at its safe point."""
    client = client_of(core, event.client)
    lease = lease_for(core, event.lease, event.token)
    key = (client.process, event.use)
    use = lease.uses.get(key)
    if use is not None:
        core.unmark(lease, use)
        lease.yielded[key] = use
        lease.last_used_at = core.now
        core.note("use_yielded", lease, use_id=use.id, label=use.label, uses=len(lease.uses))
        _safe_point(core, lease)
    elif key not in lease.yielded:
        raise bad_state(lease, f"it has no use {event.use} of yours to yield")
    core.reply(event.client, event.request, {"uses": len(lease.uses)})


def end(core: Core, event: UseEnded) -> None:
    """End a use; one that is not there (any more) is fine."""
    client = client_of(core, event.client)
    lease = lease_for(core, event.lease, event.token)
    key = (client.process, event.use)
    use = lease.uses.get(key) or lease.yielded.get(key)
    if use is not None:
        end_use(core, lease, use, "ended")
    core.reply(event.client, event.request, {"uses": len(lease.uses)})


def end_use(core: Core, lease: Lease, use: Use, why: str) -> None:
    """A use is over, whether it was busy or paused."""
    key = (use.process, use.id)
    busy = key in lease.uses
    if busy:
        core.unmark(lease, use)
        lease.last_used_at = core.now
    else:
        del lease.yielded[key]
    note_ended(core, lease, use, why)
    if busy:
        _safe_point(core, lease)


def _safe_point(core: Core, lease: Lease) -> None:
    if not lease.uses:
        eviction.reached_safe_point(core, lease)
        core.wake(core.gpu_of(lease))
