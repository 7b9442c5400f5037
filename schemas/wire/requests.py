"""Requests of the arbiter's wire, validated: frozen models that refuse unknown keys.

The life of a lease on the wire: `acquire` → reply `loading` (granted at once) or `queued`, then
push `granted` → `ready` → `use_begin`/`use_end`… → push `revoke` → `revoke_ack` → `unloading` →
`release`. `renew` keeps all leases of a connection alive. A revoked lease with `standby` continues
after its `release`: push `granted` (with a new token) when it is back, or `reacquire`.
"""

from collections.abc import Mapping
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.limits import Bytes, Name, Seconds
from vram_arbiter.schemas.runtime.telemetry.traceparent import Traceparent
from vram_arbiter.schemas.wire.spec import LeaseSpec

LeaseIdText = Annotated[str, Field(min_length=1, max_length=64)]
TokenPair = Annotated[tuple[int, int], Field(description="[epoch, serial]")]
Serial = Annotated[int, Field(ge=0, lt=1 << 63)]
Reason = Annotated[str, Field(max_length=d.REASON_MAX_CHARS, pattern=r"^[^\x00-\x1f\x7f]*$")]
UseIds = Annotated[tuple[Name, ...], Field(max_length=d.USES_PER_LEASE_MAX, fail_fast=True)]
"""Lists end at their first wrong item: a message with thousands of wrong ones must not cost an
error for each."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LeaseRef(_Frozen):
    lease_id: LeaseIdText
    token: TokenPair


class _Request(_Frozen):
    id: Annotated[int, Field(ge=0, lt=1 << 53)]
    traceparent: Traceparent = None


class Hello(_Request):
    """First message of a connection. `instance` names the client object, to find its leases again
    after a reconnect."""

    op: Literal["hello"]
    version: int = d.WIRE_VERSION
    name: Name
    instance: Name
    role: Literal["client", "observer", "operator"] = "client"


class Acquire(_Request):
    """Ask for a lease. The same `nonce` from the same process is the same request: a repeat never
    makes a second lease."""

    op: Literal["acquire"]
    nonce: Name
    spec: LeaseSpec
    wait_timeout_s: Seconds | None = None  # None waits for ever


class OnLease(_Request):
    """What a client says about a lease whose token it knows."""

    lease_id: LeaseIdText
    token: TokenPair


class Ready(OnLease):
    """The model is loaded; `measured_bytes` is what the holder sees of its own allocation (None: it
    cannot tell)."""

    op: Literal["ready"]
    measured_bytes: Bytes | None = None


class UseBegin(OnLease):
    """Begin a use. Any client that knows the token may; the use ends with that client's process at
    the latest."""

    op: Literal["use_begin"]
    use_id: Name
    label: Annotated[str, Field(max_length=d.NAME_MAX_CHARS)] = ""


class UseEnd(OnLease):
    op: Literal["use_end"]
    use_id: Name


class Renew(_Request):
    op: Literal["renew"]
    leases: Annotated[
        tuple[LeaseRef, ...], Field(max_length=d.LEASES_PER_CLIENT_MAX, fail_fast=True)
    ]


class RevokeAck(OnLease):
    """The holder heard `revoke`; `safe_point_eta_s` is its guess of when it will be
    between uses."""

    op: Literal["revoke_ack"]
    safe_point_eta_s: Seconds | None = None


class Unloading(OnLease):
    op: Literal["unloading"]


class Release(OnLease):
    """The holder has let go of the bytes (its process lives on: residue) or is about to exit
    (`exiting`).

    The reply's `next` says where the lease goes once the bytes are measured gone: `released`,
    `standby` or `parked`.
    """

    op: Literal["release"]
    exiting: bool = False
    parked: bool = False  # the weights are in host RAM: the lease lives on as `parked`


class Cancel(_Request):
    """Give up a queued acquire."""

    op: Literal["cancel"]
    lease_id: LeaseIdText


class Reacquire(OnLease):
    """A lease that is away is wanted now: it waits like any other. `token` is the last one, so a
    late repeat asks for nothing."""

    op: Literal["reacquire"]
    wait_timeout_s: Seconds | None = None


class ReattachLease(_Frozen):
    lease_id: LeaseIdText
    token: TokenPair
    spec: LeaseSpec
    state: Literal[
        "loading", "held", "standby", "parked"
    ]  # standby, parked: `token` is the last one
    measured_bytes: Bytes | None = None
    use_ids: UseIds = ()


class Reattach(_Request):
    """After a reconnect: what this client still holds. The reply says per lease `kept` or
    why not."""

    op: Literal["reattach"]
    leases: Annotated[
        tuple[ReattachLease, ...], Field(max_length=d.LEASES_PER_CLIENT_MAX, fail_fast=True)
    ]


class Oom(OnLease):
    """The consumer's allocation failed. Raises the learnt footprint of its model."""

    op: Literal["oom"]
    requested_bytes: Bytes
    allocated_bytes: Bytes | None = None


