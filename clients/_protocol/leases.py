"""Leases that were granted to this client: held, or evicted and asleep until they return.

A held lease is renewed every ttl/3. Without the arbiter's word for ttl + grace it is *fenced*: the
client ends it, because the arbiter may have granted its bytes to another. A lease on standby, or
parked, is `asleep`: it is neither renewed nor fenced. A push, or the reply to `reacquire`, grants
it again, and the same record goes on under a new token. Where a lease ends without the holder's
doing, the owner gets `Gone`.

The module must not know how the first grant came about (`clients._protocol.waits`), handlers
(`clients.lease`) and safe points (`clients.eviction`).
"""

from collections.abc import Callable, Iterable, Iterator

from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S, Connection
from vram_arbiter.clients._protocol.records import (
    Gone,
    LeaseRecord,
    OnError,
    Returned,
    RevokeAsked,
    RevokeWithdrawn,
    error_of,
)
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    LeaseLost,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.ids import Token, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.pushes import LostPush, RevokePush
from vram_arbiter.schemas.wire.replies import (
    AcquireReply,
    ReadyReply,
    ReattachReply,
    ReleaseReply,
    RenewReply,
)
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import LeaseView

GONE_CODES = frozenset({"lease_lost", "lease_expired", "unknown_lease", "stale_token"})
"""Codes of replies to a request on a lease that this client no longer holds."""
AWAY = ("standby", "parked")
_MEANINGLESS = (w.RevokeAck, w.UseEnd)
"""Requests that are dropped with their lease."""
_LEAVING = (w.Unloading, w.Release, w.Reacquire)
"""Requests whose caller waits for the arbiter after the lease is over; of any other only while it
holds the lease."""


