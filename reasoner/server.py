"""Operator's access to a running episode: a small socket whose messages bypass the planner.

Speaks `schemas.reasoner`. Both ends are here: the server beside the loop, and `send` for
`vram-reasoner --say` and `--cancel`.
"""

import asyncio
import logging
import os
from typing import Any, Self

from pydantic import ValidationError

from vram_arbiter.clients.net.rpc_client import RpcClient
from vram_arbiter.clients.net.server import Peer, RouterServer, reason_of
from vram_arbiter.reasoner.confirm import Confirmations
from vram_arbiter.reasoner.inbox import Cancel, Inbox, Said
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    ReasonerUnreachable,
    UnknownOp,
    VramError,
    from_wire,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.reasoner import (
    OPS,
    REASONER_REQUEST,
    CancelEpisode,
    ConfirmMotion,
    GetEpisode,
    Say,
    StateReply,
)

log = logging.getLogger(__name__)

SEND_S = 5.0


class OperatorServer:
    """`async with OperatorServer(endpoint, task, inbox)`: serve until the block ends.

    Raises AlreadyRunning when another reasoner serves there.
    """

    def __init__(
        self,
        endpoint: str,
        task: str,
        inbox: Inbox,
        confirmations: Confirmations | None = None,
    ) -> None:
        self._task_text = task
        self._inbox = inbox
        self._confirmations = confirmations
        self._server = RouterServer(
            endpoint, lambda error: _refusal(None, error), message_max_bytes=MESSAGE_MAX_BYTES
        )
        self._serving: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self._server.__aenter__()
        self._serving = asyncio.create_task(self._server.serve(self._handle))
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._serving is not None:
            self._serving.cancel()
            await asyncio.gather(self._serving, return_exceptions=True)
        await self._server.__aexit__()

    async def _handle(self, peer: Peer, message: Message) -> None:
        number = message.get("id")
        request_id = number if isinstance(number, int) else None
        try:
            reply = self._answer(message)
        except VramError as error:
            await self._server.send(peer, _refusal(request_id, error))
        else:
            await self._server.send(peer, {"re": request_id, "ok": True, **reply})

    def _answer(self, message: Message) -> Message:
        match _parse(message):
            case Say(text=text):
                self._inbox.put(Said(text))
            case CancelEpisode(reason=reason):
                self._inbox.put(Cancel(reason or "by an operator"))
            case ConfirmMotion(motion=number, yes=yes, reason=reason):
                if self._confirmations is None:
                    raise BadState(
                        "this reasoner asks for no confirmation",
                        hint="start it with --require-confirmation",
                    )
                self._confirmations.answer(number, yes=yes, reason=reason)
            case GetEpisode():
                return dict(self._state())
        return {"pid": os.getpid()}

    def _state(self) -> StateReply:
        motion = None if self._confirmations is None else self._confirmations.pending
        return {"task": self._task_text, "pid": os.getpid(), "motion": motion}


def _parse(message: Message) -> Any:
    if message.get("op") not in OPS:
        raise UnknownOp(
            f"unknown op {str(message.get('op'))[:64]!r}",
            hint=f"one of {', '.join(OPS)}",
            details={"known": [*OPS]},
        )
    if message["op"] == "cancel":  # a cancel is never refused for a long reason
        return CancelEpisode(op="cancel", id=0, reason=reason_of(message))
    try:
        return REASONER_REQUEST.validate_python(message)
    except ValidationError as error:
        problems = [
            f"{'.'.join(str(part)[:64] for part in item['loc'][1:])}: {item['msg']}"
            for item in error.errors(include_url=False, include_input=False)
        ]
        raise BadRequest(f"{message['op']}: {'; '.join(problems)}") from error


def _refusal(request_id: int | None, error: VramError) -> Message:
    return {"re": request_id, "ok": False, "error": error.to_wire()}


async def send(endpoint: str, request: Message, *, timeout_s: float = SEND_S) -> Message:
    """Send one request to a running reasoner.

    Raises ReasonerUnreachable, UntrustedServer, or the typed error of its answer.
    """

    def lost(reason: str) -> VramError:
        return ReasonerUnreachable(
            f"contact to {endpoint} lost: {reason}", hint="has the episode ended?"
        )

    client = RpcClient(endpoint, program="reasoner", lost=lost)
    try:
        reply: Message = await client.exchange(request, timeout_s)
    except TimeoutError:
        raise ReasonerUnreachable(
            f"no reasoner answers at {endpoint} within {timeout_s:g} s", hint="does an episode run?"
        ) from None
    finally:
        client.drop(lost("the client was closed"))
    if not reply.get("ok"):
        raise from_wire(reply.get("error") or {})
    return reply
