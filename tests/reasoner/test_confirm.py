"""Motions that wait for the operator: on the socket and on a terminal."""

import asyncio
import os
import pty
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import play
from vram_arbiter.reasoner.__main__ import answer_motion
from vram_arbiter.reasoner.confirm import Confirmations
from vram_arbiter.reasoner.inbox import Cancel
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome
from vram_arbiter.reasoner.server import operator_server, send
from vram_arbiter.reasoner.task_queue import TaskQueue
from vram_arbiter.schemas.errors import BadState
from vram_arbiter.schemas.reasoner import Result
from vram_arbiter.schemas.tools import ExecuteRskill, QueryScene, ToolCall

pytestmark = pytest.mark.anyio

PALETTE = Palette((Skill("lab/grab", "vla", "grab", ("grasp",)),))
GRAB = ExecuteRskill(rskill_id="lab/grab")


class TwoGrabs:
    async def decide(self, episode: Episode) -> ToolCall | Finish:
        script = (QueryScene(question="?"), GRAB, GRAB)
        done = len(episode.steps)
        return script[done] if done < len(script) else Finish(True, "done")


class Story:
    """An episode whose motions wait, with its socket."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"ipc://{folder}/reasoner.sock"
        self.confirmations = Confirmations()
        self.queue = TaskQueue.of_one("x")
        self.inbox = self.queue.running.inbox
        self.done: list[ToolCall] = []

    async def dispatch(self, call: ToolCall) -> Outcome:
        self.done.append(call)
        return Outcome("succeeded", "")

    async def waits(self, number: int) -> Any:
        while (motion := self.confirmations.pending) is None or motion["number"] != number:
            await asyncio.sleep(0)
        return motion

    async def play(self, operator: Callable[[], Any]) -> Result:
        async with operator_server(self.endpoint, self.queue, self.confirmations):
            dispatch = self.confirmations.before(self.dispatch)
            episode = asyncio.create_task(
                run_episode("x", TwoGrabs(), PALETTE, dispatch, inbox=self.inbox)
            )
            await operator()
            return await episode


def test_a_motion_begins_when_it_is_confirmed_and_not_when_it_is_denied(tmp_path: Path) -> None:
    story = Story(tmp_path)

    async def operator() -> None:
        await story.waits(1)
        assert [call.tool for call in story.done] == ["query_scene"], (
            "a question needs no confirmation"
        )
        told = (await send(story.endpoint, {"op": "state"}))["motion"]
        assert told["number"] == 1
        assert "lab/grab" in told["text"]
        with pytest.raises(BadState, match="motion 1 waits"):
            await send(story.endpoint, {"op": "confirm", "motion": 2, "yes": True})
        await answer_motion(story.endpoint, yes=True, reason="")  # as `--confirm` does
        await story.waits(2)
        with pytest.raises(BadState, match="motion 2 waits"):
            await send(story.endpoint, {"op": "confirm", "motion": 1, "yes": True})
        no = {"op": "confirm", "motion": 2, "yes": False, "reason": "a hand is there"}
        await send(story.endpoint, no)

    result = play(lambda: story.play(operator))
    assert [step["status"] for step in result["steps"]] == ["succeeded", "succeeded", "refused"]
    assert "a hand is there" in result["steps"][-1]["text"]
    assert result["attempts"] == 1
    assert story.done.count(GRAB) == 1


def test_a_cancel_ends_the_wait(tmp_path: Path) -> None:
    story = Story(tmp_path)

    async def operator() -> None:
        await story.waits(1)
        story.inbox.put(Cancel("lunch"))

    result = play(lambda: story.play(operator))
    assert result["reason"] == "canceled: lunch"
    assert GRAB not in story.done
    assert story.confirmations.pending is None


def test_a_line_on_the_terminal_answers_the_motion_that_waits(tmp_path: Path) -> None:
    story = Story(tmp_path)
    ours, theirs = pty.openpty()

    async def operator() -> None:
        await story.waits(1)
        os.write(ours, b"y\n")
        await story.waits(2)
        os.write(ours, b"not so fast\n")

    async def played() -> Result:
        with os.fdopen(theirs) as terminal, story.confirmations.on_terminal(terminal):
            return await story.play(operator)

    try:
        result = play(played)
    finally:
        os.close(ours)
    assert [step["status"] for step in result["steps"]][1:] == ["succeeded", "refused"]
    assert "not so fast" in result["steps"][-1]["text"]


async def test_a_reasoner_without_the_flag_takes_no_confirmation(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/reasoner.sock"

    async with operator_server(endpoint, TaskQueue.of_one("x")):
        assert (await send(endpoint, {"op": "state"}))["motion"] is None
        with pytest.raises(BadState, match="asks for no confirmation"):
            await send(endpoint, {"op": "confirm", "motion": 1, "yes": True})
