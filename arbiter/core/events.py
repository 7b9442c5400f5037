"""Everything that can happen to the core, as past-tense facts. Made by `rpc.session` (requests),
`host` (probes, deaths, journal) and `inbox` (time). Frozen; plain values only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from vram_arbiter.arbiter.core.model.records import AnyRecord
from vram_arbiter.schemas.ids import (
    ClientId,
    GpuId,
    LeaseId,
    ProcessKey,
    RequestId,
    Token,
    UseId,
)
from vram_arbiter.schemas.wire.spec import LeaseSpec

DOUBT_KEY: Final = "doubt"
"""Key of a journal record that says why leases may be missing among the others. It outlives
restarts until the core deletes it, once each holder had its time to reattach."""
DRAIN_KEY: Final = "drain"
"""Key of the journal record of an operator's drain: it is in force after a restart too."""
BYE: Final = "bye"
"""`ClientLeft.reason` of a connection that took its leave: only then are its resident leases
released."""


# -- clients
@dataclass(frozen=True, slots=True)
class ClientConnected:
    """A connection said hello. The pid and uid come from the kernel, never from the message."""

    client: ClientId
    process: ProcessKey
    uid: int
    name: str
    instance: str


@dataclass(frozen=True, slots=True)
class ClientLeft:
    """A connection said bye or was dropped for misconduct; its process may live on."""

    client: ClientId
    reason: str


@dataclass(frozen=True, slots=True)
class ProcessDied:
    """The kernel says that a process is gone (pidfd). Every client, lease and use of it ends."""

    process: ProcessKey


# -- requests
@dataclass(frozen=True, slots=True)
class ClientRequest:
    """A message that gets one answer."""

    client: ClientId
    request: RequestId


@dataclass(frozen=True, slots=True)
class LeaseRequest(ClientRequest):
    """One about a granted lease, which it names by its exact token."""

    lease: LeaseId
    token: Token


@dataclass(frozen=True, slots=True)
class AcquireRequested(ClientRequest):
    """A lease is wanted; a repeat with the same nonce is the same request."""

    nonce: str
    spec: LeaseSpec
    wait_timeout_s: float | None
    traceparent: str | None = None


@dataclass(frozen=True, slots=True)
class ReadyReported(LeaseRequest):
    """The model is loaded."""

    measured_bytes: int | None


@dataclass(frozen=True, slots=True)
class UseBegan(LeaseRequest):
    """A busy interval begins."""

    use: UseId
    label: str


@dataclass(frozen=True, slots=True)
class UseEnded(LeaseRequest):
    """A busy interval is over."""

    use: UseId


@dataclass(frozen=True, slots=True)
class Renewed(ClientRequest):
    """The holder lives."""

    leases: tuple[tuple[LeaseId, Token], ...]


@dataclass(frozen=True, slots=True)
class RevokeAcknowledged(LeaseRequest):
    """The holder heard that it is revoked."""

    safe_point_eta_s: float | None


@dataclass(frozen=True, slots=True)
class UnloadStarted(LeaseRequest):
    """The holder is at its safe point and unloads."""


@dataclass(frozen=True, slots=True)
class ReleaseReported(LeaseRequest):
    """The holder freed its memory. `exiting`: its process will end, so nothing may stay."""

    exiting: bool
    parked: bool = False  # its weights are in host RAM


@dataclass(frozen=True, slots=True)
class CancelRequested(ClientRequest):
    """A queued lease is not wanted any more."""

    lease: LeaseId


@dataclass(frozen=True, slots=True)
class Reacquired(LeaseRequest):
    """A lease that is away is wanted now: from here on it is a waiter like any other."""

    wait_timeout_s: float | None
    traceparent: str | None = None


@dataclass(frozen=True, slots=True)
class ReattachedLease:
    lease: LeaseId
    token: Token
    spec: LeaseSpec
    state: Literal["loading", "held", "standby", "parked"]
    measured_bytes: int | None
    uses: tuple[UseId, ...]


@dataclass(frozen=True, slots=True)
class Reattached(ClientRequest):
    """A client says after a restart what it still holds."""

    leases: tuple[ReattachedLease, ...]


@dataclass(frozen=True, slots=True)
class OomReported(LeaseRequest):
    """An allocation of the holder failed."""

    requested_bytes: int
    allocated_bytes: int | None


@dataclass(frozen=True, slots=True)
class OperatorAsked(ClientRequest):
    """An operator wants something done by hand.

    `target` is a lease or a consumer ("" for drain and resume).
    """

    action: Literal["evict", "kill", "pin", "unpin", "drain", "resume", "release_dead"]
    target: str
    by: str
    reason: str


# -- the machine
@dataclass(frozen=True, slots=True)
class ProcessUse:
    """Bytes of one process on one GPU: evidence, not authority. Where only a pid is known,
    `start_ticks` is 0."""

    process: ProcessKey
    name: str
    used_bytes: int | None  # None: the driver does not say

    @property
    def held_bytes(self) -> int:
        """Bytes shown; 0 where the driver does not say."""
        return self.used_bytes or 0


@dataclass(frozen=True, slots=True)
class MemorySampled:
    """One reading of one GPU. `taken_at` is the monotonic time at which the reading *began*.

    Every source tells the total. What else a reading tells is derived in `ledger` and nowhere else
    (`host.gpu.probe` has the table of sources).
    """

    gpu: GpuId
    taken_at: float
    used_bytes: int
    total_bytes: int
    processes: tuple[ProcessUse, ...] | None  # None: this source cannot list processes


@dataclass(frozen=True, slots=True)
class ProbeFailed:
    """A reading failed or hung. Unknown: it never counts as free."""

    gpu: GpuId
    at: float
    reason: str


@dataclass(frozen=True, slots=True)
class JournalFailed:
    """A record could not be written. `gates`: it was that of a grant, which has not been sent and
    is withdrawn."""

    key: str
    reason: str
    gates: bool = True


@dataclass(frozen=True, slots=True)
class Recovered:
    """First event after a restart on the same boot: the journal's records, by key. Empty journal:
    no such event."""

    records: Mapping[str, AnyRecord]


@dataclass(frozen=True, slots=True)
class Resumed:
    """The machine was suspended for `slept_s` in which the monotonic clock stood still. Comes
    before any other event of the new day."""

    slept_s: float


@dataclass(frozen=True, slots=True)
class SettingsChanged:
    """An operator changed constants: fields of `Settings` by name."""

    changed: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Tick:
    """`next_deadline()` has come."""


Event = (
    ClientConnected
    | ClientLeft
    | ProcessDied
    | AcquireRequested
    | ReadyReported
    | UseBegan
    | UseEnded
    | Renewed
    | RevokeAcknowledged
    | UnloadStarted
    | ReleaseReported
    | CancelRequested
    | Reacquired
    | Reattached
    | OomReported
    | OperatorAsked
    | MemorySampled
    | ProbeFailed
    | JournalFailed
    | Recovered
    | Resumed
    | SettingsChanged
    | Tick
)
