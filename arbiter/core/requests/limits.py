"""Shares of limited places: no process and no user can take so many that others find none.

Checks only; raises Refused with the limit's name, its value and what to do. Sessions, connections
and rates are limited before a request becomes an event (`rpc`).
"""

from collections.abc import Iterable

from vram_arbiter.arbiter.core.model.lease import Lease, Use
from vram_arbiter.arbiter.core.model.refusals import Limit, LimitReached, Refused, Share
from vram_arbiter.arbiter.core.model.state import Client, Core
from vram_arbiter.schemas import defaults


def check_waiters(core: Core, client: Client, priority: int) -> None:
    """May this client add a waiter? The last places are kept for requests above the default
    priority, of each user's share too."""
    settings = core.settings
    places = settings.waiters_max
    kept = 0.0 if priority > defaults.PRIORITY else settings.priority_reserve
    mine, users = core.waiting_by(client.process, client.uid)
    _check(
        "waiters_max",
        (Share.PROCESS, mine, _share(places, settings.process_share)),
        (Share.USER, users, _share(places, settings.user_share * (1 - kept))),
        (Share.ALL, len(core.waiting), _share(places, 1 - kept)),
        uid=client.uid,
    )


def check_leases(core: Core, client: Client) -> None:
    """May this connection have one lease more?"""
    owned = core.count_of_client(client.id)
    most = core.settings.leases_per_client_max
    _check("leases_per_client_max", (Share.CONNECTION, owned, most))


def check_uses(core: Core, lease: Lease, client: Client) -> None:
    """May this client mark a use of the lease? The holder's own uses are counted apart: others
    cannot take its places."""
    places = core.settings.uses_per_lease_max
    uses = lease.all_uses()
    own = sum(use.process == lease.process for use in uses)
    if client.process == lease.process:
        _check("uses_per_lease_max", (Share.HOLDER, own, places), lease_id=lease.id)
        return
    settings = core.settings
    mine = sum(use.process == client.process for use in uses)
    others = (use for use in uses if use.process != lease.process)
    _check(
        "uses_per_lease_max",
        (Share.PROCESS, mine, _share(places, settings.process_share)),
        (
            Share.USER,
            _of_user(core, others, client.uid),
            _share(places, settings.user_share),
        ),
        (Share.OTHERS, len(uses) - own, places),
        lease_id=lease.id,
        uid=client.uid,
    )


def _of_user(core: Core, uses: Iterable[Use], uid: int) -> int:
    found = (core.clients.get(use.client) for use in uses)
    return sum(client is not None and client.uid == uid for client in found)


def _share(places: int, fraction: float) -> int:
    return max(1, int(places * fraction))


def _check(
    limit: Limit, *shares: tuple[Share, int, int], lease_id: str = "", uid: int | None = None
) -> None:
    for share, count, most in shares:
        if count >= most:
            user = uid if share is Share.USER else None
            raise Refused(LimitReached(limit, most, share, count, lease_id, user))
