"""Places that processes and users share, and the notes of refused requests for bytes.

Sessions, connections and rates are limited before a request becomes an event (`rpc`).
"""

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.model.learned import newest
from vram_arbiter.arbiter.core.model.refusals import Limit, LimitReached, Refused, Share
from vram_arbiter.arbiter.core.model.state import Client, Core, Refusals
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.notes import RefusedNote

AT_ONCE = 16
"""Refusals of one process that are noted one by one; after that one a second."""
PROCESSES_REMEMBERED = 1024


def check_waiters(core: Core, client: Client, priority: int) -> None:
    """Refuse one waiter too many of a client, of its user or of all.

    The last places are kept for requests above the default priority, of each user's share too.
    """
    settings, places, taken = core.settings, core.settings.waiters_max, core.waiters_of
    mine, users = taken.get(client.process, 0), taken.get(client.uid, 0)
    kept = 0.0 if priority > defaults.PRIORITY else settings.priority_reserve
    check_shares(
        "waiters_max",
        (Share.PROCESS, mine, places * settings.process_share),
        (Share.USER, users, places * (settings.user_share * (1 - kept))),
        (Share.ALL, len(core.waiting), places * (1 - kept)),
        uid=client.uid,
    )


def check_shares(
    limit: Limit, *shares: tuple[Share, int, float], lease_id: str = "", uid: int | None = None
) -> None:
    """Refuse one place more for the first share that is used up; each has one place at least.

    No process and no user can take so many places that others find none. Sessions, connections and
    rates are limited before a request becomes an event (`rpc`).

    Args:
        shares: Whose share, places taken, places allowed.
    """
    for share, count, most in shares:
        if count >= max(1, int(most)):
            user = uid if share is Share.USER else None
            raise Refused(LimitReached(limit, max(1, int(most)), share, count, lease_id, user))


def note_refused(core: Core, event: ev.AcquireRequested | ev.Reacquired, refusal: Refusal) -> None:
    """Note that a request for bytes was refused at once, by whom it was sent, and why.

    A process that asks and is refused thousands of times a second must not push everything else
    out of the history: beyond a number at once its refusals are counted, and the next note says how
    many were left out.
    """
    process = core.clients[event.client].process
    seen = newest(core.refusals, process, lambda: Refusals(core.now), PROCESSES_REMEMBERED)
    seen.noted = max(0.0, seen.noted - (core.now - seen.at))
    seen.at = core.now
    if seen.noted > AT_ONCE - 1:
        seen.left_out += 1
        return
    seen.noted += 1
    lease = None if isinstance(event, ev.AcquireRequested) else core.leases.get(event.lease)
    consumer = event.spec.consumer if isinstance(event, ev.AcquireRequested) else ""
    core.note(RefusedNote(process.pid, refusal, consumer, seen.left_out), lease)
    seen.left_out = 0
