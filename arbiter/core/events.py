"""Everything that can happen to the core, as past-tense facts. Made by `rpc.session` (requests),
`host` (probes, deaths, journal) and `inbox` (time). Frozen; plain values only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from vram_arbiter.schemas.ids import (
    ClientId,
    GpuId,
    LeaseId,
    ModelKey,
    ProcessKey,
    RequestId,
    Token,
    UseId,
)

DOUBT_KEY: Final = "doubt"
"""Key of a journal record that says why leases may be missing among the others. It outlives
restarts until the core deletes it, once each holder had its time to reattach."""
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
class LeaseSpec:
    """A lease as asked for, validated (`schemas.wire.requests.LeaseSpec`)."""

    consumer: str
    key: ModelKey
    gpu: str
    exclusive: bool
    load_peak_bytes: int
    steady_bytes: int
    residue_bytes: int
    priority: int
    evictable: bool
    ttl_s: float
    min_residency_s: float
    deny_on_deadline: bool
    standby: bool = False
    park_bytes: int = 0
    on_overstay: str = "wait"  # or "terminate", "kill"
    independent: bool = False
    gang: tuple[str, int] | None = None  # (id, size)


@dataclass(frozen=True, slots=True)
class AcquireRequested:
    client: ClientId
    request: RequestId
    nonce: str
    spec: LeaseSpec
    wait_timeout_s: float | None
    traceparent: str | None = None


@dataclass(frozen=True, slots=True)
class ReadyReported:
    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    measured_bytes: int | None


@dataclass(frozen=True, slots=True)
class UseBegan:
    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    use: UseId
    label: str


@dataclass(frozen=True, slots=True)
class UseEnded:
    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    use: UseId


@dataclass(frozen=True, slots=True)
class UseYielded:
    """A use pauses: until it is begun again it prevents no eviction."""

    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    use: UseId


@dataclass(frozen=True, slots=True)
class Renewed:
    client: ClientId
    request: RequestId
    leases: tuple[tuple[LeaseId, Token], ...]


@dataclass(frozen=True, slots=True)
class RevokeAcknowledged:
    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    safe_point_eta_s: float | None


@dataclass(frozen=True, slots=True)
class UnloadStarted:
    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token


@dataclass(frozen=True, slots=True)
class ReleaseReported:
    """The holder let go. `exiting`: its process will end, so even the residue must come back."""

    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    exiting: bool
    parked: bool = False  # its weights are in host RAM


@dataclass(frozen=True, slots=True)
class CancelRequested:
    client: ClientId
    request: RequestId
    lease: LeaseId


@dataclass(frozen=True, slots=True)
class Reacquired:
    """A lease that is away is wanted now: from here on it is a waiter like any other."""

    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    wait_timeout_s: float | None
    traceparent: str | None = None


@dataclass(frozen=True, slots=True)
class ResizeAsked:
    """The holder gave bytes back, or needs more. `wait_timeout_s` bounds a growth's wait."""

    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    load_peak_bytes: int
    steady_bytes: int
    residue_bytes: int
    wait_timeout_s: float | None


@dataclass(frozen=True, slots=True)
class ReattachedLease:
    lease: LeaseId
    token: Token
    spec: LeaseSpec
    held: bool  # False: still loading
    measured_bytes: int | None
    uses: tuple[UseId, ...]
    away: bool = False  # on standby or parked
    parked: bool = False


@dataclass(frozen=True, slots=True)
class Reattached:
    client: ClientId
    request: RequestId
    leases: tuple[ReattachedLease, ...]


@dataclass(frozen=True, slots=True)
class OomReported:
    client: ClientId
    request: RequestId
    lease: LeaseId
    token: Token
    requested_bytes: int
    allocated_bytes: int | None


@dataclass(frozen=True, slots=True)
class OperatorAsked:
    """An operator wants something done by hand.

    `target` is a lease or a consumer ("" for drain and resume).
    """

    client: ClientId
    request: RequestId
    action: Literal["evict", "pin", "unpin", "drain", "resume", "release_dead"]
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

    def is_of(self, process: ProcessKey) -> bool:
        """Whether this entry is of that process, as far as the source can tell."""
        listed = self.process
        return listed == process or (listed.start_ticks == 0 and listed.pid == process.pid)


@dataclass(frozen=True, slots=True)
class MemorySampled:
    """One reading of one GPU. `taken_at` is the monotonic time at which the reading *began*.

    Every source tells the total. What else a reading tells is derived here and nowhere else
    (`host.gpu.probe` has the table of sources).
    """

    gpu: GpuId
    taken_at: float
    used_bytes: int
    total_bytes: int
    processes: tuple[ProcessUse, ...] | None  # None: this source cannot list processes

    @property
    def lists_processes(self) -> bool:
        return self.processes is not None

    @property
    def lists_bytes(self) -> bool:
        """Whether there is a list with the bytes of each process in it."""
        return self.processes is not None and all(
            use.used_bytes is not None for use in self.processes
        )

    @property
    def listed(self) -> tuple[ProcessUse, ...]:
        return self.processes or ()

    def bytes_of(self, process: ProcessKey) -> int | None:
        """Return the bytes of a process: 0 if the list omits it, None if the reading cannot tell.

        An omitted process may hold bytes: it may live in a container that the driver cannot name,
        or be dying.
        """
        if self.processes is None:
            return None
        use = self._use_of(process)
        return 0 if use is None else use.used_bytes

    def shows(self, process: ProcessKey) -> bool:
        """Whether the process is listed with its bytes."""
        use = self._use_of(process)
        return use is not None and use.used_bytes is not None

    def omits(self, process: ProcessKey) -> bool:
        """Whether there is a list without this process."""
        return self.processes is not None and self._use_of(process) is None

    def _use_of(self, process: ProcessKey) -> ProcessUse | None:
        for use in self.listed:
            if use.is_of(process):
                return use
        return None


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

    records: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Resumed:
    """The machine was suspended for `slept_s` in which the monotonic clock stood still. Comes
    before any other event of the new day."""

    slept_s: float


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
    | UseYielded
    | Renewed
    | RevokeAcknowledged
    | UnloadStarted
    | ReleaseReported
    | CancelRequested
    | Reacquired
    | ResizeAsked
    | Reattached
    | OomReported
    | OperatorAsked
    | MemorySampled
    | ProbeFailed
    | JournalFailed
    | Recovered
    | Resumed
    | Tick
)
