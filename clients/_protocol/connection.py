"""One connection to the arbiter, sans-IO: hello, requests and their replies, silence.

It knows no sockets, no event loop, no clock (messages are maps; time is passed in as `now`, in
monotonic seconds) and no leases: those are the `Above` (`clients._protocol.protocol`), which gets
the pushes. The owner (`clients._session`) feeds `receive`, takes what it finds in `outgoing` and
`events`, and on `ContactLost` opens a fresh socket and calls `connected`.

`phase`: `down` → `greeting` (hello is sent) → `reattaching` (if a lease has to be reattached) →
`up`. On the way up every request without a reply is sent again, which is safe because every op is
idempotent. Each request has a deadline.
"""

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, Protocol

from vram_arbiter.clients._protocol.records import (
    ContactLost,
    Event,
    Failed,
    GreetingRefused,
    OnError,
    Pending,
    Replied,
    Up,
)
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.codec import CodecError, from_map, to_map
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    InternalError,
    UnknownSession,
    VramError,
    from_wire,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.pushes import PUSHES, AnyPush
from vram_arbiter.schemas.wire.replies import ReattachReply, WelcomeReply

HELLO_TIMEOUT_S = 2.0  # an unanswered hello is said again on a fresh socket
REFUSED_RETRY_S = 1.0  # after a refused hello (a full server may have room later)
SILENCE_BEATS = 3  # heartbeats without a word mean lost contact
REQUEST_TIMEOUT_S = 30.0  # a restart of the daemon takes a few seconds: a request outlives it
WAIT_SLACK_S = 5.0  # the arbiter ends waits; we only do if it does not

type Kinds = tuple[type[w.OnLease[Any]], ...]


class Above(Protocol):
    """The part of the protocol that uses the connection."""

    def reattachments(self) -> tuple[w.ReattachLease, ...]:
        """Return what the arbiter needs first; empty: nothing."""
        ...

    def reattached(self, reply: ReattachReply) -> None:
        """Apply the arbiter's answer to them."""
        ...

    def say_again(self, now: float) -> None:
        """The phase is `up`: repeat what the arbiter may not know. Requests without a reply are the
        connection's."""
        ...

    def pushed(self, push: AnyPush, now: float) -> None:
        """Apply a push."""
        ...


