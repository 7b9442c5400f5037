"""Everything that can happen to the core, as past-tense facts. Made by `rpc.session` (requests),
`host` (probes, deaths, journal) and `inbox` (time). Frozen; plain values only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from vram_arbiter.arbiter.core.model.records import AnyRecord
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, RequestId
from vram_arbiter.schemas.wire.requests import AnyRequest

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
class Asked:
    """A client sent a request, which gets one answer. `operator` names the peer of an action by
    hand, by the kernel's word."""

    client: ClientId
    id: RequestId
    request: AnyRequest
    traceparent: str | None = None
    operator: str = ""


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
    | Asked
    | MemorySampled
    | ProbeFailed
    | JournalFailed
    | Recovered
    | Resumed
    | SettingsChanged
    | Tick
)
