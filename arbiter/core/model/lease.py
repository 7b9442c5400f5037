"""One lease: its states, the one table of its legal moves, and its records from the request to the
verdict.

In the order of a life: `Request`, `Lease` (`Uses`, `Observed`), `Departure` (`Eviction`), and
`Verification`.
Knows nothing of charges (`ledger`), of order (`gpu`) or of clients beyond their ids.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire.codes import Order, RevokeCause, Wait
from vram_arbiter.schemas.wire.spec import LeaseSpec


class LeaseState(StrEnum):
    """Where a lease is. The words are those of the wire."""

    # Enum's own is written in Python, and states are looked up all the time
    __hash__ = str.__hash__

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
        _S.QUEUED: frozenset({_S.LOADING, _S.DENIED, _S.CANCELLED}),
        # denied from loading: the grant could not be journalled, so it was never sent
        _S.LOADING: frozenset({_S.HELD, _S.VERIFYING, _S.DENIED, *_GONE}),
        _S.HELD: frozenset({_S.REVOKING, _S.UNLOADING, _S.VERIFYING, *_GONE}),
        _S.REVOKING: frozenset({_S.HELD, _S.UNLOADING, _S.VERIFYING, *_GONE}),
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

LEAVING = (_S.REVOKING, _S.UNLOADING, _S.VERIFYING)
AWAY = frozenset({_S.PARKED, _S.STANDBY})
"""States of a lease that lives on without bytes on a GPU: it needs no renewal, and waits for
nothing with a bound.
"""
EXPIRING = frozenset({_S.LOADING, _S.HELD, _S.REVOKING, _S.UNLOADING})
"""States that a holder must renew."""
NONCES_MAX = 8
"""Acquires remembered of a lease that is taken over again and again; an older repeat would be a new
acquire."""
STORY_MAX = 32
"""Steps remembered of a lease; one that goes and comes back lives long."""


class IllegalTransition(Exception):
    """A move that the table forbids. The lease is unchanged; the message carries its story."""

    def __init__(self, lease: "Lease", to: LeaseState) -> None:
        super().__init__(f"{lease.id}: {lease.state} → {to} is not legal; story: {lease.told()}")
        self.lease_id = lease.id


@dataclass(frozen=True, slots=True)
class Use:
    """A busy interval. It ends with the client that marked it at the latest; "": it is from the
    journal, and not said again yet."""

    id: UseId
    client: ClientId
    process: ProcessKey
    label: str
    began_at: float


@dataclass(slots=True)
class Eviction:
    """One holder's way out, from the first `revoke` to the verdict. Times are monotonic seconds."""

    lease: LeaseId
    consumer: str
    charge_bytes: int
    wanted_by: LeaseId | None  # the waiter
    why: RevokeCause
    asked_at: float
    next_push_at: float
    acked_at: float | None = None
    reminded: bool = False
    overdue: bool = False  # the ladder's deadline has passed
    unloading_at: float | None = None
    released_at: float | None = None
    verdict_at: float | None = None
    verdict: str = ""
    traceparent: str | None = None  # of the waiter, whose trace shows the unloading


@dataclass(slots=True)
class Request:
    """How a lease was last asked for, and how that waits. A reacquire replaces what it changes."""

    nonce: str  # of the acquire; a repeat with the same nonce is the same request
    arrived_at: float
    arrival: int  # strictly increasing, breaks ties
    load_peak_bytes: int  # of the spec, or more where more was learned
    steady_bytes: int
    gpus: tuple[GpuId, ...] = ()  # candidates
    uid: int = -1  # of the process; -1: recovered, and not asked again since
    id: RequestId | None = None  # of the message to be answered; None: told by push
    wait_timeout_s: float | None = None
    traceparent: str | None = None
    reason: Wait | None = None  # why it waits
    planned_gpu: GpuId | None = None  # where holders were revoked for it
    evicted: list[Eviction] = field(default_factory=list)  # made room for it
    earlier_nonces: deque[str] = field(default_factory=lambda: deque(maxlen=NONCES_MAX))


@dataclass(slots=True)
class Departure:
    """How a lease leaves its GPU. Empty while it stays."""

    eviction: Eviction | None = None  # None: it was not revoked
    revoked_before: bool = False  # withdrawn, or by an earlier daemon; the holder may act on it
    baseline: MemorySampled | None = None  # the GPU when the unloading began
    hangs: bool = False  # the unloading has taken a whole deadline, its bytes are not counted on
    exiting: bool = False  # its process ends, so it keeps nothing


