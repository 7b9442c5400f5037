"""The client's side of the arbiter's wire, sans-IO: its parts, and the order in which they are
served.

- `connection` (`clients._protocol.connection`): hello, requests and replies, silence, reconnects.
- `waits` (`clients._protocol.waits`): acquires that are not granted yet.
- `holdings` (`clients._protocol.leases`): leases from their grant to their end, asleep or not.
- `foreign_uses` (`clients._protocol.foreign_uses`): uses on leases of other processes.

It knows no sockets, no event loop and no clock.
"""

from itertools import chain

from vram_arbiter.clients._protocol.connection import Connection
from vram_arbiter.clients._protocol.foreign_uses import ForeignUses
from vram_arbiter.clients._protocol.leases import Holdings
from vram_arbiter.clients._protocol.records import HistoryEvent, PrepareAsked, error_of
from vram_arbiter.clients._protocol.waits import Waits
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.pushes import (
    AnyPush,
    DeniedPush,
    EventPush,
    GrantedPush,
    LostPush,
    PreparePush,
    RevokePush,
    RevokeWithdrawnPush,
)
from vram_arbiter.schemas.wire.replies import DoneReply, ReattachReply


class ClientProtocol:
    """One client. After each call on it or its parts, take `connection.outgoing` and `events`, and
    wake up at `next_deadline`."""

    def __init__(self, *, name: str, instance: str, role: w.Role = "client") -> None:
        self.connection = Connection(self, name=name, instance=instance, role=role)
        self.holdings = Holdings(self.connection)
        self.waits = Waits(self.connection, self.holdings)
        self.foreign_uses = ForeignUses(self.connection)
        self._subscribed = False
        self._demand: w.Demand | None = None

    def demand(self, told: w.Demand, now: float) -> int:
        """Tell it now, and after reconnects."""
        self._demand = told
        return self.connection.ask(told, now)

    def subscribe(self, now: float) -> int:
        """History events from now on, also after reconnects."""

        def subscribed(_: DoneReply, __: float) -> None:
            self._subscribed = True

        return self.connection.ask(w.Subscribe(), now, on_reply=subscribed)

    # -- time --------------------------------------------------------------------------------------
    def next_deadline(self) -> float | None:
        """Return when `tick` is due at the latest."""
        ends = chain(
            self.connection.deadlines(self._counts_on_contact()),
            self.waits.deadlines(),
            self.holdings.deadlines(),
        )
        return min(ends, default=None)

    def tick(self, now: float) -> None:
        """1. Fence leases. 2. End requests and waits past their deadline. 3. Declare silence. 4.
        Renew, ping."""
        self.holdings.fence(now)  # 1
        self.connection.end_requests(now)  # 2
        self.waits.end_overdue(now)
        self.holdings.end_overdue(now)
        if self.connection.stays_up(now):  # 3
            self.holdings.renew(now)  # 4
            self.connection.ping_if_silent(now, self._counts_on_contact())

    def _counts_on_contact(self) -> bool:
        """Return whether a grant may come, or a use ends where the arbiter hears nothing."""
        return bool(self.waits.waiters or self.holdings.asleep or self.foreign_uses)

    # -- for the connection (`clients._protocol.connection.Above`) ---------------------------------
    def reattachments(self) -> tuple[w.ReattachLease, ...]:
        return self.holdings.reattachments()

    def reattached(self, reply: ReattachReply) -> None:
        self.holdings.reattached(reply)

    def say_again(self, now: float) -> None:
        if self._subscribed:
            self.connection.ask(w.Subscribe(), now, quiet=True)
        if self._demand is not None:
            self.connection.ask(self._demand, now, quiet=True)
        self.waits.say_again(now)
        self.holdings.say_again(now)
        self.foreign_uses.say_again(now)

    def pushed(self, push: AnyPush, now: float) -> None:
        match push:
            case GrantedPush():
                if not self.waits.pushed_grant(push.lease, now):
                    self.holdings.returned(push.lease)
            case DeniedPush():
                error = error_of(push.error)
                if not self.waits.pushed_denial(push.lease_id, error):
                    self.holdings.denied(push.lease_id, error)
            case RevokePush():
                self.holdings.revoked(push)
            case RevokeWithdrawnPush():
                self.holdings.revoke_withdrawn(push.lease_id, push.token)
            case LostPush():
                self.holdings.lost(push)
            case EventPush():
                self.connection.events.append(HistoryEvent(push.event))
            case PreparePush():
                self.connection.events.append(PrepareAsked(push.by))
