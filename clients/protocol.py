"""The client's side of the arbiter's wire, sans-IO: what to send, what it means, what is due when.

It knows no sockets, no asyncio and no clock: messages are maps, time is passed in as `now` (monotonic seconds). The owner
feeds `receive` and `tick`, then performs what `take_outgoing` and `take_events` hand out. On `ContactLost` the owner opens a fresh
socket and calls `connected`: everything that was under way is said again, which is safe because every op is idempotent.

Rules. A grant counts from its message; a lease is renewed every ttl/3 and, without the arbiter's word for ttl + grace, is *fenced*:
the client gives it up by itself. Nobody waits for ever: each request and each wait has a deadline.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from clients.records import (
    ContactLost,
    Denied,
    Event,
    Failed,
    ForeignUseRecord,
    Gone,
    Granted,
    HistoryEvent,
    LeaseRecord,
    Message,
    Pending,
    Refused,
    Replied,
    Resized,
    Returned,
    RevokeAsked,
    TokenPair,
    Up,
    UseLost,
    Waiter,
)  # fmt: skip
from schemas import defaults as d
from schemas.errors import ArbiterUnreachable, LeaseLost, UnknownSession, VramError, WaitTimeout, from_wire

HELLO_TIMEOUT_S = 2.0  # an unanswered hello is said again on a fresh socket
REFUSED_RETRY_S = 1.0  # after a refused hello (a full server may have room later)
SILENCE_BEATS = 3  # heartbeats without a word mean lost contact
REQUEST_TIMEOUT_S = 30.0  # a restart of the daemon takes a few seconds: a request outlives it
WAIT_SLACK_S = 5.0  # the arbiter ends waits; we only do if it does not

GONE_CODES = frozenset({"lease_lost", "lease_expired", "unknown_lease", "stale_token"})
"""Replies that say that the lease is no longer ours."""


class ClientProtocol:
    """One connection's state machine. `phase` is `down`, `greeting`, `reattaching` or `up`."""

    def __init__(self, *, name: str, instance: str, role: str = "client") -> None:
        self.instance = instance
        self._hello = {
            "op": "hello",
            "version": d.WIRE_VERSION,
            "name": name,
            "instance": instance,
            "role": role,
        }
        self.phase = "down"
        self.epoch: int | None = None
        self.heartbeat_s = d.HEARTBEAT_S
        self.grace_s = d.FENCE_GRACE_S
        self.welcome: Message = {}
        self.leases: dict[str, LeaseRecord] = {}
        self.asleep: dict[str, LeaseRecord] = {}  # evicted, waiting to come back: not renewed, not fenced
        self._next_id = 1
        self._outgoing: list[Message] = []
        self._events: list[Event] = []
        self._pending: dict[int, Pending] = {}
        self._waiters: dict[str, Waiter] = {}
        self._foreign: dict[str, ForeignUseRecord] = {}
        self._subscribed = False
        self._phase_deadline: float | None = None
        self._handshake_id = 0
        self._handshake_at = 0.0
        self._heard_at = 0.0
        self._asked_at = 0.0  # when the newest request that this connection answered was *sent*
        self._pinged = False

    # -- in and out --------------------------------------------------------------------------------------------------
    def take_outgoing(self) -> list[Message]:
        taken, self._outgoing = self._outgoing, []
        return taken

    def take_events(self) -> list[Event]:
        taken, self._events = self._events, []
        return taken

    def connected(self, now: float) -> None:
        """A fresh socket is there: say hello on it."""
        self._outgoing.clear()
        self._pinged = False
        self.phase = "greeting"
        self._handshake_id, self._handshake_at = self._new_id(), now
        self._phase_deadline = now + HELLO_TIMEOUT_S
        self._outgoing.append({**self._hello, "id": self._handshake_id})

    def contact_lost(self, reason: str) -> None:
        """The transport says so, or silence does. Leases stay ours until they are fenced."""
        if self.phase == "down":
            return
        self.phase = "down"
        self._phase_deadline = None
        self._outgoing.clear()
        for request in self._pending.values():
            request.sent_at = None
        self._events.append(ContactLost(reason))

    def receive(self, message: Message, now: float) -> None:
        """One message from the arbiter. Unknown pushes and replies to forgotten requests are ignored."""
        if self.phase == "down":
            return
        self._heard_at, self._pinged = now, False
        if "push" in message:
            self._push(message, now)
        elif message.get("re") == self._handshake_id and self.phase != "up":
            self._asked_at = self._handshake_at
            self._handshake(message, now)
        else:
            self._reply(message, now)

    # -- requests ----------------------------------------------------------------------------------------------------
    def request(
        self, op: str, fields: Mapping[str, Any], now: float, *, timeout_s: float = REQUEST_TIMEOUT_S
    ) -> int:
        """Ask anything; its end comes as `Replied` or `Failed`. Without contact it is kept and sent after the next greeting."""
        return self._ask({"op": op, **fields}, now, timeout_s)

    def acquire(
        self,
        nonce: str,
        spec: Mapping[str, Any],
        now: float,
        *,
        wait_timeout_s: float | None = None,
        traceparent: str | None = None,
    ) -> None:
        """Ask for a lease; ends as `Granted` or `Denied` with this nonce."""
        deadline = None if wait_timeout_s is None else now + wait_timeout_s
        extra = {"traceparent": traceparent} if traceparent else {}
        waiter = Waiter(nonce, dict(spec), extra, now, deadline)
        self._waiters[nonce] = waiter
        self._send_acquire(waiter, now)

    def cancel_acquire(self, nonce: str, now: float) -> None:
        """Give up a wait. If the grant is on its way already, it is released when it comes."""
        waiter = self._waiters.get(nonce)
        if waiter is None:
            return
        waiter.abandoned = True
        if waiter.lease_id is not None:
            self._cancel(waiter, now)

    def ready(self, record: LeaseRecord, measured_bytes: int | None, now: float) -> int:
        def held(_: Message, __: float) -> None:
            record.held, record.measured_bytes = True, measured_bytes

        return self._ask(
            {"op": "ready", **record.ref(), "measured_bytes": measured_bytes},
            now,
            on_reply=held,
            record=record,
        )

    def use_begin(self, record: LeaseRecord, use_id: str, label: str, now: float) -> int:
        """Begin a use on our own lease. It counts from now on, so that a re-attachment on the way tells of it."""
        record.uses.add(use_id)

        def refused(_: VramError, __: float) -> None:
            record.uses.discard(use_id)

        message = {"op": "use_begin", **record.ref(), "use_id": use_id, "label": label}
        return self._ask(message, now, on_error=refused, record=record)

    def use_end(self, record: LeaseRecord, use_id: str, now: float) -> int:
        record.uses.discard(use_id)
        return self._ask({"op": "use_end", **record.ref(), "use_id": use_id}, now, quiet=True)

    def foreign_use_begin(
        self, lease_id: str, token: TokenPair, use_id: str, label: str, now: float, timeout_s: float
    ) -> int:
        """Begin a use on somebody else's lease; begun again after every reconnect until `foreign_use_end`."""
        use = ForeignUseRecord(lease_id, token, label)

        def begun(_: Message, __: float) -> None:
            self._foreign[use_id] = use

        return self._ask(use.begin(use_id), now, timeout_s, on_reply=begun)

    def foreign_use_end(self, lease_id: str, token: TokenPair, use_id: str, now: float) -> int:
        """Also right while the begin is under way: the arbiter hears both in order."""
        self._foreign.pop(use_id, None)
        for request in self._pending.values():
            if request.message["op"] == "use_begin" and request.message["use_id"] == use_id:
                request.on_reply = None  # a late answer must not make it live again
        message = {"op": "use_end", "lease_id": lease_id, "token": list(token), "use_id": use_id}
        return self._ask(message, now, quiet=True)

    def revoke_ack(self, record: LeaseRecord, eta_s: float | None, now: float) -> int:
        message = {"op": "revoke_ack", **record.ref(), "safe_point_eta_s": eta_s}
        return self._ask(message, now, quiet=True, record=record)

    def unloading(self, record: LeaseRecord, now: float, timeout_s: float = REQUEST_TIMEOUT_S) -> int:
        return self._ask({"op": "unloading", **record.ref()}, now, timeout_s, record=record)

    def release(
        self, record: LeaseRecord, exiting: bool, now: float, timeout_s: float, *, asleep: str = ""
    ) -> int:
        """From here on nothing is held: no renewal. A lease that is gone already counts as released.

        `asleep`: how it waits to come back (`standby`, `parked`), if the arbiter agrees; "" means never again.
        """
        record.released = True
        self.leases.pop(record.lease_id, None)
        if asleep:
            record.asleep = asleep
            self.asleep[record.lease_id] = record
        message = {"op": "release", **record.ref(), "exiting": exiting, "parked": asleep == "parked"}

        def let_go(reply: Message, at: float) -> None:
            then = str(reply.get("next", ""))
            if asleep and then not in ("standby", "parked"):
                self._wake(record)
            elif asleep:
                record.asleep = then
            elif then in ("standby", "parked"):
                self._ask({"op": "cancel", "lease_id": record.lease_id}, at, quiet=True)

        def refused(_: VramError, __: float) -> None:
            self._wake(record)

        return self._ask(message, now, timeout_s, on_reply=let_go, on_error=refused)

    def give_up_asleep(self, record: LeaseRecord, now: float) -> None:
        """A lease on standby or parked is not wanted any more."""
        self._wake(record)
        self._ask({"op": "cancel", "lease_id": record.lease_id}, now, quiet=True)

    def reacquire(self, record: LeaseRecord, wait_timeout_s: float | None, now: float) -> int:
        """A lease on standby or parked wants in now, as a waiter like any other. Its grant comes as `Returned`."""

        record.wanted = True
        record.wanted_until = None if wait_timeout_s is None else now + wait_timeout_s
        return self._send_reacquire(record, now)

    def use_yield(self, record: LeaseRecord, use_id: str, now: float) -> int:
        """The use goes on, but no longer keeps the lease: `use_begin` with the same id takes it up again."""
        record.uses.discard(use_id)
        return self._ask({"op": "yield", **record.ref(), "use_id": use_id}, now, record=record)

    def resize(
        self, record: LeaseRecord, footprint: Message, wait_timeout_s: float | None, now: float
    ) -> int:
        """Hold more, or less. The reply says `held` when it is done; else its end comes as `Resized`."""

        def accepted(_: Message, __: float) -> None:
            record.spec = {**record.spec, "footprint": footprint}

        message = {
            "op": "resize",
            **record.ref(),
            "footprint": footprint,
            "wait_timeout_s": wait_timeout_s,
        }
        return self._ask(message, now, on_reply=accepted, record=record)

    def oom(self, record: LeaseRecord, requested_bytes: int, allocated_bytes: int | None, now: float) -> int:
        message = {
            "op": "oom",
            **record.ref(),
            "requested_bytes": requested_bytes,
            "allocated_bytes": allocated_bytes,
        }
        return self._ask(message, now, record=record)

    def subscribe(self, now: float) -> int:
        """History events from now on, also after reconnects."""

        def subscribed(_: Message, __: float) -> None:
            self._subscribed = True

        return self._ask({"op": "subscribe"}, now, on_reply=subscribed)

    def forget(self, request_id: int) -> None:
        """Nobody waits for this reply any more. A request that was not sent yet is dropped."""
        request = self._pending.get(request_id)
        if request is not None:
            request.quiet = True

    # -- time --------------------------------------------------------------------------------------------------------
    def next_deadline(self) -> float | None:
        """When `tick` has something to do at the latest."""
        due: list[float] = [request.deadline for request in self._pending.values()]
        due += [self._wait_limit(w) for w in self._waiters.values() if w.deadline is not None]
        due += [self._fence_at(record) for record in self.leases.values()]
        wanted = [record for record in self.asleep.values() if record.wanted]
        due += [self._wanted_limit(record) for record in wanted if record.wanted_until is not None]
        if self._phase_deadline is not None:
            due.append(self._phase_deadline)
        if self.phase == "up":
            due += [record.renewed_at + record.ttl_s * d.RENEW_FRACTION for record in self.leases.values()]
            due.append(self._heard_at + SILENCE_BEATS * self.heartbeat_s if self._pinged else self._ping_at())
        return min(due, default=None)

    def tick(self, now: float) -> None:
        """1. Fence leases. 2. End requests and waits past their deadline. 3. Hello again, or declare silence. 4. Renew, ping."""
        for record in [r for r in self.leases.values() if now >= self._fence_at(r)]:  # 1
            silent_s = now - record.confirmed_at
            self._gone(
                record,
                LeaseLost(
                    f"no word from the arbiter on {record.lease_id} for {silent_s:.1f} s: fenced",
                    hint="unload now; acquire again when the arbiter is back",
                    details={"lease_id": record.lease_id, "silent_s": silent_s},
                ),
                fenced=True,
            )
        for request_id in [i for i, r in self._pending.items() if now >= r.deadline]:  # 2
            self._fail(request_id, _unreachable(self._pending[request_id].message["op"]), now)
        for waiter in [w for w in self._waiters.values() if now >= self._wait_limit(w)]:
            self._deny_locally(waiter, now)
        for record in [r for r in self.asleep.values() if r.wanted and now >= self._wanted_limit(r)]:
            self._gone(record, _waited_in_vain(record.spec, "its return"))
            self._ask({"op": "cancel", "lease_id": record.lease_id}, now, quiet=True)
        if self._phase_deadline is not None and now >= self._phase_deadline:  # 3
            self.contact_lost("no answer to hello")
        if self.phase != "up":
            return
        if now >= self._heard_at + SILENCE_BEATS * self.heartbeat_s and self._pinged:
            self.contact_lost(f"the arbiter said nothing for {now - self._heard_at:.1f} s")
            return
        self._renew(now)  # 4
        if not self._pinged and now >= self._ping_at():
            self._pinged = True
            self._ask({"op": "ping"}, now, quiet=True)

    # -- steps: greeting -----------------------------------------------------------------------------------------------
    def _handshake(self, message: Message, now: float) -> None:
        if not message.get("ok"):
            error = from_wire(message.get("error") or {})
            if isinstance(error, UnknownSession):
                self.contact_lost("the arbiter forgot the session")
                return
            self._events.append(Refused(error))
            self._phase_deadline = now + REFUSED_RETRY_S
            return
        if self.phase == "greeting":
            self.welcome = message
            self.epoch = int(message["epoch"])
            self.heartbeat_s = float(message.get("heartbeat_s", self.heartbeat_s))
            self.grace_s = float(message.get("grace_s", self.grace_s))
            if self.leases or self.asleep:
                self.phase = "reattaching"
                self._handshake_id, self._handshake_at = self._new_id(), now
                self._phase_deadline = now + HELLO_TIMEOUT_S
                kept = [*self.leases.values(), *self.asleep.values()]
                leases = [record.reattachment() for record in kept]
                self._outgoing.append({"op": "reattach", "id": self._handshake_id, "leases": leases})
                return
        else:
            self._reattached(message, now)
        self._come_up(now)

    def _reattached(self, message: Message, now: float) -> None:
        for entry in message.get("leases", ()):
            record = self.leases.get(entry["lease_id"]) or self.asleep.get(entry["lease_id"])
            if record is None:
                continue
            if entry.get("kept") and record.asleep:
                self._returned(entry["lease"], now)  # if its grant was lost on the way
            elif entry.get("kept"):
                record.confirmed_at = record.renewed_at = self._handshake_at
                record.revoke = None  # a push that is still meant comes again
            else:
                self._gone(record, from_wire(entry.get("error") or {"code": "lease_lost"}))

    def _come_up(self, now: float) -> None:
        """Say everything again that the arbiter may not have heard, oldest first."""
        self.phase = "up"
        self._phase_deadline = None
        assert self.epoch is not None
        self._events.append(Up(self.epoch))
        again = list(self._pending.values())
        if self._subscribed:
            self._ask({"op": "subscribe"}, now, quiet=True)
        for waiter in self._waiters.values():
            if waiter.request_id not in self._pending:
                self._send_acquire(waiter, now)
        for record in self.asleep.values():
            if record.wanted and not any(_reacquires(request.message, record) for request in again):
                self._send_reacquire(record, now, quiet=True)
        for use_id, use in self._foreign.items():
            self._renew_use(use_id, use, now)
        for request in again:
            self._send(request, now)

    def _send_reacquire(self, record: LeaseRecord, now: float, *, quiet: bool = False) -> int:
        """Said again after a restart of the daemon: it knows that the lease is away, not that it is wanted."""

        def replied(message: Message, at: float) -> None:
            self._returned(message["lease"], at)

        def refused(error: VramError, _: float) -> None:
            record.wanted = False
            if quiet:
                self._gone(record, error)

        left_s = None if record.wanted_until is None else max(0.0, record.wanted_until - now)
        message = {"op": "reacquire", **record.ref(), "wait_timeout_s": left_s}
        return self._ask(message, now, on_reply=replied, on_error=refused, quiet=quiet)

    def _renew_use(self, use_id: str, use: ForeignUseRecord, now: float) -> None:
        def lost(error: VramError, _: float) -> None:
            if self._foreign.pop(use_id, None) is not None:
                self._events.append(UseLost(use_id, error))

        self._ask(use.begin(use_id), now, on_error=lost, quiet=True)

    # -- steps: replies ------------------------------------------------------------------------------------------------
    def _reply(self, message: Message, now: float) -> None:
        request_id = message.get("re")
        request = self._pending.get(request_id) if isinstance(request_id, int) else None
        if request is not None and request.sent_at is not None:
            self._asked_at = max(self._asked_at, request.sent_at)
        if message.get("ok"):
            if request is not None and isinstance(request_id, int):
                del self._pending[request_id]
                if request.on_reply is not None:
                    request.on_reply(message, now)
                if not request.quiet:
                    self._events.append(Replied(request_id, message))
            return
        error = from_wire(message.get("error") or {})
        if isinstance(
            error, UnknownSession
        ):  # the daemon restarted behind a socket that reconnected by itself
            self.contact_lost("the arbiter forgot the session")
        elif request is not None and isinstance(request_id, int):
            self._fail(request_id, error, now)

    def _fail(self, request_id: int, error: VramError, now: float) -> None:
        request = self._pending.pop(request_id)
        if request.on_error is not None:
            request.on_error(error, now)
        if not request.quiet:
            self._events.append(Failed(request_id, error))

    def _acquire_replied(self, waiter: Waiter, message: Message, now: float) -> None:
        view = message["lease"]
        waiter.lease_id = view["lease_id"]
        if (
            message.get("state") == "loading"
        ):  # a lease that comes back has a token while it waits, the last one
            self._granted(waiter, view, now)
        elif waiter.abandoned:
            self._cancel(waiter, now)

    def _granted(self, waiter: Waiter, view: Message, now: float) -> None:
        """The message may have waited for us longer than the lease lives: what is sure is only that it was sent after the arbiter
        heard the newest request that it has answered."""
        self._waiters.pop(waiter.nonce, None)
        token = (int(view["token"][0]), int(view["token"][1]))
        record = LeaseRecord(
            lease_id=view["lease_id"],
            token=token,
            nonce=waiter.nonce,
            spec=waiter.spec,
            view=view,
            confirmed_at=self._asked_at,
            renewed_at=self._asked_at,
        )
        if waiter.abandoned:  # granted while we turned away: hand it back at once, nothing was loaded
            self._ask({"op": "release", **record.ref(), "exiting": False}, now, quiet=True)
            return
        self.leases[record.lease_id] = record
        self._events.append(Granted(waiter.nonce, record))

    def _denied(self, waiter: Waiter, error: VramError) -> None:
        if self._waiters.pop(waiter.nonce, None) is not None and not waiter.abandoned:
            self._events.append(Denied(waiter.nonce, error))

    def _deny_locally(self, waiter: Waiter, now: float) -> None:
        """The wait's time is over and the arbiter did not say so: it is out of reach."""
        error = _waited_in_vain(waiter.spec, "a lease", now - waiter.asked_at)
        if not waiter.abandoned:
            self._events.append(Denied(waiter.nonce, error))
        waiter.abandoned, waiter.deadline = True, None
        if waiter.lease_id is not None:
            self._cancel(waiter, now)

    def _cancel(self, waiter: Waiter, now: float) -> None:
        def over(_: object, __: float) -> None:
            self._waiters.pop(waiter.nonce, None)

        message = {"op": "cancel", "lease_id": waiter.lease_id}
        self._ask(message, now, on_reply=over, on_error=over, quiet=True)

    # -- steps: pushes -------------------------------------------------------------------------------------------------
    def _push(self, message: Message, now: float) -> None:
        match message["push"]:
            case "granted":
                view = message["lease"]
                if waiter := self._waiter_of(view["lease_id"]):
                    self._granted(waiter, view, now)
                else:
                    self._returned(view, now)
            case "denied":
                self._refused_later(message["lease_id"], from_wire(message["error"]))
            case "resized":
                if record := self.leases.get(message["lease_id"]):
                    self._events.append(Resized(record))
            case "revoke":
                record = self.leases.get(message["lease_id"])
                if record is not None and list(record.token) == list(message["token"]):
                    first, record.revoke = record.revoke is None, message
                    record.server_uses = message.get("uses")
                    self._events.append(RevokeAsked(record, message, first))
            case "lost":
                record = self.leases.get(message["lease_id"]) or self.asleep.get(message["lease_id"])
                if record is not None and list(record.token) == list(message["token"]):
                    self._gone(record, from_wire(message["error"]))
            case "event":
                self._events.append(HistoryEvent(message["event"]))

    def _refused_later(self, lease_id: str, error: VramError) -> None:
        """A wait that ended without a grant: of an acquire, of a resize, or of a lease that wanted to come back."""
        if waiter := self._waiter_of(lease_id):
            self._denied(waiter, error)
        elif record := self.leases.get(lease_id):
            self._events.append(Resized(record, error))
        elif record := self.asleep.get(lease_id):
            self._gone(record, error)

    def _waiter_of(self, lease_id: str) -> Waiter | None:
        return next((w for w in self._waiters.values() if w.lease_id == lease_id), None)

    # -- steps: leases -------------------------------------------------------------------------------------------------
    def _gone(self, record: LeaseRecord, error: VramError, fenced: bool = False) -> None:
        if not (self.leases.pop(record.lease_id, None) or self._wake(record)):
            return
        record.uses.clear()
        self._drop_unsent(
            lambda m: m.get("lease_id") == record.lease_id and m["op"] in ("revoke_ack", "use_end")
        )
        self._events.append(Gone(record, error, fenced))

    def _wake(self, record: LeaseRecord) -> bool:
        """It waits no longer. Did it?"""
        record.asleep, record.wanted = "", False
        return self.asleep.pop(record.lease_id, None) is not None

    def _returned(self, view: Message, now: float) -> None:
        """Granted again? The same record goes on under the new token."""
        record = self.asleep.get(view["lease_id"])
        if record is None or view.get("token") is None or view["state"] != "loading":
            return
        token = (int(view["token"][0]), int(view["token"][1]))
        if token <= record.token:
            return
        self._wake(record)
        record.token, record.view = token, view
        record.confirmed_at = record.renewed_at = self._asked_at  # as a grant's: see `_granted`
        record.held = record.released = False
        record.measured_bytes = record.revoke = record.server_uses = None
        self.leases[record.lease_id] = record
        self._events.append(Returned(record))

    def _renew(self, now: float) -> None:
        """One message for all leases as soon as one is due."""
        if not any(now >= r.renewed_at + r.ttl_s * d.RENEW_FRACTION for r in self.leases.values()):
            return
        for batch in _batches(self.leases.values(), d.LEASES_PER_CLIENT_MAX):
            for record in batch:
                record.renewed_at = now

            def renewed(message: Message, _: float, records: list[LeaseRecord] = batch) -> None:
                alive = set(message.get("alive", ()))
                for record in records:
                    if record.lease_id in alive:
                        record.confirmed_at = max(record.confirmed_at, now)
                for entry in message.get("gone", ()):
                    gone = self.leases.get(entry["lease_id"])
                    if gone is not None and gone in records:
                        self._gone(gone, from_wire(entry.get("error") or {"code": "lease_lost"}))

            self._ask(
                {"op": "renew", "leases": [record.ref() for record in batch]},
                now,
                on_reply=renewed,
                quiet=True,
            )

    def _ping_at(self) -> float:
        """After a silence; and while we wait for a grant, so that its age is known, also if pushes keep coming."""
        waits = bool(self._waiters or self.asleep)
        return (min(self._heard_at, self._asked_at) if waits else self._heard_at) + self.heartbeat_s

    def _fence_at(self, record: LeaseRecord) -> float:
        return record.confirmed_at + record.ttl_s + self.grace_s

    def _wanted_limit(self, record: LeaseRecord) -> float:
        if record.wanted_until is None:
            return float("inf")
        return record.wanted_until + (WAIT_SLACK_S if self.phase == "up" else 0.0)

    def _wait_limit(self, waiter: Waiter) -> float:
        if waiter.deadline is None:
            return float("inf")
        return waiter.deadline + (WAIT_SLACK_S if self.phase == "up" else 0.0)

    # -- steps: sending ------------------------------------------------------------------------------------------------
    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1

    def _ask(
        self,
        message: Message,
        now: float,
        timeout_s: float = REQUEST_TIMEOUT_S,
        *,
        on_reply: Callable[[Message, float], None] | None = None,
        on_error: Callable[[VramError, float], None] | None = None,
        record: LeaseRecord | None = None,
        quiet: bool = False,
    ) -> int:
        request_id = self._new_id()
        token = None if record is None else record.token

        def refused(error: VramError, at: float) -> None:
            if on_error is not None:
                on_error(error, at)
            if record is not None and record.token == token and error.code in GONE_CODES:
                self._gone(record, error)

        request = Pending(
            {**message, "id": request_id}, now + timeout_s, on_reply=on_reply, on_error=refused, quiet=quiet
        )
        self._pending[request_id] = request
        if self.phase == "up":
            self._send(request, now)
        return request_id

    def _send(self, request: Pending, now: float) -> None:
        request.sent_at = now
        self._outgoing.append(request.message)

    def _send_acquire(self, waiter: Waiter, now: float) -> None:
        left_s = None if waiter.deadline is None else max(0.0, waiter.deadline - now)
        if waiter.abandoned:
            left_s = 0.0
        limit_s = (
            REQUEST_TIMEOUT_S if waiter.deadline is None else max(REQUEST_TIMEOUT_S, waiter.deadline - now)
        )

        def replied(message: Message, at: float) -> None:
            if waiter.nonce in self._waiters:
                self._acquire_replied(waiter, message, at)

        waiter.request_id = self._ask(
            {
                "op": "acquire",
                "nonce": waiter.nonce,
                "spec": waiter.spec,
                "wait_timeout_s": left_s,
                **waiter.extra,
            },
            now,
            limit_s,
            on_reply=replied,
            on_error=lambda error, _: self._denied(waiter, error),
            quiet=True,
        )

    def _drop_unsent(self, matches: Callable[[Message], bool]) -> None:
        for request_id in [i for i, r in self._pending.items() if r.sent_at is None and matches(r.message)]:
            del self._pending[request_id]


def _reacquires(message: Message, record: LeaseRecord) -> bool:
    return bool(message["op"] == "reacquire" and message["lease_id"] == record.lease_id)


def _waited_in_vain(spec: Message, what: str, waited_s: float | None = None) -> WaitTimeout:
    within = "in time" if waited_s is None else f"within {waited_s:.1f} s"
    return WaitTimeout(
        f"no word on {what} for {spec.get('consumer')} {within}, and no contact to the arbiter",
        hint="is the arbiter running? see `vramctl status`",
        details={} if waited_s is None else {"waited_s": waited_s},
    )


def _unreachable(op: str) -> ArbiterUnreachable:
    return ArbiterUnreachable(
        f"the arbiter did not answer {op} in time", hint="is it running? see `vramctl status`"
    )


def _batches(records: Iterable[LeaseRecord], size: int) -> list[list[LeaseRecord]]:
    every = list(records)
    return [every[i : i + size] for i in range(0, len(every), size)]
