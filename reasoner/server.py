"""Operator's access to a reasoner: a small socket for tasks, and for messages to the running one
that bypass the planner.

Speaks `schemas.reasoner`. Both ends are here: the server beside the loop, and `send` for the
command line.
"""

import asyncio
import logging
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from vram_arbiter.clients.net.rpc_client import RpcClient
from vram_arbiter.clients.net.server import Peer, RouterServer, parsed, reason_of, refusal
from vram_arbiter.reasoner.confirm import Confirmations
from vram_arbiter.reasoner.task_queue import TaskQueue
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    ReasonerUnreachable,
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
    GetTaskResult,
    ListTasks,
    ReasonerRequest,
    ReasonerState,
    ResultReply,
    Say,
    SubmitReply,
    SubmitTask,
    TasksReply,
)

log = logging.getLogger(__name__)

SEND_S = 5.0


@asynccontextmanager
async def operator_server(
    endpoint: str, queue: TaskQueue, confirmations: Confirmations | None = None
) -> AsyncIterator[None]:
    """Serve until the block ends. Raises AlreadyRunning when another reasoner serves there."""

    async def handle(peer: Peer, message: Message) -> None:
        number = message.get("id")
        request_id = number if isinstance(number, int) else None
        try:
            reply = {"re": request_id, "ok": True, **_answer(message, queue, confirmations)}
        except VramError as error:
            reply = refusal(request_id, error)
        await server.send(peer, reply)

    async with RouterServer(
        endpoint, lambda error: refusal(None, error), message_max_bytes=MESSAGE_MAX_BYTES
    ) as server:
        serving = asyncio.create_task(server.serve(handle))
        try:
            yield
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)


def _answer(message: Message, queue: TaskQueue, confirmations: Confirmations | None) -> Message:
    match _parse(message):
        case Say(text=text):
            queue.say(text)
        case CancelEpisode(reason=reason, task=number):
            queue.cancel(number, reason or "by an operator")
        case SubmitTask(text=text):
            task = queue.submit(text)
            return dict(SubmitReply(task=task.number, ahead=queue.ahead_of(task)))
        case ListTasks():
            return dict(TasksReply(tasks=[task.view() for task in queue.tasks]))
        case GetTaskResult(task=number):
            task = queue.find(number)
            if task.result is None:
                raise BadState(f"task {number} is not over: {task.state}")
            return dict(ResultReply(result=task.result))
        case ConfirmMotion(motion=number, yes=yes, reason=reason):
            if confirmations is None:
                raise BadState(
                    "this reasoner asks for no confirmation",
                    hint="start it with --require-confirmation",
                )
            confirmations.answer(number, yes=yes, reason=reason)
        case GetEpisode():
            return dict(_state(queue, confirmations))
    return {"pid": os.getpid()}


def _state(queue: TaskQueue, confirmations: Confirmations | None) -> ReasonerState:
    motion = None if confirmations is None else confirmations.pending
    running = queue.running
    queued = sum(task.state == "queued" for task in queue.tasks)
    return {
        "task": running.text if running is not None else "",
        "pid": os.getpid(),
        "motion": motion,
        "queued": queued,
    }


def _parse(message: Message) -> ReasonerRequest:
    if message.get("op") != "cancel":
        return parsed(message, REASONER_REQUEST, OPS)
    number = message.get("task")  # a cancel is never refused for a long reason
    valid = isinstance(number, int) and not isinstance(number, bool) and number > 0
    if number is not None and not valid:  # it would end the wrong task
        raise BadRequest("cancel: task: expected the number of a task", hint="see `tasks`")
    return CancelEpisode(op="cancel", id=0, reason=reason_of(message), task=number)


async def send(endpoint: str, request: Message, *, timeout_s: float = SEND_S) -> Message:
    """Send one request to a running reasoner.

    Raises ReasonerUnreachable, UntrustedServer, or the typed error of its answer.
    """

    def lost(reason: str) -> VramError:
        return ReasonerUnreachable(
            f"contact to {endpoint} lost: {reason}", hint="has the episode ended?"
        )

    client = RpcClient(endpoint, program="reasoner", lost=lost, request_max_bytes=MESSAGE_MAX_BYTES)
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
