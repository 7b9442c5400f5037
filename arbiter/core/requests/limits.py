"""Shares of limited places: no process and no user can take so many that others find none.

Checks only; raises Refused with the limit's name, its value and what to do. Sessions, connections and rates are limited before a request
becomes an event (`rpc`).
"""

from collections.abc import Iterable

from vram_arbiter.arbiter.core.model.lease import Lease, Use
from vram_arbiter.arbiter.core.model.state import Client, Core, Refused
from vram_arbiter.schemas import defaults


def check_waiters(core: Core, client: Client, priority: int) -> None:
    """May this client add a waiter? The last places are kept for requests above the default priority, of each user's share too."""
    settings = core.settings
    places = settings.waiters_max
    kept = 0.0 if priority > defaults.PRIORITY else settings.priority_reserve
    mine, users = core.waiting_by(client.process, client.uid)
    _check(
        "waiters_max",
        "requests wait",
        "let some of them be answered first, or raise limits.waiters_max",
        ("of this process", mine, _share(places, settings.process_share)),
        (f"of uid {client.uid}", users, _share(places, settings.user_share * (1 - kept))),
        ("of all users", len(core.waiting), _share(places, 1 - kept)),
    )


def check_leases(core: Core, client: Client) -> None:
    """May this connection have one lease more?"""
    owned = core.count_of_client(client.id)
    _check(
        "leases_per_client_max",
        "leases are held or asked for",
        "release some, or raise limits.leases_per_client_max",
        ("by this connection", owned, core.settings.leases_per_client_max),
    )


def check_uses(core: Core, lease: Lease, client: Client) -> None:
    """May this client mark a use of the lease? The holder's own uses are counted apart: others cannot take its places."""
    places = core.settings.uses_per_lease_max
    what, todo = f"uses of {lease.id} run or pause", "end some, or raise limits.uses_per_lease_max"
    uses = lease.all_uses()
    own = sum(use.process == lease.process for use in uses)
    if client.process == lease.process:
        _check("uses_per_lease_max", what, todo, ("of its holder", own, places))
        return
    settings = core.settings
    mine = sum(use.process == client.process for use in uses)
    others = (use for use in uses if use.process != lease.process)
    _check(
        "uses_per_lease_max",
        what,
        todo,
        ("of this process", mine, _share(places, settings.process_share)),
        (
            f"of uid {client.uid}",
            _of_user(core, others, client.uid),
            _share(places, settings.user_share),
        ),
        ("of others than its holder", len(uses) - own, places),
    )


def _of_user(core: Core, uses: Iterable[Use], uid: int) -> int:
    found = (core.clients.get(use.client) for use in uses)
    return sum(client is not None and client.uid == uid for client in found)


def _share(places: int, fraction: float) -> int:
    return max(1, int(places * fraction))


def _check(limit: str, what: str, todo: str, *shares: tuple[str, int, int]) -> None:
    for whose, count, value in shares:
        if count >= value:
            raise Refused(
                "limit_exceeded",
                f"{count} {what} {whose}, the limit is {value}",
                todo,
                limit=limit,
                value=value,
                share=whose,
            )
