"""Notes: what happened, as history, subscribers, telemetry, the log and replays learn it.

One class for each kind, with typed fields and no words; `AnyNote` lists them all. A note about a
lease goes with `About`. `arbiter.rpc.words` makes the event of both: `{"kind", "lease_id"?,
"consumer"?, "gpu"?, "traceparent"?, …, "reason"?}`. A field that has its default is left out.
Standard library only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, Literal, get_args

from vram_arbiter.schemas.ids import GpuId, LeaseId, UseId
from vram_arbiter.schemas.wire.codes import Cause, Order, Wait, Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.views import BlockView

_CODE: Final = {"part": "code"}
"""An event has the code of a refusal, and its words as `reason`."""


@dataclass(frozen=True, slots=True)
class About:
    """The lease that a note is about. `lease_id` None: a dead process without a lease."""

    lease_id: LeaseId | None
    consumer: str
    gpu: GpuId | None
    traceparent: str | None = None


# -- waiting and granting
@dataclass(frozen=True, slots=True)
class QueuedNote:
    """A request waits."""

    TAG: ClassVar = ("kind", "queued")

    position: int | None
    wait: Wait | None
    behind: str  # consumer of the request before it
    block: BlockView | None = None  # why nothing is granted on its GPU


@dataclass(frozen=True, slots=True)
class GrantedNote:
    TAG: ClassVar = ("kind", "granted")

    charge_bytes: int
    waited_ms: float
    evicted: tuple[str, ...]  # consumers
    by_itself: bool = False  # back from standby, without an acquire


@dataclass(frozen=True, slots=True)
class ReadyNote:
    """The holder has loaded."""

    TAG: ClassVar = ("kind", "ready")

    charge_bytes: int
    declared_bytes: int
    measured_bytes: int | None
    load_ms: float


@dataclass(frozen=True, slots=True)
class EvictedLease:
    """A lease that was evicted for another one."""

    consumer: str
    lease_id: LeaseId
    verdict: str
    charge_bytes: int


@dataclass(frozen=True, slots=True)
class SwitchNote:
    """Time of a grant from the acquire to `ready`, by phase; it comes with each `ready`. Of several
    victims the slowest counts. `switched`: a lease was evicted for it."""

    TAG: ClassVar = ("kind", "switch")

    switched: bool
    evicted: tuple[EvictedLease, ...]
    verified: bool
    wait_ms: float
    drain_ms: float
    unload_ms: float
    verify_ms: float
    load_ms: float
    total_ms: float


@dataclass(frozen=True, slots=True)
class DeniedNote:
    """A request that waited, or a grant that could not be recorded, is over."""

    TAG: ClassVar = ("kind", "denied")

    refusal: Refusal = field(metadata=_CODE)


@dataclass(frozen=True, slots=True)
class RefusedNote:
    """A request for bytes was refused at once. `left_out`: refusals of the same process that were
    not noted."""

    TAG: ClassVar = ("kind", "refused")

    pid: int
    refusal: Refusal = field(metadata=_CODE)
    consumer: str = ""  # of an acquire, which has no lease
    left_out: int = 0


@dataclass(frozen=True, slots=True)
class CancelledNote:
    TAG: ClassVar = ("kind", "cancelled")

    why: Why
    by: str = ""


# -- uses
@dataclass(frozen=True, slots=True)
class UseBeganNote:
    TAG: ClassVar = ("kind", "use_began")

    use_id: UseId
    label: str
    uses: int
    resumed: bool


@dataclass(frozen=True, slots=True)
class UseEndedNote:
    TAG: ClassVar = ("kind", "use_ended")

    use_id: UseId
    label: str
    ms: float
    why: Why
    by: str = ""


# -- leaving
@dataclass(frozen=True, slots=True)
class RevokeAskedNote:
    """A holder is revoked for the first time."""

    TAG: ClassVar = ("kind", "revoke_asked")

    wanted_by: str  # consumer of the waiter
    wanted_by_lease: LeaseId | None
    uses: int
    cause: Cause
    order: Order | None = None


@dataclass(frozen=True, slots=True)
class RevokeWithdrawnNote:
    """A revoke ends without an eviction: nothing wants the bytes any more."""

    TAG: ClassVar = ("kind", "revoke_withdrawn")

    wanted_by: str  # consumer of the waiter that is gone
    cause: Cause
    uses: int
    ms: float  # since the revoke


@dataclass(frozen=True, slots=True)
class RevokeAckedNote:
    TAG: ClassVar = ("kind", "revoke_acked")

    safe_point_eta_s: float | None
    uses: int


@dataclass(frozen=True, slots=True)
class RemindedNote:
    TAG: ClassVar = ("kind", "reminded")

    uses: int
    acked: bool


@dataclass(frozen=True, slots=True)
class DeadlinePassedNote:
    TAG: ClassVar = ("kind", "deadline_passed")

    uses: int
    wanted_by: str


@dataclass(frozen=True, slots=True)
class SignalledNote:
    """An operator ended the process of a holder."""

    TAG: ClassVar = ("kind", "signalled")

    signal: Literal["term", "kill"]
    pid: int
    by: str
    reason: str


@dataclass(frozen=True, slots=True)
class UnloadingNote:
    TAG: ClassVar = ("kind", "unloading")

    asked: bool


@dataclass(frozen=True, slots=True)
class ReleasedNote:
    TAG: ClassVar = ("kind", "released")

    exiting: bool
    was: str  # its state before
    why: Why


@dataclass(frozen=True, slots=True)
class ExpiredNote:
    TAG: ClassVar = ("kind", "expired")

    why: Why
    ttl_s: float


@dataclass(frozen=True, slots=True)
class LostNote:
    TAG: ClassVar = ("kind", "lost")

    why: Why
    pid: int | None = None


@dataclass(frozen=True, slots=True)
class Culprit:
    """A process that holds bytes which a lease gave up."""

    pid: int
    name: str
    bytes: int


@dataclass(frozen=True, slots=True)
class VerifiedNote:
    """A verdict. `resolved` False: the verification goes on."""

    TAG: ClassVar = ("kind", "verified")

    verdict: str
    resolved: bool
    ms: float
    before_bytes: int | None
    after_bytes: int | None
    residue_bytes: int
    culprits: tuple[Culprit, ...]


# -- standby
@dataclass(frozen=True, slots=True)
class StandbyNote:
    """A lease is away. `comes_back`: by itself."""

    TAG: ClassVar = ("kind", "standby")

    left_for: str
    parked_bytes: int
    comes_back: bool


@dataclass(frozen=True, slots=True)
class ParkedNote:
    """A lease is away, its weights are in host RAM. `comes_back`: by itself."""

    TAG: ClassVar = ("kind", "parked")

    left_for: str
    parked_bytes: int
    comes_back: bool


# -- measurements
@dataclass(frozen=True, slots=True)
class OomNote:
    TAG: ClassVar = ("kind", "oom")

    requested_bytes: int
    allocated_bytes: int | None
    charge_bytes: int
    learnt_load_peak_bytes: int | None


@dataclass(frozen=True, slots=True)
class DriftNote:
    """A footprint is not what was declared. Said once for a lease and part."""

    TAG: ClassVar = ("kind", "drift")

    part: str
    declared_bytes: int
    measured_bytes: int
    drift_bytes: int


@dataclass(frozen=True, slots=True)
class OverHolder:
    """A process that holds more than its charge."""

    pid: int
    over_bytes: int


@dataclass(frozen=True, slots=True)
class PressureNote:
    """A GPU holds more than its budget, or (0 bytes) no longer does."""

    TAG: ClassVar = ("kind", "pressure")

    gpu: GpuId
    pressure_bytes: int
    stowaway_bytes: int
    holders: tuple[OverHolder, ...]


@dataclass(frozen=True, slots=True)
class StowawayNote:
    TAG: ClassVar = ("kind", "stowaway")

    gpu: GpuId
    pid: int
    name: str
    used_bytes: int


@dataclass(frozen=True, slots=True)
class ProbeFailedNote:
    TAG: ClassVar = ("kind", "probe_failed")

    gpu: GpuId
    reason: str


@dataclass(frozen=True, slots=True)
class ProbeOkNote:
    TAG: ClassVar = ("kind", "probe_ok")

    gpu: GpuId


# -- the daemon
@dataclass(frozen=True, slots=True)
class JournalFailedNote:
    TAG: ClassVar = ("kind", "journal_failed")

    key: str
    reason: str


@dataclass(frozen=True, slots=True)
class RecoveredNote:
    """What the journal told at the start. `leases`: what must be accounted for."""

    TAG: ClassVar = ("kind", "recovered")

    leases: tuple[str, ...]
    records: int
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class ReattachedNote:
    TAG: ClassVar = ("kind", "reattached")

    uses: int
    state: str


@dataclass(frozen=True, slots=True)
class ServingNote:
    """Grants begin, so long after the start."""

    TAG: ClassVar = ("kind", "serving")

    seconds: float


@dataclass(frozen=True, slots=True)
class ResumedNote:
    """The machine was suspended, or the daemon stopped."""

    TAG: ClassVar = ("kind", "resumed")

    slept_s: float


@dataclass(frozen=True, slots=True)
class OperatorNote:
    """An operator's order was followed."""

    TAG: ClassVar = ("kind", "operator")

    action: str
    by: str
    reason: str
    uses: int | None = None
    repeated: bool = False
    silent_s: float | None = None


