"""An operator's way into a running episode: over the socket, past the planner."""

import asyncio
from pathlib import Path

import pytest

from vram_arbiter.reasoner.inbox import Cancel, Inbox, Said
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome
from vram_arbiter.reasoner.server import operator_server, send
from vram_arbiter.reasoner.task_queue import TaskQueue
from vram_arbiter.schemas.errors import AlreadyRunning, BadRequest, ReasonerUnreachable, UnknownOp
from vram_arbiter.schemas.tools import ToolCall

pytestmark = pytest.mark.anyio


def one_task(text: str) -> tuple[TaskQueue, Inbox]:
    queue = TaskQueue.of_one(text)
    return queue, queue.running.inbox


async def test_words_and_a_cancel_reach_the_inbox(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/reasoner.sock"

    queue, inbox = one_task("tidy up")
    async with operator_server(endpoint, queue):
        await send(endpoint, {"op": "say", "text": "mind the cat"})
        await send(endpoint, {"op": "cancel"})
        assert (await send(endpoint, {"op": "state"}))["task"] == "tidy up"
        assert (await send(endpoint, {"op": "ping"}))["ok"]
    found = inbox.take()
    assert found == [Cancel("by an operator"), Said("mind the cat")]


async def test_what_is_no_request_is_refused_and_the_server_lives(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/reasoner.sock"

    queue, inbox = one_task("x")
    async with operator_server(endpoint, queue):
        for wrong, error in (
            ({"op": "execute"}, UnknownOp),
            ({"op": "say"}, BadRequest),
            ({"op": "say", "text": "x" * 9000}, BadRequest),
            ({"op": "say", "text": "x", "shout": True}, BadRequest),
        ):
            with pytest.raises(error):
                await send(endpoint, wrong)
        await send(endpoint, {"op": "ping"})
        with pytest.raises(AlreadyRunning):
            async with operator_server(endpoint, queue):
                pass
    with pytest.raises(ReasonerUnreachable):
        await send(endpoint, {"op": "ping"}, timeout_s=0.1)
    found = inbox.take()
    assert found == []


async def test_a_cancel_over_the_socket_ends_an_episode_whose_planner_hangs(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/reasoner.sock"

    class Hanging:
        async def decide(self, episode: Episode) -> ToolCall | Finish:
            await asyncio.Event().wait()
            raise AssertionError("never set")

    async def dispatch(call: ToolCall) -> Outcome:
        raise AssertionError("nothing was decided")

    queue, inbox = one_task("x")
    async with operator_server(endpoint, queue):
        episode = asyncio.create_task(
            run_episode("x", Hanging(), Palette(()), dispatch, inbox=inbox)
        )
        await send(endpoint, {"op": "cancel", "reason": "lunch"})
        found = (await episode)["reason"]
    assert found == "canceled: lunch"


async def test_a_cancel_is_not_refused_for_its_words(tmp_path: Path) -> None:
    """Regression: the length of the reason was checked before the cancel was obeyed."""
    endpoint = f"ipc://{tmp_path}/reasoner.sock"

    queue, inbox = one_task("tidy up")
    async with operator_server(endpoint, queue):
        await send(endpoint, {"op": "cancel", "reason": "the cat\n" * 1000, "by": "a newer client"})
    (cancel,) = inbox.take()
    assert isinstance(cancel, Cancel)
    assert cancel.reason.startswith("the cat the cat")
    assert len(cancel.reason) <= 500
