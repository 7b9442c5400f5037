"""The wire's frames: a frame → a validated request; a reply → a frame.

1. `decode` counts a message before it is built (`msgpack_codec`) and validates its request, which
   stops at the first wrong item of a list: the worst message of 1 MiB costs a few milliseconds, and
   nothing that a peer sends raises anything but `Undecodable`.
2. `reply`, `refusal` and `push` put what the engine answers into words and encode it.

Pure: no sockets, no sessions.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import msgpack
from pydantic import TypeAdapter, ValidationError

from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.codec import encoders
from vram_arbiter.schemas.errors import BadRequest, UnknownOp, VramError
from vram_arbiter.schemas.ids import RequestId
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, unpack_map
from vram_arbiter.schemas.runtime.telemetry import traceparent
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.pushes import AnyPush, DeniedPush, LostPush, RevokePush
from vram_arbiter.schemas.wire.replies import (
    AnyReply,
    ReattachReply,
    RenewReply,
    StatusReply,
)
from vram_arbiter.schemas.wire.requests import REQUESTS, AnyRequest, Envelope

FIELDS_MAX = 20  # problems listed in one reply; the peer's text is never echoed at length
KEYS_MAX = 64
"""Keys of one map: every unknown key makes validation build one more error. The largest map of the
wire has 20."""
UNKNOWN_KEY = "Extra inputs are not permitted"
# the adapter's own method only adds options that are not used
_VALIDATE = {op: TypeAdapter(cls).validator.validate_python for op, cls in REQUESTS.items()}
_pack: Callable[[object], bytes] = msgpack.Packer(use_bin_type=True).pack

_PLAIN = encoders(*AnyReply.__subclasses__(), *AnyPush.__subclasses__(), ErrorView)
_WORDED = (RenewReply, ReattachReply, StatusReply, WhyReply, DeniedPush, LostPush, RevokePush)
"""Replies and pushes that may hold codes of the engine; `words` says them."""


class Undecodable(Exception):
    """A frame that is not a request: the typed error to answer with, and the id to answer to if one
    could be read."""

    def __init__(self, error: VramError, request_id: int | None) -> None:
        super().__init__(error.message)
        self.error = error
        self.request_id = request_id


def decode(payload: bytes | bytearray | memoryview, size_max: int) -> tuple[Envelope, AnyRequest]:
    """One frame to one request. Raises Undecodable with BadFrame, MessageTooLarge, UnknownOp or
    BadRequest."""
    try:
        message = unpack_map(payload, _limits(size_max))
    except VramError as error:
        raise Undecodable(error, None) from error
    op, request_id = message.get("op"), _id(message)
    if request_id is None or type(op) is not str or op not in _VALIDATE:
        raise Undecodable(_unreadable(message, op), request_id)
    del message["op"], message["id"]
    trace = message.pop("traceparent", None)
    try:
        request: AnyRequest = _VALIDATE[op](message)
    except ValidationError as error:
        raise Undecodable(_invalid(op, error), request_id) from error
    read = None if trace is None else traceparent.read(trace)
    return Envelope(RequestId(request_id), read), request


@lru_cache(maxsize=8)
def _limits(size_max: int) -> UnpackLimits:
    return UnpackLimits(message_max_bytes=size_max, keys_max=KEYS_MAX)


def _id(message: Mapping[Any, Any]) -> int | None:
    found = message.get("id")
    return found if type(found) is int and 0 <= found < 1 << 53 else None


def _unreadable(message: JsonMap, op: object) -> VramError:
    """Return the error of a message that does not say which request it is, or with which id."""
    if not isinstance(op, str):
        return BadRequest(
            "the request has no op",
            details={"fields": [{"field": "op", "problem": "missing or no text"}]},
        )
    if op not in _VALIDATE:
        return UnknownOp(f"unknown op {op[:64]!r}", details={"known": list(_VALIDATE)})
    problem = "expected a whole number below 2^53" if "id" in message else "Field required"
    return _bad_request(op, [("id", problem)], 1)


def _invalid(op: str, error: ValidationError) -> BadRequest:
    found = error.errors(include_url=False, include_context=False, include_input=False)
    fields = [
        (
            ".".join(str(part)[:64] for part in finding["loc"]),
            # pydantic speaks of a call of the class
            UNKNOWN_KEY if finding["type"] == "unexpected_keyword_argument" else finding["msg"],
        )
        for finding in found[:FIELDS_MAX]
    ]
    return _bad_request(op, fields, len(found))


def _bad_request(op: str, fields: Sequence[tuple[str, str]], count: int) -> BadRequest:
    (field, problem), more = fields[0], f" and {count - 1} more" if count > 1 else ""
    return BadRequest(
        f"{op}: {field}: {problem}{more}",
        hint="details.fields lists what is wrong",
        details={"fields": [{"field": field, "problem": problem} for field, problem in fields]},
    )


# -- replies → frames
def reply(request_id: int, epoch: int, body: AnyReply) -> bytes:
    """`{"re", "epoch", "ok": true, …}`"""
    if isinstance(body, _WORDED):
        body = words.reply(body)
    return _pack({"re": request_id, "epoch": epoch, "ok": True, **_PLAIN[type(body)](body)})


def refusal(request_id: int | None, epoch: int, error: ErrorView) -> bytes:
    """`{"re", "epoch", "ok": false, "error"}`; `re` is null where the request had no
    readable id."""
    return _pack({"re": request_id, "epoch": epoch, "ok": False, "error": _PLAIN[ErrorView](error)})


def push(seq: int, epoch: int, body: AnyPush) -> bytes:
    """`{"push", "seq", "epoch", …}`"""
    if isinstance(body, _WORDED):
        body = words.push(body)
    return _pack({**_PLAIN[type(body)](body), "seq": seq, "epoch": epoch})
