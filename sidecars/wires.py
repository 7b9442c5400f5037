"""The sidecars' two wire families: messages in, replies out.

Shapes are in `schemas.sidecar`; the host performs them. Every bad message gets a typed error; none
ends the sidecar. Both families can be spoken at once: `op` or `endpoint` decides.

A request without `id` comes from a client of the field, which knows its family's shapes only: a
policy's answer is `[actions, info]`, every judged picture has a probability of success, and an
error of the endpoint family is a map of one key, which such a client tells by its size from
actions.
"""

import functools
import logging
import os
import time
from collections.abc import Awaitable, Callable
from typing import Any, Literal, Protocol

from pydantic import ValidationError

from vram_arbiter.clients.net.server import Peer
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.errors import (
    BadRequest,
    InternalError,
    LimitExceeded,
    NotPermitted,
    UnknownOp,
    VramError,
)
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.sidecar import (
    ENDPOINT_REQUEST,
    OP_REQUEST,
    DetectOp,
    EndpointCall,
    LoadOp,
    OpRequest,
    QueryOp,
    ScoreOp,
)

PENDING_MAX = 32  # model requests that wait or run; with more, `ping` would have to wait too
Call = OpRequest | EndpointCall
Family = Literal["op", "endpoint"]
type Reply = Message | list[Message]
Send = Callable[[Peer, Reply], Awaitable[None]]
_log = logging.getLogger("sidecars")


class Host(Protocol):
    """Interface of the host as the wire needs it."""

    @property
    def model_ops(self) -> frozenset[str]: ...

    def identity(self) -> Message: ...

    async def load(self, timeout_s: float | None) -> Message: ...

    async def unload(self) -> None: ...

    async def run(
        self, name: str, call: DetectOp | QueryOp | ScoreOp | EndpointCall, message: Message
    ) -> Message:
        """Answer a request of the model; `message` is the call as it came."""
        ...

    def stop(self) -> None: ...


class Wire:
    """Message handler of one host: give `handle` to `RouterServer.serve`."""

    def __init__(self, host: Host, send: Send) -> None:
        self._host = host
        self._send = send
        self._pending = 0

    async def handle(self, peer: Peer, message: Message) -> None:
        number, family = message.get("id"), family_of(message)
        of_field = not isinstance(number, int)
        reply: Reply
        try:
            call = parse(message, self._host.model_ops)
            reply = await self._answer(peer, call, message)
            if of_field:
                reply = _in_field_shape(name_of(call), reply)
        except VramError as error:
            reply = error_reply(error, family, of_field=of_field)
        except Exception as error:  # noqa: BLE001  the outermost loop of a server
            _log.exception("internal error while answering")
            defect = InternalError(
                f"{type(error).__name__}: {error}", hint="this is a defect; see the log"
            )
            reply = error_reply(defect, family, of_field=of_field)
        if isinstance(reply, dict) and not of_field:
            reply = {**reply, "re": number}
        await self._send(peer, reply)

    async def _answer(self, peer: Peer, call: Call, message: Message) -> Message:
        name = name_of(call)
        if name == "ping":
            return self._host.identity()
        if name == "shutdown":
            _check_may_end(peer)
            self._host.stop()
            return {"ok": True}
        labels = {telemetry.ATTR_OPERATION: name}
        outcome, began = "canceled", time.monotonic()
        with tracing.span(telemetry.SPAN_SIDECAR_REQUEST, call.traceparent, labels):
            try:
                reply = await self._answer_by_the_model(name, call, message)
                outcome = "ok"
                return reply
            except VramError as error:
                outcome = labels[telemetry.ATTR_ERROR_TYPE] = error.code
                raise
            finally:
                labels[telemetry.ATTR_OUTCOME] = outcome
                tracing.note(labels)
                meters.measure(telemetry.METRIC_SIDECAR_REQUEST, time.monotonic() - began, labels)

    async def _answer_by_the_model(self, name: str, call: Call, message: Message) -> Message:
        if name == "unload":
            await self._host.unload()
            return {"ok": True}
        if self._pending >= PENDING_MAX:
            raise LimitExceeded(
                f"{PENDING_MAX} requests are waiting",
                hint="wait for answers",
                details={"limit": "pending requests"},
            )
        self._pending += 1
        try:
            if name == "load":
                assert isinstance(call, LoadOp), "of either family"
                return await self._host.load(call.timeout_s)
            assert isinstance(call, DetectOp | QueryOp | ScoreOp | EndpointCall), (
                "the model's own requests"
            )
            return await self._host.run(name, call, message)
        finally:
            self._pending -= 1


