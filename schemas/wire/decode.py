"""Messages of the arbiter → their types, for clients. Standard library only.

reply = decode_reply("acquire", message)     # AcquireReply, for a message with "ok": true
push = decode_push(message)                  # None for a kind that this version does not know
error = decode_error(message)                # the ErrorView of a message with "ok": false
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, get_args

from vram_arbiter.schemas.codec import from_map
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire import explained, pushes
from vram_arbiter.schemas.wire import replies as r
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.replies import AnyReply as AnyReply

REPLIES: Final[Mapping[str, type[Any]]] = MappingProxyType(
    {
        "hello": r.WelcomeReply,
        "ping": r.PingReply,
        "prepare": r.PrepareReply,
        "bye": r.DoneReply,
        "subscribe": r.DoneReply,
        "acquire": r.AcquireReply,
        "reacquire": r.AcquireReply,
        "resize": r.AcquireReply,
        "ready": r.ReadyReply,
        "use_begin": r.UsesReply,
        "use_end": r.UsesReply,
        "yield": r.UsesReply,
        "revoke_ack": r.StateReply,
        "unloading": r.StateReply,
        "cancel": r.StateReply,
        "release": r.ReleaseReply,
        "renew": r.RenewReply,
        "reattach": r.ReattachReply,
        "oom": r.OomReply,
        "status": r.StatusReply,
        "why": explained.WhyReply,
        "history": r.HistoryReply,
        "evict": r.OperatorReply,
        "pin": r.OperatorReply,
        "unpin": r.OperatorReply,
        "release_dead": r.OperatorReply,
        "drain": r.DrainReply,
        "resume": r.DrainReply,
    }
)
"""Op → type of its reply."""

PUSHES: Final[Mapping[str, type[Any]]] = MappingProxyType(
    {cls.TAG[1]: cls for cls in get_args(pushes.AnyPush.__value__)}
)
"""Kind → type of the push."""


def decode_reply(op: str, message: JsonMap) -> AnyReply:
    """Return the typed reply to `op`; the envelope's fields are ignored. Raises CodecError, and
    KeyError for an unknown op."""
    reply: AnyReply = from_map(REPLIES[op], message)
    return reply


def decode_push(message: JsonMap) -> pushes.AnyPush | None:
    """Return the typed push; None for a kind that only a newer arbiter knows. Raises CodecError."""
    cls = PUSHES.get(str(message.get("push")))
    push: pushes.AnyPush | None = None if cls is None else from_map(cls, message)
    return push


def decode_error(message: JsonMap) -> ErrorView:
    """Return the error of a refusal. Raises CodecError."""
    return from_map(ErrorView, message.get("error") or {"code": "internal"})