class Status(_Request):
    """The state of everything. Leases come in pages: `after` is the `next` of the page before.
    `details`: with declared and measured bytes, and why each waiter waits; its pages are
    shorter. `leases`: with these alone, as far as they are not over, and without tokens."""

    op: Literal["status"]
    details: bool = False
    leases: Annotated[tuple[LeaseIdText, ...], Field(max_length=d.STATUS_PAGE)] = ()
    after: tuple[Literal[0, 1], Annotated[float, Field(allow_inf_nan=False)], Serial] | None = None


class AskWhy(_Request):
    op: Literal["why"]
    consumer: Name


class History(_Request):
    op: Literal["history"]
    after: int = 0  # sequence number of the last event already seen
    limit: Annotated[int, Field(ge=1, le=5000)] = 500  # a reply has at most 2000 events
    kinds: Annotated[tuple[str, ...], Field(max_length=d.LISTED_MAX, fail_fast=True)] = ()


class Subscribe(_Request):
    """Receive every history event as a push `event` from now on."""

    op: Literal["subscribe"]


class ByHand(_Request):
    """An operator's action. `reason` is kept with the operator's name in history and, for pins and
    drains, in the journal."""

    reason: Reason


class ByHandOn(ByHand):
    target: Name  # a lease id, or a consumer that has exactly one lease


class Evict(ByHandOn):
    """Ask a holder to leave. In use it finishes first; a pinned one is refused."""

    op: Literal["evict"]


class Kill(ByHandOn):
    """End the process of a stuck holder: SIGTERM, and SIGKILL when it is asked for again. Refused
    while another process uses one of its leases, or it uses one of another process."""

    op: Literal["kill"]


class Pin(ByHandOn):
    """Protect the lease from eviction until it is unpinned."""

    op: Literal["pin"]


class Unpin(ByHandOn):
    op: Literal["unpin"]


class ReleaseDead(ByHandOn):
    """Give up the lease of a holder that is not heard of, before its ttl is over. Refused in use,
    and for a holder that lives."""

    op: Literal["release_dead"]


class Drain(ByHand):
    """No new grants until `resume`; what is held is kept. Outlives the daemon, not the machine."""

    op: Literal["drain"]


class Resume(ByHand):
    op: Literal["resume"]


class Prepare(_Request):
    """A hint: the consumer's model is wanted soon. It is passed on to the consumer, which may read
    its weights into host RAM; it grants nothing and evicts nothing."""

    op: Literal["prepare"]
    consumer: Name


class Ping(_Request):
    op: Literal["ping"]


class Bye(_Request):
    """The client closes its socket. Its leases are released; a process that lives on keeps its
    residue."""

    op: Literal["bye"]


Request = Annotated[
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
    | Ping
    | Bye,
    Field(discriminator="op"),
]
REQUEST: TypeAdapter[Request] = TypeAdapter(Request)
OPS: tuple[str, ...] = tuple(
    get_args(request.model_fields["op"].annotation)[0] for request in get_args(get_args(Request)[0])
)


_SPEC = TypeAdapter(LeaseSpec)


def checked_spec(fields: Mapping[str, object]) -> LeaseSpec:
    """Return the spec with these fields, within its limits. Raises pydantic's ValidationError."""
    return _SPEC.validate_python(fields)
