"""One lease: its states, the one table of legal moves, and its story.

Knows nothing of bytes on a card (`ledger`), of order (`queue`) or of clients beyond their ids.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Literal, Protocol

from vram_arbiter.arbiter.core.events import MemorySampled, Spec
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId


class LeaseState(StrEnum):
    """Where a lease is. The words are those of the wire."""

    __hash__ = (
        str.__hash__
    )  # Enum's own is written in Python, and states are looked up all the time

    QUEUED = "queued"
    LOADING = "loading"
    HELD = "held"
    REVOKING = "revoking"
    UNLOADING = "unloading"
    VERIFYING = "verifying"
    PARKED = "parked"  # away, its weights are in host RAM
    STANDBY = "standby"  # asked to leave, away, comes back by itself when there is room
    RELEASED = "released"
    EXPIRED = "expired"
    LOST = "lost"
    DENIED = "denied"
    CANCELLED = "cancelled"


_S = LeaseState
_GONE = {_S.EXPIRED, _S.LOST}

TRANSITIONS: Mapping[LeaseState, frozenset[LeaseState]] = MappingProxyType(
    {
        # released from queued: a growth that was merged into its lease
        _S.QUEUED: frozenset({_S.LOADING, _S.DENIED, _S.CANCELLED, _S.RELEASED}),
        # denied from loading: the grant could not be journalled, so it was never sent
        _S.LOADING: frozenset({_S.HELD, _S.VERIFYING, _S.DENIED, *_GONE}),
        _S.HELD: frozenset({_S.REVOKING, _S.UNLOADING, _S.VERIFYING, *_GONE}),
        _S.REVOKING: frozenset({_S.UNLOADING, _S.VERIFYING, *_GONE}),
        _S.UNLOADING: frozenset({_S.VERIFYING, *_GONE}),
        _S.VERIFYING: frozenset({_S.RELEASED, _S.PARKED, _S.STANDBY}),
        _S.PARKED: frozenset({_S.LOADING, _S.QUEUED, _S.CANCELLED, _S.LOST}),
        _S.STANDBY: frozenset({_S.LOADING, _S.QUEUED, _S.CANCELLED, _S.LOST}),
        _S.RELEASED: frozenset(),
        _S.EXPIRED: frozenset(),
        _S.LOST: frozenset(),
        _S.DENIED: frozenset(),
        _S.CANCELLED: frozenset(),
    }
)
"""State → states that may follow. Everything else is illegal."""

LEAVING = frozenset({_S.REVOKING, _S.UNLOADING, _S.VERIFYING})
AWAY = frozenset({_S.PARKED, _S.STANDBY})
"""States of a lease that lives on without bytes on a card: nobody renews it, it waits for nothing with a bound."""
EXPIRING = frozenset({_S.LOADING, _S.HELD, _S.REVOKING, _S.UNLOADING})
"""States that a holder must renew."""
NONCES_MAX = 8
"""Acquires remembered of a lease that is taken over again and again; an older repeat would be a new acquire."""
STORY_MAX = 32
"""Steps remembered of a lease; one that goes and comes back lives long."""


class IllegalTransition(Exception):
    """A move that the table forbids. The lease is unchanged; the message carries its story."""

    def __init__(self, lease: "Lease", to: LeaseState) -> None:
        super().__init__(f"{lease.id}: {lease.state} → {to} is not legal; story: {lease.told()}")
        self.lease_id = lease.id


@dataclass(frozen=True, slots=True)
class Use:
    """A busy interval. It ends with the client that marked it at the latest; "": it is from the journal, and not said again yet."""

    id: UseId
    client: ClientId
    process: ProcessKey
    label: str
    began_at: float


@dataclass(frozen=True, slots=True)
class Order:
    """An operator's word: who gave it (name, uid, pid) and why."""

    by: str
    reason: str

    def __str__(self) -> str:
        return f"{self.by}: {self.reason}" if self.reason else self.by


Cause = Literal["waiter", "pressure", "operator"]
"""Why a holder is revoked: for a request, because the GPU holds more than its budget, or by hand."""


@dataclass(slots=True)
class Eviction:
    """One holder's way out, from the first `revoke` to the verdict. Times are monotonic seconds."""

    lease: LeaseId
    consumer: str
    charge_bytes: int
    wanted_by: LeaseId | None  # None: nobody waits, the card is under pressure
    wanted_consumer: str
    reason: str
    cause: Cause
    asked_at: float
    next_push_at: float
    acked_at: float | None = None
    safe_point_eta_s: float | None = None
    reminded: bool = False
    overdue: bool = False  # the ladder's deadline has passed
    signalled: str = ""  # what was sent to its process: "", "term" or "kill"
    unloading_at: float | None = None
    released_at: float | None = None
    verdict_at: float | None = None
    verdict: str = ""
    order: Order | None = None  # an operator wanted it
    # of whoever waits: goes with every `revoke`, so that the unloading is seen where it is waited for
    traceparent: str | None = None


@dataclass(frozen=True, slots=True)
class Failures:
    """Loads of one consumer with one model that failed in a row (`crashes`)."""

    count: int
    last_at: float
    cause: str  # of the last


class Roster(Protocol):
    """A table that is kept by state (`residents`)."""

    def moved(self, lease: "Lease", before: LeaseState) -> None: ...