class Holdings:
    """`held` and `asleep`, by lease id; a record is in one of them or it is over."""

    def __init__(self, connection: Connection) -> None:
        self.held: dict[str, LeaseRecord] = {}
        self.asleep: dict[str, LeaseRecord] = {}
        self._connection = connection

    # -- requests of the holder --------------------------------------------------------------------
    def ask[R](
        self,
        record: LeaseRecord,
        request: w.OnLease[R],
        now: float,
        timeout_s: float = REQUEST_TIMEOUT_S,
        *,
        on_reply: Callable[[R, float], None] | None = None,
        on_error: OnError | None = None,
        quiet: bool = False,
    ) -> int:
        """Queue a request on a lease; an answer that this client no longer holds it ends it."""
        token = record.token

        def refused(error: VramError, at: float) -> None:
            if on_error is not None:
                on_error(error, at)
            if record.token == token and error.code in GONE_CODES:
                self._gone(record, error)

        return self._connection.ask(
            request, now, timeout_s, on_reply=on_reply, on_error=refused, quiet=quiet
        )

    def ready(self, record: LeaseRecord, measured_bytes: int | None, now: float) -> int:
        def held(_: ReadyReply, __: float) -> None:
            record.held, record.measured_bytes = True, measured_bytes

        request = w.Ready(record.lease_id, record.token, measured_bytes)
        return self.ask(record, request, now, on_reply=held)

    def use_begin(
        self, record: LeaseRecord, use_id: UseId, label: str, now: float, *, begun: bool = False
    ) -> int:
        """The use counts from now on, so that a reattachment on the way names it. `begun`: without
        waiting for the answer."""
        record.uses.add(use_id)

        def refused(error: VramError, _: float) -> None:
            if not isinstance(error, ArbiterUnreachable):  # it may go on until the lease is fenced
                record.uses.discard(use_id)

        request = w.UseBegin(record.lease_id, record.token, use_id, label, begun)
        return self.ask(record, request, now, on_error=refused)

    def use_end(self, record: LeaseRecord, use_id: UseId, now: float) -> int:
        record.uses.discard(use_id)
        request = w.UseEnd(record.lease_id, record.token, use_id)
        return self._connection.ask(request, now, quiet=True)

    def release(
        self,
        record: LeaseRecord,
        exiting: bool,
        now: float,
        timeout_s: float,
        *,
        asleep: str = "",
    ) -> int:
        """Report freed bytes; the lease is not renewed any more. One that is gone counts as
        released.

        `asleep`: how the lease waits for its return (`standby`, `parked`) if the arbiter agrees;
        "" for none. The release of a lease that is asleep is repeated until the arbiter has
        answered, because it does not end by its TTL.
        """
        record.released = True
        self.held.pop(record.lease_id, None)
        if asleep:
            record.asleep = asleep
            self.asleep[record.lease_id] = record
        request = w.Release(record.lease_id, record.token, exiting, asleep == "parked")
        if asleep:
            return self._say_asleep(record, request, now, timeout_s)

        def let_go(reply: ReleaseReply, at: float) -> None:
            if reply.next in AWAY:
                self._cancel(record, at)

        return self._connection.ask(request, now, timeout_s, on_reply=let_go)

    def reacquire(
        self,
        record: LeaseRecord,
        wait_timeout_s: float | None,
        now: float,
        traceparent: str | None = None,
    ) -> int:
        """Ask for a lease that is asleep, as a waiter like any other. Its grant comes as
        `Returned`."""
        record.wanted, record.wanted_by = True, traceparent
        record.wanted_until = None if wait_timeout_s is None else now + wait_timeout_s
        return self._send_reacquire(record, now)

    def give_up_asleep(self, record: LeaseRecord, now: float) -> None:
        """End a lease that is asleep."""
        self._wake(record)
        self._cancel(record, now)

    # -- from the arbiter --------------------------------------------------------------------------
    def returned(self, view: LeaseView) -> None:
        """Apply the grant of a lease that is asleep: its record goes on under the new token."""
        record = self.asleep.get(view.lease_id)
        if record is None or view.token is None or view.state != "loading":
            return
        if view.token <= record.token:
            return
        self._wake(record)
        record.token, record.view = view.token, view
        record.confirmed_at = record.renewed_at = (
            self._connection.asked_at
        )  # as for the first grant
        record.held = record.released = False
        record.measured_bytes = None
        record.stays()
        self.held[record.lease_id] = record
        self._connection.events.append(Returned(record))

    def denied(self, lease_id: str, error: VramError) -> None:
        """Apply the end of a reacquire without a grant."""
        if record := self.asleep.get(lease_id):
            self._gone(record, error)

    def revoked(self, push: RevokePush) -> None:
        record = self.held.get(push.lease_id)
        if record is not None and record.token == push.token:
            record.revoke, record.withdrawn = push, False
            self._connection.events.append(RevokeAsked(record, push))

    def revoke_withdrawn(self, lease_id: str, token: Token) -> None:
        record = self.held.get(lease_id)
        if record is not None and record.token == token and record.revoke is not None:
            record.withdrawn = True
            self._connection.events.append(RevokeWithdrawn(record))

    def lost(self, push: LostPush) -> None:
        record = self._record(push.lease_id)
        if record is not None and record.token == push.token:
            self._gone(record, error_of(push.error))

    # -- contact -----------------------------------------------------------------------------------
    def reattachments(self) -> tuple[w.ReattachLease, ...]:
        records = (*self.held.values(), *self.asleep.values())
        return tuple([record.reattachment() for record in records])

    def reattached(self, reply: ReattachReply) -> None:
        for entry in reply.leases:
            record = self._record(entry.lease_id)
            if record is None:
                continue
            if entry.kept and record.asleep:
                if entry.lease is not None:
                    self.returned(entry.lease)  # if its grant was lost on the way
            elif entry.kept:
                record.confirmed_at = record.renewed_at = self._connection.asked_at
                if entry.lease is not None and entry.lease.state == "held":  # not revoked any more
                    self.revoke_withdrawn(record.lease_id, record.token)
            else:
                self._gone(record, error_of(entry.error))

    def say_again(self, now: float) -> None:
        """Repeat what a reattachment does not say: that a lease is wanted."""
        for record in self.asleep.values():
            if record.wanted and not self._connection.awaits(record.reacquire_id):
                self._send_reacquire(record, now, quiet=True)

    # -- time --------------------------------------------------------------------------------------
    def deadlines(self) -> Iterator[float]:
        for record in self.held.values():
            yield self.fence_at(record)
            if self._connection.phase == "up":
                yield _renew_at(record)
        for record in self.asleep.values():
            if record.wanted and record.wanted_until is not None:
                yield self._connection.wait_ends_at(record.wanted_until)

    def is_certain(self, record: LeaseRecord, now: float) -> bool:
        """Return whether a lease is held, and was confirmed so lately that its TTL cannot be over
        for the arbiter."""
        return record.held and now < record.confirmed_at + record.ttl_s

    def fence_at(self, record: LeaseRecord) -> float:
        return record.confirmed_at + record.ttl_s + self._connection.grace_s

    def fence(self, now: float) -> None:
        for record in [r for r in self.held.values() if now >= self.fence_at(r)]:
            silent_s = now - record.confirmed_at
            error = LeaseLost(
                f"no answer from the arbiter on {record.lease_id} for {silent_s:.1f} s: fenced",
                hint="unload now; acquire again when the arbiter is back",
                details={"lease_id": record.lease_id, "silent_s": silent_s},
            )
            self._gone(record, error, fenced=True)
            self._connection.fail_unsent(record.lease_id, _LEAVING, error, now)

    def end_overdue(self, now: float) -> None:
        """End waits for a return that are over while the arbiter cannot be reached."""
        ends_at = self._connection.wait_ends_at
        for record in [
            r for r in self.asleep.values() if r.wanted and now >= ends_at(r.wanted_until)
        ]:
            self._gone(record, waited_in_vain(record.spec, "its return"))
            self._cancel(record, now)

    def renew(self, now: float) -> None:
        """One message for all leases as soon as one is due."""
        if any(now >= _renew_at(record) for record in self.held.values()):
            for batch in _batches(self.held.values(), d.LEASES_PER_CLIENT_MAX):
                self._renew(batch, now)

    # -- steps -------------------------------------------------------------------------------------
    def _record(self, lease_id: str) -> LeaseRecord | None:
        return self.held.get(lease_id) or self.asleep.get(lease_id)

    def _say_asleep(
        self,
        record: LeaseRecord,
        release: w.Release,
        now: float,
        timeout_s: float,
        *,
        quiet: bool = False,
    ) -> int:
        """`quiet`: a repetition, so a refusal is reported as the end of the lease. An answer that
        comes when the lease sleeps no more, or again, is ignored."""
        token = record.token

        def sleeps() -> bool:
            return record.asleep != "" and record.token == token

        def let_go(reply: ReleaseReply, _: float) -> None:
            if not sleeps():
                return
            if reply.next in AWAY:
                record.asleep = reply.next
            else:
                over(LeaseLost(f"{record.lease_id} may not come back", hint="acquire again"))

        def refused(error: VramError, at: float) -> None:
            if not sleeps():
                return
            if isinstance(error, ArbiterUnreachable):
                self._say_asleep(record, release, at, timeout_s, quiet=True)
            else:
                over(error)

        def over(error: VramError) -> None:
            if quiet:
                self._gone(record, error)
            else:
                self._wake(record)

        return self._connection.ask(
            release, now, timeout_s, on_reply=let_go, on_error=refused, quiet=quiet
        )

    def _send_reacquire(self, record: LeaseRecord, now: float, *, quiet: bool = False) -> int:
        """`quiet`: a repetition, so a refusal is reported as the end of the lease."""

        def replied(reply: AcquireReply, _: float) -> None:
            self.returned(reply.lease)

        def refused(error: VramError, _: float) -> None:
            record.wanted = False
            if quiet:
                self._gone(record, error)

        left_s = None if record.wanted_until is None else max(0.0, record.wanted_until - now)
        record.reacquire_id = self._connection.ask(
            w.Reacquire(record.lease_id, record.token, left_s),
            now,
            on_reply=replied,
            on_error=refused,
            quiet=quiet,
            traceparent=record.wanted_by,
        )
        return record.reacquire_id

    def _cancel(self, record: LeaseRecord, now: float) -> None:
        self._connection.ask(w.Cancel(record.lease_id), now, quiet=True)

    def _renew(self, batch: list[LeaseRecord], now: float) -> None:
        for record in batch:
            record.renewed_at = now

        def renewed(reply: RenewReply, _: float) -> None:
            alive = set(reply.alive)
            for record in batch:
                if record.lease_id in alive:
                    record.confirmed_at = max(record.confirmed_at, now)
            for entry in reply.gone:
                gone = self.held.get(entry.lease_id)
                if gone is not None and gone in batch:
                    self._gone(gone, error_of(entry.error))

        refs = tuple([w.LeaseRef(record.lease_id, record.token) for record in batch])
        self._connection.ask(w.Renew(refs), now, on_reply=renewed, quiet=True)

    def _wake(self, record: LeaseRecord) -> bool:
        """Stop waiting for its return. Returns whether it did wait."""
        record.asleep, record.wanted = "", False
        return self.asleep.pop(record.lease_id, None) is not None

    def _gone(self, record: LeaseRecord, error: VramError, fenced: bool = False) -> None:
        if not (self.held.pop(record.lease_id, None) or self._wake(record)):
            return
        record.uses.clear()
        self._connection.drop_unsent(record.lease_id, _MEANINGLESS)
        self._connection.events.append(Gone(record, error, fenced))


def waited_in_vain(spec: LeaseSpec, what: str, waited_s: float | None = None) -> WaitTimeout:
    """Return the error of a wait whose end the arbiter did not report."""
    within = "in time" if waited_s is None else f"within {waited_s:.1f} s"
    return WaitTimeout(
        f"no answer on {what} for {spec.consumer} {within}, and no contact to the arbiter",
        hint="is the arbiter running? see `vramctl status`",
        details={} if waited_s is None else {"waited_s": waited_s},
    )


def _renew_at(record: LeaseRecord) -> float:
    return record.renewed_at + record.ttl_s * d.RENEW_FRACTION


def _batches(records: Iterable[LeaseRecord], size: int) -> list[list[LeaseRecord]]:
    every = list(records)
    return [every[i : i + size] for i in range(0, len(every), size)]