@dataclass(slots=True)
class Observed:
    """Bytes of a lease by its holder's word and by readings (`learning`)."""

    reported_bytes: int | None = None  # by the holder
    peak_bytes: int = 0  # largest reading while it loaded
    grew_at: float = 0.0  # when that last rose
    steady_bytes: int = 0  # largest reading or report since it is ready
    drifted: set[str] = field(default_factory=set)  # parts of the footprint that were noted


class Uses(dict[tuple[ProcessKey, UseId], Use]):
    """Uses in flight of one lease, oldest first."""

    def __init__(self) -> None:
        super().__init__()
        self.last_at = 0.0
        """When a use last began or ended, or the lease became ready."""
        self.unclaimed = False
        """The lease came back by itself and was not used since: it has no minimum residency."""


@dataclass(slots=True)
class Standby:
    """How a lease leaves its GPU and lives on without bytes, and how it comes back (`standby`)."""

    left_for: str = ""  # consumer that it was last revoked for
    dismissed: bool = False  # an operator evicted it: it does not come back by itself
    comes_back: bool = False  # by itself, once its bytes are measured gone and there is room
    parks: bool = False  # its weights stay in host RAM
    since: float = 0.0  # when it was measured away
    recalled_at: float | None = None  # its holder wants it back before it is away
    returned: bool = False  # it came back by itself the last time


RECOVERED = frozenset({_S.LOADING, _S.HELD, _S.UNLOADING, _S.VERIFYING, *AWAY})
"""States in which a restart may find a lease, by the journal or by its holder's word."""