def _check_may_end(peer: Peer) -> None:
    """Raises NotPermitted for users other than root and the sidecar's own, and for the sidecar's
    port: behind it every client has the sidecar's user."""
    if peer.uid not in (0, os.getuid()) or peer.pid == os.getpid():
        raise NotPermitted(
            "only root and the sidecar's own user may end it, by its socket",
            hint="stop its unit, or send the program SIGTERM",
            details={"uid": peer.uid},
        )


def parse(message: Message, model_ops: frozenset[str]) -> Call:
    """Parse a decoded message. Raises UnknownOp (details.known) or BadRequest (details.fields)."""
    known = sorted({"ping", "load", "unload", "shutdown"} | model_ops)
    family = family_of(message)
    name = message.get(family)
    if not isinstance(name, str):
        raise BadRequest(
            "a message needs an op or endpoint",
            hint='e.g. {"op": "ping"}',
            details={"known": known},
        )
    if name not in known:
        raise UnknownOp(
            f"unknown {family} {name[:40]!r}",
            hint=f"known: {', '.join(known)}",
            details={"known": known},
        )
    try:
        if family == "op":
            return OP_REQUEST.validate_python(message)
        call = ENDPOINT_REQUEST.validate_python({**message, "data": _unpack(message.get("data"))})
        if name != "load":
            return call
        limit_s = (call.data or {}).get("timeout_s")
        return LoadOp(op="load", timeout_s=limit_s, token=call.token, traceparent=call.traceparent)
    except ValidationError as error:
        # a `load` of the endpoint family has its time limit in `data`
        below = "data." if family == "endpoint" and error.title == LoadOp.__name__ else ""
        fields = [
            below + _field(problem, family)
            for problem in error.errors(include_input=False, include_url=False)
        ]
        raise BadRequest(
            f"{name}: {fields[0]}", hint="see schemas/sidecar.py", details={"fields": fields}
        ) from None


def name_of(call: Call) -> str:
    return call.endpoint if isinstance(call, EndpointCall) else call.op


def family_of(message: Message) -> Family:
    return "endpoint" if "endpoint" in message else "op"


def error_reply(error: VramError, family: Family, *, of_field: bool) -> Message:
    """Return the field's `{"ok": false, "error": "Type: message"}`, without `ok` in the endpoint
    family, with code, hint and details added where the client takes them."""
    text = f"{type(error).__name__}: {error.message}"
    if family == "op":
        return {"ok": False, **error.to_wire(), "error": text}
    if of_field:
        return {"error": f"{text} ({error.hint})" if error.hint else text}
    return {**error.to_wire(), "error": text}


def _in_field_shape(name: str, reply: Message) -> Reply:
    """Return the answer to a request without id as the field's own servers give it."""
    if name == "get_action":
        return [reply, {}]
    if name == "score" and not reply["success"]:  # its clients read the last one
        return {**reply, "success": [0.0] * len(reply["progress"])}
    return reply


def unread_reply(model_ops: frozenset[str]) -> Callable[[VramError], Message]:
    """Return how a host with these operations answers what it cannot read: as its clients expect an
    error of their family."""
    family: Family = "endpoint" if model_ops <= {"get_action", "reset"} else "op"
    return functools.partial(error_reply, family=family, of_field=True)


def _unpack(data: Any) -> Any:
    try:
        return npy.unpack(data)
    except (ValueError, TypeError, KeyError, RecursionError, MemoryError) as error:
        raise BadRequest(
            f"data: {error}", hint="arrays are {'__ndarray_class__': true, 'as_npy': bytes}"
        ) from None


def _field(problem: JsonMap, family: Family) -> str:
    # a union puts its tag, the op, in front
    where = problem["loc"][1:] if family == "op" else problem["loc"]
    return f"{'.'.join(str(part)[:64] for part in where) or 'the message'}: {problem['msg']}"
