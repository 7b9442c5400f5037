"""What the arbiter sends unasked: `{"push": kind, "seq": n, "epoch": e, …}`. Standard
library only."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.tagged import Tagged
from vram_arbiter.schemas.wire.views import LeaseView


class AnyPush(Tagged):
    """Base of all pushes."""


class RevokePush(AnyPush, push="revoke"):
    """The arbiter asks the holder to leave. Repeated every `REVOKE_RESEND_S` until acknowledged;
    idempotent."""

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


class RevokeWithdrawnPush(AnyPush, push="revoke_withdrawn"):
    """The holder may stay: nothing wants its bytes any more. One that unloads already goes on."""

    lease_id: str
    token: Token


class GrantedPush(AnyPush, push="granted"):
    """A request that waited is granted."""

    lease: LeaseView


class DeniedPush(AnyPush, push="denied"):
    """A request that waited ends without a grant."""

    lease_id: str
    error: ErrorView


class LostPush(AnyPush, push="lost"):
    """The lease is over and its holder did not end it (expired, fenced): unload and
    acquire again."""

    lease_id: str
    token: Token
    error: ErrorView


class EventPush(AnyPush, push="event"):
    """One history event, for subscribers: `{"seq", "at_wall_s", "kind", "lease_id"?, …}`."""

    event: JsonMap


class PreparePush(AnyPush, push="prepare"):
    """The consumer's model is wanted soon. `by`: the client that said so."""

    by: str


PUSHES: Final[Mapping[str, type[Any]]] = MappingProxyType(
    {cls.TAG[1]: cls for cls in AnyPush.__subclasses__()}
)
"""Kind → type of the push."""
