"""Uses: busy intervals on a lease, marked by any client that knows its exact token (that is how a
runner marks a goal on its policy sidecar's lease). A lease in use is not at its safe point.

Must not know why a holder is revoked (`eviction`).

What others than the holder mark outlives the daemon: the journal names one use of each such
process, which is enough to know the processes to wait for. It is written when a process begins to
use a lease and when that use ends, not for what it does there at the same time.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import eviction
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState, Use
from vram_arbiter.arbiter.core.model.records import UserRecord
from vram_arbiter.arbiter.core.model.refusals import Misfit, Refused, Share
from vram_arbiter.arbiter.core.model.state import Client, Core
from vram_arbiter.arbiter.core.requests.requests import bad_state, lease_for, note_ended
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import ClientId, LeaseId, ProcessKey, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.notes import UseBeganNote
from vram_arbiter.schemas.wire.replies import UsesReply

FROM_JOURNAL: Final = ClientId("")
"""The client of a use that was marked before a restart, until its process says it again."""


def begin(core: Core, asked: ev.Asked, request: w.UseBegin) -> None:
    """Mark a use. Refused once the holder is revoked, unless it had begun the use before it heard.

    A repeat, perhaps on a new connection, is answered again: the use ends with that connection.
    """
    client = core.clients[asked.client]
    lease = lease_for(core, request)
    key = (client.process, request.use_id)
    known = lease.uses.get(key)
    if known is not None:
        use = lease.uses[key] = replace(known, client=client.id)
    else:
        if lease.state in LEAVING and not _was_begun(lease, client, request):
            revoked = None if lease.departure.eviction is None else lease.departure.eviction.why
            raise Refused(no.Revoked(lease.spec.consumer, lease.state, revoked))
        if lease.state not in (LeaseState.HELD, LeaseState.REVOKING):
            raise bad_state(lease, Misfit.NOT_HELD)
        _check_places(core, lease, client)
        use = Use(request.use_id, client.id, client.process, request.label, core.now)
        core.mark(lease, use)
        lease.uses.last_at = core.now
        if client.process == lease.process:
            lease.departure.revoked_before = False  # its holder knows that it may stay
        if _is_kept(lease, use):
            core.record_lease(lease)  # before the reply: from then on its user counts on it
    core.reply(asked.client, asked.id, UsesReply(len(lease.uses)))
    if known is None or known.client == FROM_JOURNAL:
        core.note(UseBeganNote(use.id, use.label, len(lease.uses), known is not None), lease)


def _was_begun(lease: Lease, client: Client, request: w.UseBegin) -> bool:
    """Return whether the holder was in this use before it heard of the revoke."""
    is_own = client.process == lease.process
    return request.begun and is_own and lease.state is LeaseState.REVOKING


def _check_places(core: Core, lease: Lease, client: Client) -> None:
    """Refuse one use too many. The holder's own uses are counted apart: others cannot take its
    places."""
    settings, places = core.settings, core.settings.uses_per_lease_max
    uses = list(lease.uses.values())
    others = [use for use in uses if use.process != lease.process]
    if client.process == lease.process:
        own = (Share.HOLDER, len(uses) - len(others), places)
        admission.check_shares("uses_per_lease_max", own, lease_id=lease.id)
        return
    mine = sum(use.process == client.process for use in others)
    owners = [core.clients.get(use.client) for use in others]
    users = sum(owner is not None and owner.uid == client.uid for owner in owners)
    admission.check_shares(
        "uses_per_lease_max",
        (Share.PROCESS, mine, places * settings.process_share),
        (Share.USER, users, places * settings.user_share),
        (Share.OTHERS, len(others), places),
        lease_id=lease.id,
        uid=client.uid,
    )


def _is_kept(lease: Lease, use: Use) -> bool:
    """Return whether the journal has this use for its process. The holder's own cost no write."""
    return use.process != lease.process and use in lease.users()


def end(core: Core, asked: ev.Asked, request: w.UseEnd) -> None:
    """End a use; one that is not there (any more) is fine."""
    lease = lease_for(core, request)
    use = lease.uses.get((core.clients[asked.client].process, request.use_id))
    if use is not None:
        end_use(core, lease, use, Why.ENDED)
    core.reply(asked.client, asked.id, UsesReply(len(lease.uses)))


def end_use(core: Core, lease: Lease, use: Use, why: Why, by: str = "") -> None:
    """End a use, in the journal too. After the last one its holder is at its safe point."""
    kept = _is_kept(lease, use)
    core.unmark(lease, use)
    lease.uses.last_at = core.now
    if kept:
        core.record_lease(lease)
    note_ended(core, lease, use, why, by)
    if not lease.uses:
        eviction.push_revoke(core, lease)
        core.gpu_of(lease).wake()


# -- after a restart
def restore(core: Core, lease: Lease, users: Sequence[UserRecord]) -> None:
    """Mark the uses of others on a recovered lease.

    It stays in use until they say so again (`begin`), end it or die; a process that is silent for
    as long as a holder may be is not waited for any longer.
    """
    for pid, start_ticks, use_id, label in users:
        process = ProcessKey(pid, start_ticks)
        core.mark(lease, Use(UseId(use_id), FROM_JOURNAL, process, label, core.now))
    if users:
        await_users(core, lease)


def await_users(core: Core, lease: Lease) -> None:
    """Give users from now on as long as a client without an arbiter keeps what it has."""
    patience_s = max(lease.spec.ttl_s, defaults.LEASE_TTL_S) + core.settings.fence_grace_s
    core.timers.set(("users", lease.id), core.now + patience_s)


def on_users_due(core: Core, lease_id: str) -> None:
    """Forget uses of processes that have not come back by now."""
    lease = core.leases[LeaseId(lease_id)]
    for use in [use for use in lease.uses.values() if use.client == FROM_JOURNAL]:
        end_use(core, lease, use, Why.USER_NOT_BACK)
