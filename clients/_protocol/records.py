"""What the client's protocol reports to its owner, and what it keeps of leases, waits, requests and
uses. Plain data.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import VramError, from_wire
from vram_arbiter.schemas.ids import LeaseId, Token, UseId
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.pushes import RevokePush
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import LeaseView

OnError = Callable[[VramError, float], None]


def error_of(view: ErrorView | None) -> VramError:
    """Return the typed error; a lease that is gone without a word was lost."""
    return from_wire({"code": "lease_lost"} if view is None else to_map(view))


@dataclass(frozen=True, slots=True)
class Eviction:
    """Why the arbiter revokes a lease."""

    cause: str
    """`waiter`, `pressure` or `operator`; "" where the arbiter does not say."""
    by: str
    """The consumer that needs the room, or the operator with uid and pid; "" where there is
    neither."""
    reason: str
    """The same in words."""
    priority: int | None = None
    """Of the request that needs the room; None where there is none."""

    @classmethod
    def of(cls, push: RevokePush) -> "Eviction":
        by = push.wanted_by if push.order is None else push.order.by
        return cls(push.cause, by, push.reason, push.priority)


# -- events for the owner --------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Up:
    """Greeted and reattached; requests flow. `epoch` changes with every start of the daemon."""

    epoch: int


@dataclass(frozen=True, slots=True)
class ContactLost:
    """Open a fresh socket (the old one may still carry stale messages) and call `connected`."""

    reason: str


@dataclass(frozen=True, slots=True)
class GreetingRefused:
    """The arbiter refuses this client (version, role, limit)."""

    error: VramError


@dataclass(frozen=True, slots=True)
class Replied:
    request_id: int
    body: AnyReply


@dataclass(frozen=True, slots=True)
class Failed:
    request_id: int
    error: VramError


@dataclass(frozen=True, slots=True)
class Granted:
    nonce: str
    record: "LeaseRecord"


@dataclass(frozen=True, slots=True)
class Denied:
    nonce: str
    error: VramError


@dataclass(frozen=True, slots=True)
class RevokeAsked:
    """The arbiter asks for the room, or repeats it."""

    record: "LeaseRecord"
    push: RevokePush


@dataclass(frozen=True, slots=True)
class RevokeWithdrawn:
    """The holder may stay, if it has not begun to unload."""

    record: "LeaseRecord"


@dataclass(frozen=True, slots=True)
class Gone:
    """A lease that its holder did not end. `fenced`: this client ended it, and the arbiter may not
    know."""

    record: "LeaseRecord"
    error: VramError
    fenced: bool = False


@dataclass(frozen=True, slots=True)
class Returned:
    """A lease that was evicted is granted again, with a new token: load, then `ready`."""

    record: "LeaseRecord"


@dataclass(frozen=True, slots=True)
class UseLost:
    """A use on the lease of another process could not be resumed after a reconnect."""

    use_id: str
    error: VramError


@dataclass(frozen=True, slots=True)
class HistoryEvent:
    event: JsonMap


@dataclass(frozen=True, slots=True)
class PrepareAsked:
    """A hint: this consumer's model is wanted soon. `by`: the client that said so."""

    by: str


Event = (
    Up
    | ContactLost
    | GreetingRefused
    | Replied
    | Failed
    | Granted
    | Denied
    | RevokeAsked
    | RevokeWithdrawn
    | Gone
    | Returned
    | UseLost
    | HistoryEvent
    | PrepareAsked
)


# -- state -----------------------------------------------------------------------------------------
@dataclass(slots=True)
class LeaseRecord:
    """One granted lease, as this client knows it."""

    lease_id: LeaseId
    token: Token
    nonce: str
    spec: LeaseSpec
    ttl_s: float
    view: LeaseView
    confirmed_at: float  # when the last message that the arbiter confirmed was *sent*
    renewed_at: float
    held: bool = False  # False: still loading
    measured_bytes: int | None = None
    uses: set[UseId] = field(default_factory=set)
    revoke: RevokePush | None = None
    withdrawn: bool = False  # `revoke` is over; the lease stays if it has not begun to unload
    released: bool = False
    asleep: str = ""  # `standby` or `parked`: evicted, and may come back under the same id
    wanted: bool = False  # asleep, and reacquired
    wanted_until: float | None = None  # None: no limit
    wanted_by: str | None = None  # traceparent of the reacquire
    reacquire_id: int | None = None  # the newest request that asked for it

    def stays(self) -> None:
        """Forget the revoke that was withdrawn."""
        self.revoke, self.withdrawn = None, False

    def reattachment(self) -> w.ReattachLease:
        state: Any = self.asleep or ("held" if self.held else "loading")
        uses = tuple(sorted(self.uses))
        return w.ReattachLease(
            self.lease_id, self.token, self.spec, state, self.measured_bytes, uses
        )


@dataclass(slots=True)
class Waiter:
    """An acquire that is not granted yet."""

    nonce: str
    spec: LeaseSpec
    traceparent: str | None
    asked_at: float
    deadline: float | None
    lease_id: LeaseId | None = None
    request_id: int | None = None
    abandoned: bool = False


@dataclass(slots=True)
class Pending:
    """A request whose reply is not here yet; sent again after a reconnect."""

    request: w.Request[Any]
    id: int
    traceparent: str | None
    deadline: float
    sent_at: float | None = None
    on_reply: Callable[[Any, float], None] | None = None  # our own bookkeeping, before the owner's
    on_error: OnError | None = None
    quiet: bool = False  # its end is not reported


@dataclass(slots=True)
class ForeignUseRecord:
    """A use on the lease of another process; resumed after a reconnect."""

    request: w.UseBegin
    traceparent: str | None
    begun: bool = False
