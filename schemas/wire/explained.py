"""Answers to *why is this consumer not running*: codes and values. Standard library only.

The fields `text` and `next` say the same in words. The engine leaves them empty;
`arbiter.rpc.words` fills them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from vram_arbiter.schemas.wire.codes import RevokeCause, Wait
from vram_arbiter.schemas.wire.tagged import AnyReply
from vram_arbiter.schemas.wire.views import BlockView


class Condition(StrEnum):
    """When the bytes of a blocker come free, or what holds them."""

    LOADING = "loading"  # `seconds`: since the grant
    REVOKED = "revoked"  # `seconds`: since it was revoked
    UNLOADING = "unloading"
    HANGING = "hanging"  # unloading for `seconds`, longer than a deadline
    MEASURED = "measured"  # it released; its bytes are verified
    NOT_BACK = "not_back"  # since a restart; given up in `seconds`
    PINNED = "pinned"  # `by`: the operator
    RESIDENCY = "residency"  # `seconds` of its minimum residency are left
    THRASHING = "thrashing"  # it and the waiter evict each other; `seconds` are left
    PRIORITY = "priority"  # in use, above the waiter's priority
    IN_USE = "in_use"  # `seconds`: since its oldest use began
    IDLE = "idle"  # it may be revoked
    CONTEXT = "context"  # a live process keeps its CUDA context
    RETAINED = "retained"  # a live process keeps more than that
    DEBT = "debt"  # the lease is over; its bytes are measured
    DEBT_KEPT = "debt_kept"  # the lease is over, and its process keeps the bytes
    STOWAWAY = "stowaway"


@dataclass(frozen=True, slots=True)
class Blocker:
    """A lease or process with bytes on the GPU, and the condition on which they come free."""

    lease_id: str | None  # None: a process without a resident lease
    consumer: str
    bytes: int
    state: str
    uses: int
    condition: Condition
    label: str = ""  # of its oldest use
    seconds: float | None = None
    pid: int | None = None
    by: str = ""  # operator
    loaded_bytes: int | None = None  # of a long load, as readings show it
    quiet_s: float | None = None  # for so long a load has not grown
    priority: int | None = None
    waiter_priority: int | None = None
    text: str = ""


class NextAction(StrEnum):
    """What the arbiter does next."""

    ASK = "ask"  # revoke a holder
    LOADED = "loaded"  # a load ends
    READ = "read"  # the GPU
    MEASURE = "measure"  # the bytes of a lease that released
    DEADLINE = "deadline"  # of a holder that was revoked
    WAIT = "wait"
    SERVE = "serve"  # grant again after a restart
    GIVE_UP = "give_up"  # the request


class Because(StrEnum):
    """Why a step comes when it comes."""

    NEXT_READING = "next_reading"
    RESIDENCY = "residency"
    AGEING = "ageing"  # the waiter's priority reaches the holder's
    TOGETHER = "together"  # enough holders may be revoked together
    ONE_LOAD = "one_load"  # one lease loads at a time
    UNREADABLE = "unreadable"
    MEASUREMENT = "measurement"  # the ledger has room, but the GPU has to show it
    ACCOUNTED = "accounted"  # all holders reattached or ran out of time
    NOT_BACK = "not_back"
    NO_VICTIM = "no_victim"
    VERDICT = "verdict"  # comes in `latest_s` at the latest
    MEASURED_GONE = "measured_gone"
    HANGING = "hanging"
    LEAVING = "leaving"
    WAITS_ON = "waits_on"
    TIMEOUT = "timeout"  # the waiter's own


@dataclass(frozen=True, slots=True)
class Step:
    """What the arbiter does next for a waiter. `in_s` None: no instant is planned."""

    action: NextAction
    consumer: str
    lease_id: str | None
    in_s: float | None
    because: Because
    waiter: str = ""
    latest_s: float | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class FootprintView:
    """Declared against learned bytes, by part. Learned 0: never measured."""

    declared_bytes: Mapping[str, int]
    learnt_bytes: Mapping[str, int]
    held_bytes: int | None


class Situation(StrEnum):
    """What a lease waits for, or what it is."""

    BEHIND = "behind"  # other requests
    MAKING_ROOM = "making_room"
    BLOCKED = "blocked"
    MEASURING = "measuring"
    NO_ROOM = "no_room"
    RESIDENT = "resident"
    AWAY = "away"


class Return(StrEnum):
    """What a lease without bytes waits for."""

    HOLDER = "holder"  # to reattach after a restart
    ASKED = "asked"  # its holder, to call it back
    BEHIND = "behind"  # a request, `ahead`
    BLOCKED = "blocked"
    LEFT_FOR = "left_for"  # `ahead` has to leave first
    NO_ROOM = "no_room"
    QUIET = "quiet"  # `due_s`: the GPU has to stay quiet for so long
    READING = "reading"


@dataclass(frozen=True, slots=True)
class Explanation:
    """One lease: what it needs, what is in its way, what happens next and when."""

    lease_id: str
    consumer: str
    state: str
    position: int
    needed_bytes: int
    free_bytes: int
    deficit_bytes: int
    condition: Situation
    blockers: tuple[Blocker, ...]
    eta_s: float | None
    eta_source: Literal["learnt", "none"]
    footprint: FootprintView
    plan: tuple[Step, ...]
    next: str = ""
    text: str = ""
    ahead: str = ""  # consumer of the request or lease before it
    wait: Wait | None = None
    block: BlockView | None = None
    leaving: tuple[Blocker, ...] = ()  # holders whose room is being made
    measuring: tuple[str, ...] = ()  # consumers whose bytes are verified
    expected_bytes: int | None = None  # load peak, where more than the declared was measured
    holder: Blocker | None = None  # the lease itself, where it is resident
    revoked: RevokeCause | None = None
    drifted: bool = False  # it holds more or less than declared
    back: Return | None = None  # where it is away
    due_s: float | None = None


@dataclass(frozen=True, slots=True)
class LeaseDetail:
    """What a status adds to a lease where it is asked for details.

    `declared_bytes`: resident; of a request or a load the load peak. `measured_bytes`: the newest
    reading, or the holder's word; None: unknown. `why`: of a lease that waits or is away.
    """

    lease_id: str
    declared_bytes: int
    measured_bytes: int | None = None
    why: Explanation | None = None


class WhyReply(AnyReply):
    """One entry per live lease of the consumer, the oldest first."""

    consumer: str
    leases: tuple[Explanation, ...]
    more: int = 0  # leases of that consumer beside those that are explained
