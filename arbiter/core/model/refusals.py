"""Refusals of the engine: one class per cause, with the values that explain it.

They hold codes and values only. Words are made in `arbiter.rpc.words`, so rewording a message
changes no decision and no replay. The fields are the `details` of the error on the wire.
"""

from enum import StrEnum
from typing import Literal

from vram_arbiter.schemas.wire.codes import Order, RevokeCause, Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.explained import Explanation


class Refused(Exception):
    """A request cannot be done; raised before anything has changed."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(repr(refusal))
        self.refusal = refusal


# -- sessions and tokens
class NoSession(Refusal, code="unknown_session"):
    """The connection has not said hello."""


class NoLease(Refusal, code="unknown_lease"):
    """No lease has this id."""

    lease_id: str


class WrongToken(Refusal, code="stale_token"):
    """`token` is what the request named, never the right one."""

    lease_id: str
    token: str


class NotHolder(Refusal, code="not_permitted"):
    """The lease belongs to another process."""

    lease_id: str
    pid: int


class CgroupTaken(Refusal, code="not_permitted"):
    """The cgroup overlaps with that of another process's lease."""

    cgroup: str
    lease_id: str
    consumer: str
    other: str


# -- states
class Misfit(StrEnum):
    """Why a request does not fit the state of its lease."""

    STILL_QUEUED = "still_queued"
    NOT_AWAY = "not_away"
    GRANTED = "granted"
    NOT_LOADING = "not_loading"
    NOT_HELD = "not_held"
    NOT_UNLOADABLE = "not_unloadable"
    IN_USE = "in_use"
    EXITS = "exits"
    NO_PARK_BYTES = "no_park_bytes"
    HOLDS_NOTHING = "holds_nothing"
    NOT_REATTACHED = "not_reattached"


class BadLeaseState(Refusal, code="bad_state"):
    """A holder's request does not fit the state of its lease; `story` lists its last steps."""

    lease_id: str
    state: str
    uses: int
    misfit: Misfit
    story: str


class Impractical(StrEnum):
    """Why an operator's action does not fit a lease."""

    NOT_RESIDENT = "not_resident"
    LEAVING = "leaving"
    NOT_HELD = "not_held"
    IN_USE = "in_use"
    OTHERS_USE = "others_use"
    PINNED_BY_OPERATOR = "pinned_by_operator"
    PINNED_BY_HOLDER = "pinned_by_holder"
    NOT_PINNED = "not_pinned"
    HOLDER_LIVES = "holder_lives"


class BadTargetState(Refusal, code="bad_state"):
    """An operator's action does not fit the lease; `silent_s`: since its holder was heard."""

    lease_id: str
    state: str
    problem: Impractical
    evictable: bool = True
    silent_s: float | None = None


class Ambiguous(Refusal, code="bad_request"):
    """An operator named a consumer without a lease, or with several."""

    target: str
    leases: tuple[str, ...]


class NoTarget(Refusal, code="unknown_lease"):
    """No lease and no consumer has this name."""

    target: str


class LeaseOver(Refusal, code="bad_state"):
    """A late message on a lease that ended in order; `revoked`: it was evicted."""

    lease_id: str
    state: str
    revoked: RevokeCause | None = None


class TargetOver(Refusal):
    """An operator named a lease that is over: the refusal that its holder would get, with `code` of
    that."""

    code: str  # type: ignore[misc]  # of `ended`
    ended: Refusal

    @classmethod
    def of(cls, ended: Refusal) -> "TargetOver":
        """Return the refusal of an operator's action on a lease that ended so."""
        return cls(ended.code, ended)


class Revoked(Refusal, code="lease_revoking"):
    """The holder is revoked, so no use begins."""

    consumer: str
    state: str
    revoked: RevokeCause | None = None


# -- bytes and places
class UnknownGpu(Refusal, code="unknown_gpu"):
    """The selector names no GPU."""

    gpu: str
    known: tuple[str, ...]


class TooLarge(Refusal, code="vram_insufficient"):
    """A request can never fit. `needed_bytes` exceeds `declared_bytes` where more was measured
    before."""

    consumer: str
    needed_bytes: int
    declared_bytes: int
    capacity_bytes: int
    reserve_bytes: int


class NoHostRam(Refusal, code="host_ram_insufficient"):
    """No room in host RAM for parked weights."""

    needed_bytes: int
    budget_bytes: int
    booked_bytes: int


type Limit = Literal["waiters_max", "leases_per_client_max", "uses_per_lease_max"]


class Share(StrEnum):
    """Whose share of limited places is used up."""

    CONNECTION = "connection"
    PROCESS = "process"
    USER = "user"
    ALL = "all"
    HOLDER = "holder"
    OTHERS = "others"  # than the holder


class LimitReached(Refusal, code="limit_exceeded"):
    """`count` places of a share are used, `value` are allowed; `uid` for the share of a user."""

    limit: Limit
    value: int
    share: Share
    count: int
    lease_id: str = ""
    uid: int | None = None


class LoadFails(Refusal, code="load_failing"):
    """The model died in its load `failures` times in a row; no holder is revoked for it for
    `retry_in_s`."""

    consumer: str
    model: str
    failures: int
    cause: str  # of the last failure, a code
    retry_in_s: float


# -- ends
class CancelledRequest(Refusal, code="cancelled"):
    """A request ended because of its own client. `by` is the reason of a client that left."""

    lease_id: str
    why: Why
    by: str = ""


class TimedOut(Refusal, code="wait_timeout"):
    """A request waited as long as it wanted to."""

    consumer: str
    waited_s: float
    why: Explanation


class Expired(Refusal, code="lease_expired"):
    """The lease was not renewed in time, or an operator gave its silent holder up."""

    lease_id: str
    ttl_s: float
    why: Why = Why.NOT_RENEWED
    order: Order | None = None


class Lost(Refusal, code="lease_lost"):
    """The lease is over, and its holder did not end it."""

    lease_id: str
    why: Why
    pid: int | None = None
    order: Order | None = None


type End = Lost | CancelledRequest
"""Why a lease without bytes ended."""


class NotJournaled(Refusal, code="journal_unavailable"):
    """The grant could not be written, so it does not take place."""

    lease_id: str
    key: str
    problem: str