type AnyNote = (
    QueuedNote
    | GrantedNote
    | ReadyNote
    | SwitchNote
    | DeniedNote
    | RefusedNote
    | CancelledNote
    | UseBeganNote
    | UseEndedNote
    | RevokeAskedNote
    | RevokeWithdrawnNote
    | RevokeAckedNote
    | RemindedNote
    | DeadlinePassedNote
    | SignalledNote
    | UnloadingNote
    | ReleasedNote
    | ExpiredNote
    | LostNote
    | VerifiedNote
    | StandbyNote
    | ParkedNote
    | OomNote
    | DriftNote
    | PressureNote
    | StowawayNote
    | ProbeFailedNote
    | ProbeOkNote
    | JournalFailedNote
    | RecoveredNote
    | ReattachedNote
    | ServingNote
    | ResumedNote
    | OperatorNote
)

NOTES: Final[Mapping[str, type]] = {cls.TAG[1]: cls for cls in get_args(AnyNote.__value__)}
"""Every note of the engine by its kind."""

WARNING_KINDS: Final = frozenset(
    (
        *("probe_failed", "pressure", "stowaway", "oom", "lost", "expired", "deadline_passed"),
        *("journal_put_aside", "record_stopped", "config_refused"),
    )
)
"""Kinds of events that logs show as warnings."""

DAEMON_KINDS: Final = (
    "started",
    "stopped",
    "journal_put_aside",
    "journal_doubted",
    "record_stopped",
    "record_resumed",
    "config_reloaded",
    "config_refused",
)
"""What the daemon itself adds to the history: its starts and ends, changes of its configuration,
and what is wrong with its own files."""
