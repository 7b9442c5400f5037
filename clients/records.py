"""What the client's protocol tells its owner, and the lease as the protocol remembers it. Plain data, no behaviour."""

from dataclasses import dataclass, field
from typing import Any

from schemas import defaults as d
from schemas.errors import VramError

Message = dict[str, Any]
TokenPair = tuple[int, int]


# -- what the owner is told -----------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Up:
    """Greeted and re-attached; requests flow. `epoch` changes with every start of the daemon."""

    epoch: int


@dataclass(frozen=True, slots=True)
class ContactLost:
    """Open a fresh socket (the old one may still carry stale messages) and call `connected`."""

    reason: str


@dataclass(frozen=True, slots=True)
class Refused:
    """The arbiter does not want this client (version, role, full)."""

    error: VramError


@dataclass(frozen=True, slots=True)
class Replied:
    request_id: int
    body: Message


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
    """Asked to leave, or told again; `record.server_uses` is what the arbiter counts now (None: it did not say)."""

    record: "LeaseRecord"
    push: Message
    first: bool


@dataclass(frozen=True, slots=True)
class Gone:
    """A lease that ended without our doing. `fenced`: we ended it, the arbiter may not know."""

    record: "LeaseRecord"
    error: VramError
    fenced: bool = False


@dataclass(frozen=True, slots=True)
class UseLost:
    """A use on somebody else's lease could not be renewed after a reconnect."""

    use_id: str
    error: VramError


@dataclass(frozen=True, slots=True)
class HistoryEvent:
    event: Message


Event = (
    Up
    | ContactLost
    | Refused
    | Replied
    | Failed
    | Granted
    | Denied
    | RevokeAsked
    | Gone
    | UseLost
    | HistoryEvent
)


# -- what it remembers ----------------------------------------------------------------------------------------------
@dataclass(slots=True)
class LeaseRecord:
    """One granted lease, as this client believes it."""

    lease_id: str
    token: TokenPair
    nonce: str
    spec: Message
    view: Message
    confirmed_at: float  # when the last message that the arbiter confirmed was *sent*
    renewed_at: float
    held: bool = False  # False: still loading
    measured_bytes: int | None = None
    uses: set[str] = field(default_factory=set)
    revoke: Message | None = None
    server_uses: int | None = None
    released: bool = False

    @property
    def ttl_s(self) -> float:
        return float(self.spec.get("ttl_s", d.LEASE_TTL_S))

    def ref(self) -> Message:
        """`schemas.wire.LeaseRef`."""
        return {"lease_id": self.lease_id, "token": list(self.token)}

    def reattachment(self) -> Message:
        """`schemas.wire.ReattachLease`."""
        return {
            **self.ref(),
            "spec": self.spec,
            "state": "held" if self.held else "loading",
            "measured_bytes": self.measured_bytes,
            "use_ids": sorted(self.uses),
        }
