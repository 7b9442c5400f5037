"""Requests of the arbiter's wire, each declared once: clients build them, the daemon validates them
and the engine handles them as the same frozen objects.

On the wire a request is the map of its fields with its `op` and the two fields of `Envelope`.
Validation refuses unknown keys. Standard library only.

The life of a lease on the wire: `acquire` → reply `loading` (granted at once) or `queued`, then
push `granted` → `ready` → `use_begin`/`use_end`… → push `revoke` → `revoke_ack` → `unloading` →
`release`. `renew` keeps all leases of a connection alive. A revoked lease with `standby` continues
after its `release`: push `granted` (with a new token) when it is back, or `reacquire`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, RequestId, Token, UseId
from vram_arbiter.schemas.limits import NAME, STRICT, AsPair, Bytes, Limits, Name, Seconds
from vram_arbiter.schemas.wire import replies as r
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.tagged import Tagged

LeaseIdText = Annotated[LeaseId, Limits(min_length=1, max_length=64)]
UseName = Annotated[UseId, NAME]
TokenPair = Annotated[Token, AsPair()]
"""`[epoch, serial]`."""
Serial = Annotated[int, Limits(ge=0, lt=1 << 63)]
Count = Annotated[int, Limits(ge=0, lt=1 << 31)]
Reason = Annotated[str, Limits(max_length=d.REASON_MAX_CHARS, pattern=r"^[^\x00-\x1f\x7f]*$")]
Role = Literal["client", "observer", "operator"]
UseNames = Annotated[tuple[UseName, ...], Limits(max_length=d.USES_PER_LEASE_MAX, fail_fast=True)]
"""Lists end at their first wrong item: a message with thousands of wrong ones must not cost an
error for each."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """What a message says beside its request: the id that the reply repeats as `re`, and the W3C
    traceparent of the caller's span. A traceparent that is none is ignored."""

    id: Annotated[RequestId, Limits(ge=0, lt=1 << 53)]
    traceparent: str | None = None


class Request[R](Tagged):
    """Base of all requests; `R` is the type of the reply."""

    __pydantic_config__: ClassVar = STRICT
    WHOLE: ClassVar = True


class SessionRequest[R](Request[R]):
    """A request that the session answers by itself: the engine does not hear of it."""


class Question[R](SessionRequest[R]):
    """All that an observer may send."""


class Hello(Question[r.WelcomeReply], op="hello", kw_only=True):
    """First message of a connection. `instance` names the client object, to find its leases again
    after a reconnect."""

    version: int = d.WIRE_VERSION
    name: Name
    instance: Name
    role: Role = "client"


class Acquire(Request[r.AcquireReply], op="acquire"):
    """Ask for a lease. The same `nonce` from the same process is the same request: a repeat never
    makes a second lease."""

    nonce: Name
    spec: LeaseSpec
    wait_timeout_s: Seconds | None = None  # None waits for ever


@dataclass(frozen=True, slots=True)
class LeaseRef:
    """A lease by its exact token."""

    __pydantic_config__: ClassVar = STRICT
    WHOLE: ClassVar = True

    lease_id: LeaseIdText
    token: TokenPair


class OnLease[R](Request[R]):
    """What a client says about a lease whose token it knows."""

    lease_id: LeaseIdText
    token: TokenPair


class Ready(OnLease[r.ReadyReply], op="ready"):
    """The model is loaded; `measured_bytes` is what the holder sees of its own allocation (None: it
    cannot tell)."""

    measured_bytes: Bytes | None = None


class UseBegin(OnLease[r.UsesReply], op="use_begin"):
    """Begin a use. Any client that knows the token may; the use ends with that client's process at
    the latest. `begun`: of the lease's holder, for a use that is in progress since before it heard
    of a revoke."""

    use_id: UseName
    label: Annotated[str, Limits(max_length=d.NAME_MAX_CHARS)] = ""
    begun: bool = False


class UseEnd(OnLease[r.UsesReply], op="use_end"):
    """End a use; one that is over is fine."""

    use_id: UseName


class Renew(Request[r.RenewReply], op="renew"):
    """Keep leases alive."""

    leases: Annotated[
        tuple[LeaseRef, ...], Limits(max_length=d.LEASES_PER_CLIENT_MAX, fail_fast=True)
    ]


class RevokeAck(OnLease[r.StateReply], op="revoke_ack"):
    """The holder heard `revoke`; `safe_point_eta_s` is its guess of when it will be
    between uses."""

    safe_point_eta_s: Seconds | None = None


class Unloading(OnLease[r.StateReply], op="unloading"):
    """The holder is at its safe point and unloads."""


class Release(OnLease[r.ReleaseReply], op="release"):
    """The holder has let go of the bytes (its process lives on: residue) or is about to exit
    (`exiting`).

    The reply's `next` says where the lease goes once the bytes are measured gone: `released`,
    `standby` or `parked`.
    """

    exiting: bool = False
    parked: bool = False  # the weights are in host RAM: the lease lives on as `parked`


class Cancel(Request[r.StateReply], op="cancel"):
    """Give up a queued acquire."""

    lease_id: LeaseIdText


class Reacquire(OnLease[r.AcquireReply], op="reacquire"):
    """A lease that is away is wanted now: it waits like any other. `token` is the last one, so a
    late repeat asks for nothing."""

    wait_timeout_s: Seconds | None = None