@dataclass(frozen=True, slots=True)
class Recall:
    """A wait that begins when the lease is measured away."""

    asked_at: float
    wait_timeout_s: float | None


@dataclass(slots=True)
class Lease:
    """A live lease. `load_peak_bytes` is the spec's, raised by what was learnt; the spec itself is never changed."""

    id: LeaseId
    nonce: str  # of the acquire that it answers to; a lease that is taken over has had others
    spec: Spec
    process: ProcessKey
    client: ClientId
    arrived_at: float
    arrival: int  # strictly increasing, breaks ties
    load_peak_bytes: int
    steady_bytes: int
    gpus: tuple[GpuId, ...]  # where it may be placed
    state: LeaseState = LeaseState.QUEUED
    since: float = 0.0
    uid: int = (
        -1
    )  # of its process when it asked; -1: it came from the journal, and has not asked since
    token: Token | None = None
    gpu: GpuId | None = None
    measured_bytes: int | None = None
    peak_seen_bytes: int = 0  # largest reading while it loaded
    grew_at: float = 0.0  # when that last rose
    steady_seen_bytes: int = 0  # largest reading, or the holder's word, since it is ready
    drifted: set[str] = field(
        default_factory=set
    )  # parts of the footprint that a note was said about
    uses: dict[tuple[ProcessKey, UseId], Use] = field(default_factory=dict)  # busy ones
    yielded: dict[tuple[ProcessKey, UseId], Use] = field(
        default_factory=dict
    )  # pausing: nobody waits
    granted_at: float = 0.0
    held_from: float = (
        0.0  # the grant as people count it: a restart of the daemon does not change it
    )
    ready_at: float = 0.0
    last_used_at: float = 0.0
    expires_at: float = 0.0
    wait_timeout_s: float | None = None
    request: RequestId | None = (
        None  # the acquire that is not answered yet, or was answered `loading`
    )
    answered: bool = False
    exiting: bool = False
    attached: bool = True  # False after a restart until its holder has come back
    traceparent: str | None = None
    baseline: MemorySampled | None = None  # the card as it was when the unloading began
    earlier_nonces: deque[str] = field(default_factory=lambda: deque(maxlen=NONCES_MAX))
    reason: str = ""  # why it waits, in words; for people
    planned_gpu: GpuId | None = None  # a card where somebody was asked to leave for it
    pinned: Order | None = None  # by an operator
    parks: bool = False  # it let go with its weights kept in host RAM
    comes_back: bool = False  # by itself, once its bytes are measured gone and there is room
    hangs: bool = False  # its unloading has taken a whole deadline: nobody counts on it any more
    asked_before: bool = (
        False  # to leave, by a daemon that has ended since; its holder may be acting on it
    )
    dismissed: bool = False  # an operator sent it away: it does not come back by itself
    left_for: str = ""  # the consumer that it left for last; it does not come back beside that one
    away_since: float = 0.0
    uncalled: bool = False  # it came back by itself and nobody has used it since
    returned: bool = False  # it was granted because it came back by itself
    recalled: Recall | None = None  # its holder wants it back before it is gone
    extends: LeaseId | None = None  # a request for more bytes of that resident lease
    eviction: Eviction | None = None
    evicted: list[Eviction] = field(default_factory=list)  # who left for it
    story: list[tuple[float, LeaseState, str]] = field(
        default_factory=list
    )  # the last STORY_MAX steps
    rank: float | None = None  # a place in the queues that a feature gave it
    needs: Mapping[ProcessKey, int] | None = None  # of a group of requests that count as one
    roster: Roster | None = field(
        default=None, repr=False, compare=False
    )  # of the card that it is on

    def move(self, to: LeaseState, now: float, why: str) -> None:
        """Go to another state. Raises IllegalTransition, and then nothing has changed."""
        if to not in TRANSITIONS[self.state]:
            raise IllegalTransition(self, to)
        before, self.state = self.state, to
        self.since = now
        self.story.append((now, to, why))
        del self.story[:-STORY_MAX]
        if self.roster is not None:
            self.roster.moved(self, before)

    def told(self) -> str:
        """The story in one line."""
        return "; ".join(f"{at:.3f} {state} ({why})" for at, state, why in self.story) or "new"

    def priority_at(self, now: float, ageing_s_per_point: float) -> int:
        """Priority with one point for every `ageing_s_per_point` waited."""
        return self.spec.priority + int(max(0.0, now - self.arrived_at) / ageing_s_per_point)

    @property
    def in_use(self) -> bool:
        """Whether a use is in flight."""
        return bool(self.uses)

    def users(self) -> list[Use]:
        """Return the oldest in-flight use of each process but the holder: what the journal keeps.

        The holder reports its own uses when it reattaches, and is not revoked before.
        """
        oldest: dict[ProcessKey, Use] = {}
        for use in self.uses.values():
            oldest.setdefault(use.process, use)
        oldest.pop(self.process, None)
        return list(oldest.values())

    def all_uses(self) -> list[Use]:
        """Busy and pausing ones."""
        return [*self.uses.values(), *self.yielded.values()]

    @property
    def evictable(self) -> bool:
        """May it be asked to leave at all? Its holder and an operator can forbid it."""
        return self.spec.evictable and self.pinned is None

    @property
    def residue_bytes(self) -> int:
        """What its process is expected to keep after unloading."""
        return 0 if self.exiting else self.spec.residue_bytes
