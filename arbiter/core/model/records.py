"""Records of the journal: what must survive the daemon, by key. Their limits are what a start
accepts (`host.records`); a field with a default may be missing in a record of an older daemon."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Final

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.limits import Limits
from vram_arbiter.schemas.wire.spec import LeaseSpec

Pid = Annotated[int, Limits(ge=1, le=1 << 30)]
Ticks = Annotated[int, Limits(ge=0, lt=1 << 62)]
Count = Annotated[int, Limits(ge=0, lt=1 << 62)]
Bytes = Annotated[int, Limits(ge=0, le=1 << 53)]
Text = Annotated[str, Limits(max_length=4 * d.REASON_MAX_CHARS)]
Id = Annotated[str, Limits(min_length=1, max_length=d.NAME_MAX_CHARS)]
Seconds = Annotated[float, Limits(ge=0, le=1e10, allow_inf_nan=False)]
State = Annotated[
    str, Limits(pattern="^(loading|held|revoking|unloading|verifying|parked|standby|debt)$")
]
type UserRecord = tuple[Pid, Ticks, Id, Text]
"""A use of another process: pid, start_ticks, use id, label."""

_LENIENT: Final = {"extra": "ignore"}


@dataclass(frozen=True, slots=True)
class LeaseRecord:
    """`lease:L3-17`: a lease that is resident, away, or over with its bytes still charged
    (`debt`)."""

    __pydantic_config__: ClassVar = _LENIENT

    lease_id: Id
    token: tuple[Count, Count]
    state: State
    gpu: Id | None
    pid: Pid
    start_ticks: Ticks
    nonce: Id
    charge_bytes: Bytes
    load_peak_bytes: Bytes
    measured_bytes: Bytes | None
    exiting: bool
    spec: LeaseSpec
    held_from: Seconds | None = None  # on the monotonic clock
    pinned: tuple[Text, Text] | None = None  # by whom, why
    users: Annotated[tuple[UserRecord, ...], Limits(max_length=1 << 17)] = ()
    comes_back: bool = False
    parks: bool = False
    parked_bytes: Bytes = 0
    left_for: Text = ""
    dismissed: bool = False


@dataclass(frozen=True, slots=True)
class ResidueRecord:
    """`residue:PID@START:GPU`: what a process keeps on a GPU without a lease."""

    __pydantic_config__: ClassVar = _LENIENT

    pid: Pid
    start_ticks: Ticks
    gpu: Id
    residue_bytes: Bytes
    floor_bytes: Bytes | None = None  # None: all of them


@dataclass(frozen=True, slots=True)
class DrainRecord:
    """`drain`: an operator's drain is in force after a restart too."""

    __pydantic_config__: ClassVar = _LENIENT

    by: Text
    reason: Text


@dataclass(frozen=True, slots=True)
class DoubtRecord:
    """`doubt`: why leases may be missing among the other records. It outlives restarts until the
    core deletes it, once each holder had its time to reattach."""

    __pydantic_config__: ClassVar = _LENIENT

    why: str


type AnyRecord = LeaseRecord | ResidueRecord | DrainRecord | DoubtRecord