@dataclass(frozen=True, slots=True)
class ReattachLease:
    """A lease that a client still holds. On standby or parked, `token` is the last one."""

    __pydantic_config__: ClassVar = STRICT
    WHOLE: ClassVar = True

    lease_id: LeaseIdText
    token: TokenPair
    spec: LeaseSpec
    state: Literal["loading", "held", "standby", "parked"]
    measured_bytes: Bytes | None = None
    use_ids: UseNames = ()


class Reattach(Request[r.ReattachReply], op="reattach"):
    """After a reconnect: what this client still holds. The reply says per lease `kept` or
    why not."""

    leases: Annotated[
        tuple[ReattachLease, ...], Limits(max_length=d.LEASES_PER_CLIENT_MAX, fail_fast=True)
    ]


class Oom(OnLease[r.OomReply], op="oom"):
    """The consumer's allocation failed. Raises the learnt footprint of its model."""

    requested_bytes: Bytes
    allocated_bytes: Bytes | None = None


class Status(Question[r.StatusReply], op="status"):
    """The state of everything. Leases come in pages: `after` is the `next` of the page before.
    `details`: with declared and measured bytes, and why each waiter waits; its pages are
    shorter."""

    WHOLE: ClassVar = False  # a question for everything says nothing of its pages
    details: bool = False
    after: (
        tuple[
            Annotated[int, Limits(ge=0, le=1)],
            Annotated[float, Limits(allow_inf_nan=False)],
            Serial,
        ]
        | None
    ) = None


class AskWhy(Question[WhyReply], op="why"):
    """What blocks a consumer."""

    consumer: Name


class History(Question[r.HistoryReply], op="history"):
    """Events after a number, oldest first; a reply has at most 2000. With `before`: the newest ones
    with a smaller number than that."""

    WHOLE: ClassVar = False  # an older arbiter knows no `before`
    after: int = 0  # sequence number of the last event already seen
    limit: Annotated[int, Limits(ge=1, le=5000)] = 500
    kinds: Annotated[tuple[str, ...], Limits(max_length=d.LISTED_MAX, fail_fast=True)] = ()
    before: Annotated[int, Limits(ge=1)] | None = None


class Subscribe(Question[r.DoneReply], op="subscribe"):
    """Receive every history event as a push `event` from now on."""


class ByHand[R](Request[R]):
    """An operator's action. `reason` is kept with the operator's name in history and, for pins and
    drains, in the journal."""

    reason: Reason


class ByHandOn(ByHand[r.OperatorReply]):
    """One on a lease, by its id or by the name of a consumer that has exactly one."""

    target: Name


class Evict(ByHandOn, op="evict"):
    """Ask a holder to leave. In use it finishes first; a pinned one is refused."""


class Kill(ByHandOn, op="kill"):
    """End the process of a stuck holder: SIGTERM, and SIGKILL when it is asked for again. Refused
    while another process uses one of its leases, or it uses one of another process."""


class Pin(ByHandOn, op="pin"):
    """Protect the lease from eviction until it is unpinned."""


class Unpin(ByHandOn, op="unpin"):
    """Undo a pin."""


class ReleaseDead(ByHandOn, op="release_dead"):
    """Give up the lease of a holder that is not heard of, before its ttl is over. Refused in use,
    and for a holder that lives."""


class Drain(ByHand[r.DrainReply], op="drain"):
    """No new grants until `resume`; what is held is kept. Outlives the daemon, not the machine."""


class Resume(ByHand[r.DrainReply], op="resume"):
    """Grant again."""


class Prepare(SessionRequest[r.PrepareReply], op="prepare"):
    """A hint: the consumer's model is wanted soon. It is passed on to the consumer, which may read
    its weights into host RAM; it grants nothing and evicts nothing."""

    consumer: Name


@dataclass(frozen=True, slots=True)
class ConsumerDemand:
    """How many requests of its own clients are in flight at a consumer, and wait for it."""

    __pydantic_config__: ClassVar = STRICT
    WHOLE: ClassVar = True

    consumer: Name
    in_flight: Count
    waiting: Count


class Demand(SessionRequest[r.DoneReply], op="demand"):
    """What a client that serves consumers tells of their requests, for `status` alone. It replaces
    what the client told before, and is forgotten with its connection."""

    consumers: Annotated[
        tuple[ConsumerDemand, ...], Limits(max_length=d.DEMANDS_MAX, fail_fast=True)
    ]


class Ping(Question[r.PingReply], op="ping"):
    """A sign of life."""


class Bye(Question[r.DoneReply], op="bye"):
    """The client closes its socket. Its leases are released; a process that lives on keeps its
    residue."""


type AnyRequest = (
    Hello
    | Acquire
    | Ready
    | UseBegin
    | UseEnd
    | Renew
    | RevokeAck
    | Unloading
    | Release
    | Cancel
    | Reacquire
    | Reattach
    | Oom
    | Status
    | AskWhy
    | History
    | Subscribe
    | Evict
    | Kill
    | Pin
    | Unpin
    | ReleaseDead
    | Drain
    | Resume
    | Prepare
    | Demand
    | Ping
    | Bye
)
REQUESTS: Final[Mapping[str, type[Any]]] = MappingProxyType(
    {cls.TAG[1]: cls for cls in get_args(AnyRequest.__value__)}
)
"""By their ops."""
REPLIES: Final[Mapping[type, type[Any]]] = MappingProxyType(
    {cls: get_args(cls.__orig_bases__[0])[0] for cls in REQUESTS.values()}
)
"""Type of the reply to each request: the argument of its base."""