class Connection:
    """`phase`, what the arbiter said (`epoch`, `role`, `heartbeat_s`, `grace_s`), and what its
    owner takes: `outgoing` messages and `events`."""

    def __init__(self, above: Above, *, name: str, instance: str, role: w.Role) -> None:
        self.instance = instance
        self.phase = "down"
        self.epoch: int | None = None
        self.role: str | None = None
        self.heartbeat_s = d.HEARTBEAT_S
        self.grace_s = d.FENCE_GRACE_S
        self.asked_at = 0.0
        """When the newest answered request was *sent*: what is read now was sent after that."""
        self._above = above
        self._hello = w.Hello(name=name, instance=instance, role=role)
        self._ids = count(1)
        self.outgoing: list[Message] = []
        self.events: list[Event] = []
        self._pending: dict[int, Pending] = {}
        self._phase_deadline: float | None = None
        self._handshake_id = 0
        self._handshake_at = 0.0
        self._heard_at = 0.0
        self._pinged = False

    # -- for the owner -----------------------------------------------------------------------------
    def connected(self, now: float) -> None:
        """Send hello on a fresh socket."""
        self.outgoing.clear()
        self._pinged = False
        self.phase = "greeting"
        self._send_handshake(self._hello, now)

    def contact_lost(self, reason: str) -> None:
        """Note a broken socket, or a silent arbiter."""
        if self.phase == "down":
            return
        self.phase = "down"
        self._phase_deadline = None
        self.outgoing.clear()
        for request in self._pending.values():
            request.sent_at = None
        self.events.append(ContactLost(reason))

    def receive(self, message: Message, now: float) -> None:
        """One message from the arbiter. Replies to forgotten requests are ignored."""
        if self.phase == "down":
            return
        self._heard_at, self._pinged = now, False
        if "push" in message:
            if (cls := PUSHES.get(str(message["push"]))) is not None:  # else a newer arbiter's
                self._above.pushed(from_map(cls, message), now)
        elif message.get("re") == self._handshake_id and self.phase != "up":
            self.asked_at = self._handshake_at
            self._handshake_reply(message, now)
        else:
            self._reply(message, now)

    def forget(self, request_id: int) -> None:
        """Stop reporting the end of a request: its caller waits no more."""
        request = self._pending.get(request_id)
        if request is not None:
            request.quiet = True

    def ask[R](
        self,
        request: w.Request[R],
        now: float,
        timeout_s: float = REQUEST_TIMEOUT_S,
        *,
        on_reply: Callable[[R, float], None] | None = None,
        on_error: OnError | None = None,
        quiet: bool = False,
        traceparent: str | None = None,
    ) -> int:
        """Queue a request. Its end (also its deadline) goes to `on_reply` or `on_error`, then to
        the owner as `Replied` or `Failed` unless `quiet`. Without contact it is kept until the next
        hello."""
        request_id = next(self._ids)
        pending = Pending(
            request, request_id, traceparent, now + timeout_s, None, on_reply, on_error, quiet
        )
        self._pending[request_id] = pending
        if self.phase == "up":
            self._send(pending, now)
        return request_id

    # -- for what is above -------------------------------------------------------------------------
    def awaits(self, request_id: int | None) -> bool:
        """Return whether the reply is missing; then the request is sent again after a reconnect."""
        return request_id in self._pending

    def drop_unsent(self, lease_id: str, kinds: Kinds) -> None:
        """Drop requests on a lease that were not sent yet and have no meaning any more."""
        for pending in self._unsent(lease_id):
            if isinstance(pending.request, kinds):
                del self._pending[pending.id]

    def fail_unsent(self, lease_id: str, kept: Kinds, error: VramError, now: float) -> None:
        """End requests on a lease that were not sent yet, but for some: the lease is over."""
        for pending in self._unsent(lease_id):
            if not isinstance(pending.request, kept):
                self._fail(pending.id, error, now)

    def _unsent(self, lease_id: str) -> list[Pending]:
        return [
            pending
            for pending in self._pending.values()
            if pending.sent_at is None
            and isinstance(pending.request, w.OnLease)
            and pending.request.lease_id == lease_id
        ]

    # -- time --------------------------------------------------------------------------------------
    def deadlines(self, both_ways: bool) -> Iterator[float]:
        """`both_ways`: the arbiter has to hear of the client too, or the age of what may come has
        to be known: pushes alone do not tell, pings do."""
        for request in self._pending.values():
            yield request.deadline
        if self._phase_deadline is not None:
            yield self._phase_deadline
        if self.phase == "up":
            yield self._silent_at() if self._pinged else self._ping_at(both_ways)

    def wait_ends_at(self, deadline: float | None) -> float:
        """Return when a wait ends here. While in contact, the arbiter ends it first."""
        if deadline is None:
            return float("inf")
        return deadline + (WAIT_SLACK_S if self.phase == "up" else 0.0)

    def end_requests(self, now: float) -> None:
        """Fail the requests past their deadline."""
        for request_id in [i for i, r in self._pending.items() if now >= r.deadline]:
            if request_id in self._pending:  # one's end may drop another
                self._fail(request_id, _unreachable(self._pending[request_id].request), now)

    def stays_up(self, now: float) -> bool:
        """Declare contact lost if a hello or a ping had no answer. Returns whether the phase is
        `up`."""
        if self._phase_deadline is not None and now >= self._phase_deadline:
            self.contact_lost("no answer to hello")
        if self.phase == "up" and self._pinged and now >= self._silent_at():
            self.contact_lost(f"the arbiter was silent for {now - self._heard_at:.1f} s")
        return self.phase == "up"

    def ping_if_silent(self, now: float, both_ways: bool) -> None:
        if not self._pinged and now >= self._ping_at(both_ways):
            self._pinged = True
            self.ask(w.Ping(), now, quiet=True)

    def _silent_at(self) -> float:
        return self._heard_at + SILENCE_BEATS * self.heartbeat_s

    def _ping_at(self, both_ways: bool) -> float:
        """Ping after a silence; `both_ways` also beside pushes."""
        since = min(self._heard_at, self.asked_at) if both_ways else self._heard_at
        return since + self.heartbeat_s

    # -- steps: greeting ---------------------------------------------------------------------------
    def _send_handshake(self, request: w.Hello | w.Reattach, now: float) -> None:
        """Send hello or the reattachment, which come before any request."""
        self._handshake_id, self._handshake_at = next(self._ids), now
        self._phase_deadline = now + HELLO_TIMEOUT_S
        self.outgoing.append({**to_map(request), "id": self._handshake_id})

    def _handshake_reply(self, message: Message, now: float) -> None:
        if not message.get("ok"):
            error = from_wire(message.get("error") or {})
            if isinstance(error, UnknownSession):
                self.contact_lost("the arbiter forgot the session")
                return
            self.events.append(GreetingRefused(error))
            self._phase_deadline = now + REFUSED_RETRY_S
            return
        if self.phase == "greeting":
            welcome = from_map(WelcomeReply, message)
            self.epoch, self.role = int(message["epoch"]), welcome.role
            self.heartbeat_s, self.grace_s = welcome.heartbeat_s, welcome.grace_s
            if kept := self._above.reattachments():
                self.phase = "reattaching"
                self._send_handshake(w.Reattach(kept), now)
                return
        else:
            self._above.reattached(from_map(ReattachReply, message))
        self._come_up(now)

    def _come_up(self, now: float) -> None:
        self.phase = "up"
        self._phase_deadline = None
        assert self.epoch is not None
        self.events.append(Up(self.epoch))
        unanswered = list(self._pending.values())
        self._above.say_again(now)
        for request in unanswered:
            self._send(request, now)

    # -- steps: requests ---------------------------------------------------------------------------
    def _reply(self, message: Message, now: float) -> None:
        request_id = message.get("re")
        request = self._pending.get(request_id) if isinstance(request_id, int) else None
        if request is not None and request.sent_at is not None:
            self.asked_at = max(self.asked_at, request.sent_at)
        if message.get("ok"):
            if request is not None and isinstance(request_id, int):
                self._succeed(request_id, request, message, now)
            return
        error = from_wire(message.get("error") or {})
        if isinstance(error, UnknownSession):
            # the daemon restarted behind a socket that reconnected by itself
            self.contact_lost("the arbiter forgot the session")
        elif request is not None and isinstance(request_id, int):
            self._fail(request_id, error, now)

    def _succeed(self, request_id: int, request: Pending, message: Message, now: float) -> None:
        try:
            reply = from_map(w.REPLIES[type(request.request)], message)
        except CodecError as error:
            op = request.request.TAG[1]
            wrong = f"the arbiter's answer to {op} is not understood: {error}"
            self._fail(request_id, InternalError(wrong, hint="do both have the same version?"), now)
            return
        del self._pending[request_id]
        if request.on_reply is not None:
            request.on_reply(reply, now)
        if not request.quiet:
            self.events.append(Replied(request_id, reply))

    def _fail(self, request_id: int, error: VramError, now: float) -> None:
        request = self._pending.pop(request_id)
        if request.on_error is not None:
            request.on_error(error, now)
        if not request.quiet:
            self.events.append(Failed(request_id, error))

    def _send(self, pending: Pending, now: float) -> None:
        pending.sent_at = now
        trace = {} if pending.traceparent is None else {"traceparent": pending.traceparent}
        self.outgoing.append({**to_map(pending.request), **trace, "id": pending.id})


def _unreachable(request: w.Request[Any]) -> ArbiterUnreachable:
    return ArbiterUnreachable(
        f"the arbiter did not answer {request.TAG[1]} in time",
        hint="is it running? see `vramctl status`",
    )