@dataclass(slots=True)
class Lease:
    """A lease from its request to its end. The spec is what was asked for."""

    id: LeaseId
    spec: LeaseSpec
    process: ProcessKey
    client: ClientId
    request: Request
    state: LeaseState = LeaseState.QUEUED
    token: Token | None = None
    gpu: GpuId | None = None
    uses: Uses = field(default_factory=Uses)
    granted_at: float = 0.0
    held_from: float = 0.0  # the grant by the clock of people: a restart does not change it
    ready_at: float = 0.0
    expires_at: float = 0.0
    attached: bool = True  # False after a restart until its holder reattached
    pinned: Order | None = None  # by an operator
    departure: Departure = field(default_factory=Departure)
    standby: Standby = field(default_factory=Standby)
    observed: Observed = field(default_factory=Observed)
    story: list[tuple[float, LeaseState, str]] = field(default_factory=list)  # last STORY_MAX steps

    @classmethod
    def recovered(cls, record: LeaseRecord, request: Request, now: float, why: str) -> "Lease":
        """Return the lease of a record, in one of the states RECOVERED; no other way leads past the
        table. Its holder has to reattach."""
        revoked = record.state == "revoking"
        state = LeaseState("held" if revoked or record.state == "debt" else record.state)
        assert state in RECOVERED, f"{record.lease_id} cannot be found {state}"
        lease = cls(
            id=LeaseId(record.lease_id),
            spec=record.spec,
            process=ProcessKey(record.pid, record.start_ticks),
            client=ClientId(""),
            request=request,
            state=state,
            token=Token(*record.token),
            gpu=None if record.gpu is None else GpuId(record.gpu),
            granted_at=now,
            held_from=now if record.held_from is None else min(now, record.held_from),
            ready_at=now,
            attached=False,
            pinned=None if record.pinned is None else Order(*record.pinned),
            departure=Departure(revoked_before=revoked, exiting=record.exiting),
            standby=Standby(
                left_for=record.left_for,
                dismissed=record.dismissed,
                comes_back=record.comes_back,
                parks=record.parks,
                since=now,
            ),
            observed=Observed(record.measured_bytes),
            story=[(now, state, why)],
        )
        lease.uses.last_at = now
        return lease

    def record(
        self, charge_bytes: int, parked_bytes: int = 0, *, debt: bool = False
    ) -> LeaseRecord:
        """Return the record of a lease that is resident, away, or over with its bytes still charged
        (`debt`). `parked_bytes`: host RAM that is booked for its weights."""
        assert self.token is not None, f"{self.id} is recorded without a token"
        state = "debt" if debt else self.state.value
        if not debt and self.departure.revoked_before and self.state is LeaseState.HELD:
            state = "revoking"  # and not by this daemon yet
        return LeaseRecord(
            lease_id=self.id,
            token=(self.token.epoch, self.token.serial),
            state=state,
            gpu=self.gpu,
            pid=self.process.pid,
            start_ticks=self.process.start_ticks,
            nonce=self.request.nonce,
            charge_bytes=charge_bytes,
            load_peak_bytes=self.request.load_peak_bytes,
            measured_bytes=self.observed.reported_bytes,
            exiting=self.departure.exiting,
            spec=self.spec,
            held_from=self.held_from,
            pinned=None if self.pinned is None else (self.pinned.by, self.pinned.reason),
            users=tuple([(*use.process, use.id, use.label) for use in self.users()]),
            comes_back=self.standby.comes_back,
            parks=self.standby.parks,
            parked_bytes=parked_bytes,
            left_for=self.standby.left_for,
            dismissed=self.standby.dismissed,
        )

    def move(self, to: LeaseState, now: float, why: str) -> None:
        """Go to another state. Raises IllegalTransition, and then nothing has changed."""
        if to not in TRANSITIONS[self.state]:
            raise IllegalTransition(self, to)
        self.state = to
        self.story.append((now, to, why))
        del self.story[:-STORY_MAX]

    @property
    def since(self) -> float:
        """When it came to its state."""
        return self.story[-1][0] if self.story else self.request.arrived_at

    def told(self) -> str:
        """The story in one line."""
        return "; ".join(f"{at:.3f} {state} ({why})" for at, state, why in self.story) or "new"

    def priority_at(self, now: float, ageing_s_per_point: float) -> int:
        """Priority with one point for every `ageing_s_per_point` waited."""
        return self.spec.priority + int(
            max(0.0, now - self.request.arrived_at) / ageing_s_per_point
        )

    def users(self) -> list[Use]:
        """Return the oldest in-flight use of each process but the holder: what the journal keeps.

        The holder reports its own uses when it reattaches, and is not revoked before.
        """
        oldest: dict[ProcessKey, Use] = {}
        for use in self.uses.values():
            oldest.setdefault(use.process, use)
        oldest.pop(self.process, None)
        return list(oldest.values())

    @property
    def next_state(self) -> LeaseState | None:
        """Where a released lease is, or goes after its verdict; None: it is over then."""
        if self.state in AWAY:
            return self.state
        if self.standby.parks:
            return LeaseState.PARKED
        return LeaseState.STANDBY if self.standby.comes_back else None

    @property
    def evictable(self) -> bool:
        """May it be asked to leave at all? Its holder and an operator can forbid it."""
        return self.spec.evictable and self.pinned is None

    @property
    def residue_bytes(self) -> int:
        """What its process is expected to keep after unloading."""
        return 0 if self.departure.exiting else self.spec.footprint.residue_bytes


# -- after the release
class Verdict(StrEnum):
    """Outcome of a verification, in the words of the wire."""

    VERIFIED = "verified"
    RESIDUE = "residue"
    CONTESTED = "contested"
    STALE = "stale"
    UNVERIFIABLE = "unverifiable"


@dataclass(slots=True)
class Verification:
    """A lease, or retained bytes of a dead process, under measurement. Times are monotonic."""

    key: str
    process: ProcessKey
    lease: LeaseId | None  # None: retained bytes of a dead process
    consumer: str
    model: str  # name under which its footprint is learned
    retained_bytes: int  # may stay; 0 once the process is dead
    baseline: MemorySampled | None  # newest reading in which the bytes were still there
    baseline_comparable: bool  # the lease was resident and ready when the baseline was taken
    confirmed_at: float  # only readings that began later count
    not_before: float  # no verdict earlier: a lost holder may load until it fences itself
    # the clock: since when the memory may return (polls are dense first, then rarer), and how long
    paced_from: float = 0.0
    deadline_at: float = 0.0
    next_poll_at: float = 0.0
    alive: bool = True
    vanishes: bool = False  # the process is dead or about to exit, so that nothing may stay
    exclusive: bool = False  # no grant before these bytes are gone, even if it would fit
    fenced_at: float = 0.0  # until then a living holder may use its lease
    last_used_bytes: int | None = None  # of the newest counting reading
    verdict: Verdict | None = None  # announced, but not resolved
    overdue: bool = False
