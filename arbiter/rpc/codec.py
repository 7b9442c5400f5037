"""Bytes ↔ requests. Nothing that a peer sends makes this raise anything but a typed error, at a
bounded cost.

A message is counted before it is built (`msgpack_codec`), and validation stops at the first wrong
item of a list, so the worst message of 1 MiB costs a few milliseconds. Must not know sockets,
sessions or the core. Requests are validated by `schemas.wire`; replies and pushes are plain maps.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import msgpack
from pydantic import ValidationError

from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import BadRequest, UnknownOp, VramError
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, unpack_map
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.pushes import AnyPush
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.requests import OPS, REQUEST, Request

FIELDS_MAX = 20  # problems listed in one reply; the peer's text is never echoed at length
KEYS_MAX = 64
"""Keys of one map: every unknown key makes validation build one more error. The largest map of the
wire has 20."""
_OPS = frozenset(OPS)
_validate = (
    REQUEST.validator.validate_python
)  # the adapter's own method only adds options that we do not use


class Undecodable(Exception):
    """A frame that is not a request: the typed error to answer with, and the id to answer to if one
    could be read."""

    def __init__(self, error: VramError, request_id: int | None) -> None:
        super().__init__(error.message)
        self.error = error
        self.request_id = request_id


def decode(payload: bytes | bytearray | memoryview, size_max: int) -> Request:
    """One frame to one request. Raises Undecodable with BadFrame, MessageTooLarge, UnknownOp or
    BadRequest."""
    try:
        message = unpack_map(payload, _limits(size_max))
    except VramError as error:
        raise Undecodable(error, None) from error
    request_id = _id(message)
    op = message.get("op")
    if not isinstance(op, str):
        problem = BadRequest(
            "the request has no op",
            details={"fields": [{"field": "op", "problem": "missing or no text"}]},
        )
        raise Undecodable(problem, request_id)
    if op not in _OPS:
        raise Undecodable(
            UnknownOp(f"unknown op {op[:64]!r}", details={"known": list(OPS)}), request_id
        )
    try:
        request: Request = _validate(message)
        return request
    except ValidationError as error:
        raise Undecodable(_bad_request(op, error), request_id) from error


def id_of(payload: bytes | bytearray | memoryview, size_max: int) -> int | None:
    """The id that a request is answered to, without looking at the rest of it; None where none can
    be read."""
    try:
        return _id(unpack_map(payload, _limits(size_max)))
    except VramError:
        return None


@lru_cache(maxsize=8)
def _limits(size_max: int) -> UnpackLimits:
    return UnpackLimits(message_max_bytes=size_max, keys_max=KEYS_MAX)


def _id(message: Mapping[Any, Any]) -> int | None:
    found = message.get("id")
    return found if type(found) is int and 0 <= found < 1 << 53 else None


def _bad_request(op: str, error: ValidationError) -> BadRequest:
    fields = []
    for finding in error.errors(include_url=False, include_context=False, include_input=False)[
        :FIELDS_MAX
    ]:
        path = [str(part)[:64] for part in finding["loc"]]
        if path and path[0] == op:
            path = path[1:]  # the union's tag, no field of the message
        fields.append({"field": ".".join(path), "problem": finding["msg"]})
    first = fields[0] if fields else {"field": "", "problem": "invalid"}
    more = f" and {error.error_count() - 1} more" if error.error_count() > 1 else ""
    return BadRequest(
        f"{op}: {first['field']}: {first['problem']}{more}",
        hint="details.fields lists what is wrong",
        details={"fields": fields},
    )


def encode(message: Mapping[str, Any]) -> bytes:
    """One message to one frame."""
    packed: bytes = msgpack.packb(message, use_bin_type=True)
    return packed


def reply(request_id: int, epoch: int, body: AnyReply) -> bytes:
    """`{"re", "epoch", "ok": true, …}`"""
    return encode({"re": request_id, "epoch": epoch, "ok": True, **to_map(words.reply(body))})


def refusal(request_id: int | None, epoch: int, error: ErrorView) -> bytes:
    """`{"re", "epoch", "ok": false, "error"}`; `re` is null where the request had no
    readable id."""
    return encode({"re": request_id, "epoch": epoch, "ok": False, "error": to_map(error)})


def push(seq: int, epoch: int, body: AnyPush) -> bytes:
    """`{"push", "seq", "epoch", …}`"""
    return encode({**to_map(words.push(body)), "seq": seq, "epoch": epoch})
