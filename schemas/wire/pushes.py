"""What the arbiter sends unasked: `{"push": kind, "seq": n, "epoch": e, …}`. Standard
library only."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Final, get_args

from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.views import LeaseView


@dataclass(frozen=True, slots=True)
class RevokePush:
    """The arbiter asks the holder to leave. Repeated every `REVOKE_RESEND_S` until acknowledged;
    idempotent."""

    TAG: ClassVar = ("push", "revoke")

    lease_id: str
    token: Token
    wanted_by: str  # the consumer that the room is for; "" where there is none
    deadline_in_s: float
    uses: int  # what still runs on the lease; `unloading` is refused before 0
    park: bool  # host RAM for its weights is booked: release with `parked`
    reason: str = ""  # the cause in words; the engine leaves it empty
    cause: str = ""  # waiter, pressure, operator
    order: Order | None = None  # an operator wants it
    priority: int | None = None  # of the request that wants the room
    traceparent: str = ""  # of the eviction, or of the waiter: the unloading belongs to that trace


@dataclass(frozen=True, slots=True)
class RevokeWithdrawnPush:
    """The holder may stay: nothing wants its bytes any more. One that unloads already goes on."""

    TAG: ClassVar = ("push", "revoke_withdrawn")

    lease_id: str
    token: Token


@dataclass(frozen=True, slots=True)
class GrantedPush:
    """A request that waited is granted."""

    TAG: ClassVar = ("push", "granted")

    lease: LeaseView


@dataclass(frozen=True, slots=True)
class DeniedPush:
    """A request that waited ends without a grant."""

    TAG: ClassVar = ("push", "denied")

    lease_id: str
    error: ErrorView


@dataclass(frozen=True, slots=True)
class LostPush:
    """The lease is over and its holder did not end it (expired, fenced): unload and
    acquire again."""

    TAG: ClassVar = ("push", "lost")

    lease_id: str
    token: Token
    error: ErrorView


@dataclass(frozen=True, slots=True)
class EventPush:
    """One history event, for subscribers: `{"seq", "at_wall_s", "kind", "lease_id"?, …}`."""

    TAG: ClassVar = ("push", "event")

    event: JsonMap


@dataclass(frozen=True, slots=True)
class PreparePush:
    """The consumer's model is wanted soon. `by`: the client that said so."""

    TAG: ClassVar = ("push", "prepare")

    by: str


type AnyPush = (
    RevokePush | RevokeWithdrawnPush | GrantedPush | DeniedPush | LostPush | EventPush | PreparePush
)

PUSHES: Final[Mapping[str, type[Any]]] = MappingProxyType(
    {cls.TAG[1]: cls for cls in get_args(AnyPush.__value__)}
)
"""Kind → type of the push."""
