"""The wire's frames: a frame → a validated request → an event of the engine; a reply → a frame.

1. `decode` counts a message before it is built (`msgpack_codec`) and lets `schemas.wire` validate
   it, which stops at the first wrong item of a list: the worst message of 1 MiB costs a few
   milliseconds, and nothing that a peer sends raises anything but `Undecodable`.
2. `event_of` turns a request that can change the engine into its event.
3. `reply`, `refusal` and `push` put what the engine answers into words and encode it.

Pure: no sockets, no sessions.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, get_args

import msgpack
from pydantic import ValidationError

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.codec import encoders
from vram_arbiter.schemas.errors import BadRequest, UnknownOp, VramError
from vram_arbiter.schemas.ids import ClientId, LeaseId, RequestId, Token, UseId
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, unpack_map
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.pushes import AnyPush, DeniedPush, LostPush, RevokePush
from vram_arbiter.schemas.wire.replies import (
    AnyReply,
    ReattachReply,
    RenewReply,
    StatusReply,
)
from vram_arbiter.schemas.wire.requests import OPS, REQUEST, Request

FIELDS_MAX = 20  # problems listed in one reply; the peer's text is never echoed at length
KEYS_MAX = 64
"""Keys of one map: every unknown key makes validation build one more error. The largest map of the
wire has 20."""
# the adapter's own method only adds options that are not used
_validate = REQUEST.validator.validate_python
_pack: Callable[[object], bytes] = msgpack.Packer(use_bin_type=True).pack

_PLAIN = encoders(*get_args(AnyReply.__value__), *get_args(AnyPush.__value__), ErrorView)
_WORDED = (RenewReply, ReattachReply, StatusReply, WhyReply, DeniedPush, LostPush, RevokePush)
"""Replies and pushes that may hold codes of the engine; `words` says them."""


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
    op = message.get("op")
    try:
        if not isinstance(op, str):
            raise BadRequest(
                "the request has no op",
                details={"fields": [{"field": "op", "problem": "missing or no text"}]},
            )
        if op not in OPS:
            raise UnknownOp(f"unknown op {op[:64]!r}", details={"known": list(OPS)})
        request: Request = _validate(message)
        return request
    except VramError as error:
        raise Undecodable(error, _id(message)) from error
    except ValidationError as error:
        raise Undecodable(_bad_request(str(op), error), _id(message)) from error


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


# -- requests → events
def event_of(request: w.Request, client: ClientId, operator: str) -> ev.Event:
    """Return the event of a request that can change the engine. `operator` names the peer of an
    action by hand."""
    re = RequestId(request.id)
    if isinstance(request, w.OnLease):
        on = (client, re, LeaseId(request.lease_id), Token(*request.token))
    match request:
        case w.Acquire():
            spec, wait_s = request.spec, request.wait_timeout_s
            return ev.AcquireRequested(client, re, request.nonce, spec, wait_s, request.traceparent)
        case w.Ready():
            return ev.ReadyReported(*on, request.measured_bytes)
        case w.UseBegin():
            return ev.UseBegan(*on, UseId(request.use_id), request.label)
        case w.UseEnd():
            return ev.UseEnded(*on, UseId(request.use_id))
        case w.Renew(leases=leases):
            held = tuple((LeaseId(lease.lease_id), Token(*lease.token)) for lease in leases)
            return ev.Renewed(client, re, held)
        case w.RevokeAck():
            return ev.RevokeAcknowledged(*on, request.safe_point_eta_s)
        case w.Unloading():
            return ev.UnloadStarted(*on)
        case w.Release():
            return ev.ReleaseReported(*on, request.exiting, request.parked)
        case w.Cancel():
            return ev.CancelRequested(client, re, LeaseId(request.lease_id))
        case w.Reacquire():
            return ev.Reacquired(*on, request.wait_timeout_s, request.traceparent)
        case w.Reattach():
            return ev.Reattached(client, re, tuple(map(_reattached, request.leases)))
        case w.ByHand():
            target = request.target if isinstance(request, w.ByHandOn) else ""
            return ev.OperatorAsked(client, re, request.op, target, operator, request.reason)
        case w.Oom():
            return ev.OomReported(*on, request.requested_bytes, request.allocated_bytes)
        case _:
            raise TypeError(f"{request.op} changes nothing in the engine")


def _reattached(lease: w.ReattachLease) -> ev.ReattachedLease:
    return ev.ReattachedLease(
        lease=LeaseId(lease.lease_id),
        token=Token(*lease.token),
        spec=lease.spec,
        state=lease.state,
        measured_bytes=lease.measured_bytes,
        uses=tuple(UseId(use) for use in lease.use_ids),
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
