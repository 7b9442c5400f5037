"""Acquires that are not granted yet: sent, queued, then granted, denied, canceled, or ended here.

`acquire` carries a nonce that makes it repeatable. Its reply is `queued`, with a lease id, or
`loading`: granted. A push `granted` or `denied` ends a queued one. A grant becomes a `LeaseRecord`
in `clients._protocol.leases`; the owner gets `Granted` or `Denied` with the nonce. A canceled
acquire is kept until the arbiter has answered, so that a grant that crosses the cancel is released.
After a reconnect the same acquire is sent again, with the time that is left.

The module must not know what becomes of a lease once it is granted.
"""

from collections.abc import Iterator
from functools import partial

from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S, Connection
from vram_arbiter.clients._protocol.leases import Holdings, waited_in_vain
from vram_arbiter.clients._protocol.records import (
    Denied,
    Granted,
    LeaseRecord,
    Waiter,
)
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import LeaseView


class Waits:
    """`waiters` by their nonces."""

    def __init__(self, connection: Connection, holdings: Holdings) -> None:
        self._connection = connection
        self._holdings = holdings
        self.waiters: dict[str, Waiter] = {}

    # -- requests of the owner ---------------------------------------------------------------------
    def acquire(
        self,
        nonce: str,
        spec: LeaseSpec,
        now: float,
        *,
        wait_timeout_s: float | None = None,
        traceparent: str | None = None,
    ) -> None:
        """Ask for a lease; ends as `Granted` or `Denied` with this nonce."""
        deadline = None if wait_timeout_s is None else now + wait_timeout_s
        waiter = Waiter(nonce, spec, traceparent, now, deadline)
        self.waiters[nonce] = waiter
        self._ask(waiter, now)

    def cancel(self, nonce: str, now: float) -> None:
        """Give up a wait. A grant that is on its way already is released when it comes."""
        waiter = self.waiters.get(nonce)
        if waiter is None:
            return
        waiter.abandoned = True
        if waiter.lease_id is not None:
            self._ask_to_cancel(waiter, now)

    # -- from the arbiter --------------------------------------------------------------------------
    def pushed_grant(self, view: LeaseView, now: float) -> bool:
        """Apply a push. Returns whether it was for one of these."""
        waiter = self._of(view.lease_id)
        if waiter is not None:
            self._granted(waiter, view, now)
        return waiter is not None

    def pushed_denial(self, lease_id: str, error: VramError) -> bool:
        """Apply a push. Returns whether it was for one of these."""
        waiter = self._of(lease_id)
        if waiter is not None:
            self._denied(waiter, error)
        return waiter is not None

    # -- contact and time --------------------------------------------------------------------------
    def say_again(self, now: float) -> None:
        for waiter in self.waiters.values():
            if not self._connection.awaits(waiter.request_id):
                self._ask(waiter, now)

    def deadlines(self) -> Iterator[float]:
        for waiter in self.waiters.values():
            if waiter.deadline is not None:
                yield self._connection.wait_ends_at(waiter.deadline)

    def end_overdue(self, now: float) -> None:
        """End waits that are over while the arbiter cannot be reached."""
        ends_at = self._connection.wait_ends_at
        for waiter in [one for one in self.waiters.values() if now >= ends_at(one.deadline)]:
            if not waiter.abandoned:
                error = waited_in_vain(waiter.spec, "a lease", now - waiter.asked_at)
                self._connection.events.append(Denied(waiter.nonce, error))
            waiter.abandoned, waiter.deadline = True, None
            if waiter.lease_id is not None:
                self._ask_to_cancel(waiter, now)

    # -- steps -------------------------------------------------------------------------------------
    def _of(self, lease_id: str) -> Waiter | None:
        return next((w for w in self.waiters.values() if w.lease_id == lease_id), None)

    def _ask(self, waiter: Waiter, now: float) -> None:
        left_s = None if waiter.deadline is None else max(0.0, waiter.deadline - now)
        waiter.request_id = self._connection.ask(
            w.Acquire(waiter.nonce, waiter.spec, 0.0 if waiter.abandoned else left_s),
            now,
            REQUEST_TIMEOUT_S if left_s is None else max(REQUEST_TIMEOUT_S, left_s),
            on_reply=partial(self._replied, waiter),
            on_error=lambda error, _: self._denied(waiter, error),
            quiet=True,
            traceparent=waiter.traceparent,
        )

    def _replied(self, waiter: Waiter, reply: AcquireReply, now: float) -> None:
        if waiter.nonce not in self.waiters:
            return
        view = reply.lease
        waiter.lease_id = LeaseId(view.lease_id)
        if reply.state == "loading":  # not by its token: one that was away shows its last one
            self._granted(waiter, view, now)
        elif waiter.abandoned:
            self._ask_to_cancel(waiter, now)

    def _granted(self, waiter: Waiter, view: LeaseView, now: float) -> None:
        """Keep a grant. The message may have waited longer than the TTL: it is known only that it
        was sent after the newest request that the arbiter has answered."""
        self.waiters.pop(waiter.nonce, None)
        if view.token is None:
            raise ValueError("a grant without a token")
        heard_at = self._connection.asked_at
        record = LeaseRecord(
            lease_id=LeaseId(view.lease_id),
            token=view.token,
            nonce=waiter.nonce,
            spec=waiter.spec,
            ttl_s=waiter.spec.ttl_s,
            view=view,
            confirmed_at=heard_at,
            renewed_at=heard_at,
        )
        if waiter.abandoned:  # release it at once: nothing was loaded
            self._connection.ask(w.Release(record.lease_id, record.token), now, quiet=True)
            return
        self._holdings.held[record.lease_id] = record
        self._connection.events.append(Granted(waiter.nonce, record))

    def _denied(self, waiter: Waiter, error: VramError) -> None:
        if self.waiters.pop(waiter.nonce, None) is not None and not waiter.abandoned:
            self._connection.events.append(Denied(waiter.nonce, error))

    def _ask_to_cancel(self, waiter: Waiter, now: float) -> None:
        def over(_: object, __: float) -> None:
            self.waiters.pop(waiter.nonce, None)

        assert waiter.lease_id is not None
        request = w.Cancel(waiter.lease_id)
        self._connection.ask(request, now, on_reply=over, on_error=over, quiet=True)
