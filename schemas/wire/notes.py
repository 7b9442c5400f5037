"""Notes: what happened, as history, subscribers, telemetry, the log and replays learn it.

One class for each kind, with typed fields and no words. A note about a lease goes with `About`.
`arbiter.rpc.words` makes the event of both: `{"kind", "lease_id"?, "consumer"?, "gpu"?,
"traceparent"?, …, "reason"?}`. A field that has its default is left out.
Standard library only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from vram_arbiter.schemas.ids import GpuId, LeaseId, UseId
from vram_arbiter.schemas.wire.codes import Cause, Order, Wait, Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.tagged import Tagged
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


class AnyNote(Tagged):
    """Base of all notes."""


# -- waiting and granting
class QueuedNote(AnyNote, kind="queued"):
    """A request waits."""

    position: int | None
    wait: Wait | None
    behind: str  # consumer of the request before it
    block: BlockView | None = None  # why nothing is granted on its GPU


class GrantedNote(AnyNote, kind="granted"):
    charge_bytes: int
    waited_ms: float
    evicted: tuple[str, ...]  # consumers
    by_itself: bool = False  # back from standby, without an acquire


class ReadyNote(AnyNote, kind="ready"):
    """The holder has loaded."""

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


class SwitchNote(AnyNote, kind="switch"):
    """Time of a grant from the acquire to `ready`, by phase; it comes with each `ready`. Of several
    victims the slowest counts. `switched`: a lease was evicted for it."""

    switched: bool
    evicted: tuple[EvictedLease, ...]
    verified: bool
    wait_ms: float
    drain_ms: float
    unload_ms: float
    verify_ms: float
    load_ms: float
    total_ms: float


class DeniedNote(AnyNote, kind="denied"):
    """A request that waited, or a grant that could not be recorded, is over."""

    refusal: Refusal = field(metadata=_CODE)


class RefusedNote(AnyNote, kind="refused"):
    """A request for bytes was refused at once. `left_out`: refusals of the same process that were
    not noted."""

    pid: int
    refusal: Refusal = field(metadata=_CODE)
    consumer: str = ""  # of an acquire, which has no lease
    left_out: int = 0


class CancelledNote(AnyNote, kind="cancelled"):
    why: Why
    by: str = ""


# -- uses
class UseBeganNote(AnyNote, kind="use_began"):
    use_id: UseId
    label: str
    uses: int
    resumed: bool


class UseEndedNote(AnyNote, kind="use_ended"):
    use_id: UseId
    label: str
    ms: float
    why: Why
    by: str = ""


# -- leaving
class RevokeAskedNote(AnyNote, kind="revoke_asked"):
    """A holder is revoked for the first time."""

    wanted_by: str  # consumer of the waiter
    wanted_by_lease: LeaseId | None
    uses: int
    cause: Cause
    order: Order | None = None


class RevokeWithdrawnNote(AnyNote, kind="revoke_withdrawn"):
    """A revoke ends without an eviction: nothing wants the bytes any more."""

    wanted_by: str  # consumer of the waiter that is gone
    cause: Cause
    uses: int
    ms: float  # since the revoke


class RevokeAckedNote(AnyNote, kind="revoke_acked"):
    safe_point_eta_s: float | None
    uses: int


class RemindedNote(AnyNote, kind="reminded"):
    uses: int
    acked: bool


class DeadlinePassedNote(AnyNote, kind="deadline_passed"):
    uses: int
    wanted_by: str


class SignalledNote(AnyNote, kind="signalled"):
    """An operator ended the process of a holder."""

    signal: Literal["term", "kill"]
    pid: int
    by: str
    reason: str


class UnloadingNote(AnyNote, kind="unloading"):
    asked: bool


class ReleasedNote(AnyNote, kind="released"):
    exiting: bool
    was: str  # its state before
    why: Why


class ExpiredNote(AnyNote, kind="expired"):
    why: Why
    ttl_s: float


class LostNote(AnyNote, kind="lost"):
    why: Why
    pid: int | None = None


@dataclass(frozen=True, slots=True)
class Culprit:
    """A process that holds bytes which a lease gave up."""

    pid: int
    name: str
    bytes: int


class VerifiedNote(AnyNote, kind="verified"):
    """A verdict. `resolved` False: the verification goes on."""

    verdict: str
    resolved: bool
    ms: float
    before_bytes: int | None
    after_bytes: int | None
    residue_bytes: int
    culprits: tuple[Culprit, ...]


# -- standby
class StandbyNote(AnyNote, kind="standby"):
    """A lease is away. `comes_back`: by itself."""

    left_for: str
    parked_bytes: int
    comes_back: bool


class ParkedNote(AnyNote, kind="parked"):
    """A lease is away, its weights are in host RAM. `comes_back`: by itself."""

    left_for: str
    parked_bytes: int
    comes_back: bool


# -- measurements
class OomNote(AnyNote, kind="oom"):
    requested_bytes: int
    allocated_bytes: int | None
    charge_bytes: int
    learnt_load_peak_bytes: int | None


class DriftNote(AnyNote, kind="drift"):
    """A footprint is not what was declared. Said once for a lease and part."""

    part: str
    declared_bytes: int
    measured_bytes: int
    drift_bytes: int


@dataclass(frozen=True, slots=True)
class OverHolder:
    """A process that holds more than its charge."""

    pid: int
    over_bytes: int


class PressureNote(AnyNote, kind="pressure"):
    """A GPU holds more than its budget, or (0 bytes) no longer does."""

    gpu: GpuId
    pressure_bytes: int
    stowaway_bytes: int
    holders: tuple[OverHolder, ...]


class StowawayNote(AnyNote, kind="stowaway"):
    gpu: GpuId
    pid: int
    name: str
    used_bytes: int


class ProbeFailedNote(AnyNote, kind="probe_failed"):
    gpu: GpuId
    reason: str


class ProbeOkNote(AnyNote, kind="probe_ok"):
    gpu: GpuId


# -- the daemon
class JournalFailedNote(AnyNote, kind="journal_failed"):
    key: str
    reason: str


class RecoveredNote(AnyNote, kind="recovered"):
    """What the journal told at the start. `leases`: what must be accounted for."""

    leases: tuple[str, ...]
    records: int
    doubt: str = ""


class ReattachedNote(AnyNote, kind="reattached"):
    uses: int
    state: str


class ServingNote(AnyNote, kind="serving"):
    """Grants begin, so long after the start."""

    seconds: float


class ResumedNote(AnyNote, kind="resumed"):
    """The machine was suspended, or the daemon stopped."""

    slept_s: float


class OperatorNote(AnyNote, kind="operator"):
    """An operator's order was followed."""

    action: str
    by: str
    reason: str
    uses: int | None = None
    repeated: bool = False
    silent_s: float | None = None


NOTES: Final[Mapping[str, type]] = {cls.TAG[1]: cls for cls in AnyNote.__subclasses__()}
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
