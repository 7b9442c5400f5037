"""`vram-runner record TASK`: demonstrations by the teleoperator, one episode after the other.

Each is a goal of the operator's skill on a runner that records, and is kept or dropped at its end.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import sys
from collections.abc import Iterator

from vram_arbiter.clients.cli.arguments import count
from vram_arbiter.clients.runner import Goal, RunnerClient
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, note, show
from vram_arbiter.runner.skills.teleop import NAME
from vram_arbiter.schemas.errors import BadState, Cancelled, ConfigError, UnknownSkill, VramError

READ_BYTES = 4096


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner record`."""
    record = commands.add_parser("record", help="record demonstrations by the teleoperator")
    record.add_argument("task", help="what is done, in words: the episodes' task")
    record.add_argument("--episodes", type=count(1), default=1, help="to keep; default 1")
    add_client_flags(record)
    return record


async def run(args: argparse.Namespace) -> int:
    """Record until enough episodes are kept; `q` ends it earlier.

    Returns: 0 as many as asked for are kept, 1 fewer. Raises ConfigError for a robot without a
    teleoperator, BadState for a runner that records nothing, Cancelled when stdin ends.
    """
    answers, kept = Answers(), 0
    async with client_of(args) as client:
        if not (await client.state())["recorded"]:
            hint = "name a save_dir in the robot's file"
            raise BadState("this runner records nothing", hint=hint)
        with answers.heard():
            while kept < args.episodes:
                question = f"episode {kept + 1} of {args.episodes}: Enter begins it, q ends"
                if await answers.ask(question, ("", "q")) == "q":
                    break
                kept += await _episode(client, args.task, answers)
    show(f"{kept} of {args.episodes} episodes are kept")
    return 0 if kept == args.episodes else 1


async def _episode(client: RunnerClient, task: str, answers: Answers) -> bool:
    """Record one; return whether it is kept. An interrupted one is dropped."""
    try:
        goal = await client.send_goal(NAME, prompt=task)
    except UnknownSkill as error:
        hint = "name a teleoperator under `teleop` in the robot's file"
        raise ConfigError(f"the robot has no teleoperator: {error.message}", hint=hint) from error
    try:
        await _play(client, goal, answers)
        result = await goal.result()
        note(f"goal {goal.goal_id}: {result['status']} {result['message']}".rstrip())
        kept = await answers.ask("k keeps the episode, d drops it", ("k", "d")) == "k"
    except BaseException:
        with contextlib.suppress(VramError):  # it may have no rows yet, or the runner is gone
            await client.mark("discard", goal.goal_id)
        with contextlib.suppress(VramError):
            await goal.cancel()
        raise
    try:
        await client.mark("success" if kept else "discard", goal.goal_id)
    except VramError as error:  # of too few rows there is no episode
        note(f"goal {goal.goal_id} is not recorded: {error.message}")
        return False
    return kept


async def _play(client: RunnerClient, goal: Goal, answers: Answers) -> None:
    """Wait until the operator ends the goal, or it ends by itself."""
    asking = asyncio.create_task(answers.ask("Enter ends the episode", ("",)))
    ending = asyncio.create_task(goal.result())
    try:
        await asyncio.wait([asking, ending], return_when=asyncio.FIRST_COMPLETED)
        if not ending.done():
            asking.result()
            await client.take_over("end", goal.goal_id)
    finally:
        asking.cancel()
        ending.cancel()
        await asyncio.gather(asking, ending, return_exceptions=True)


class Answers:
    """Lines of stdin."""

    def __init__(self) -> None:
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._fd = sys.stdin.fileno()

    @contextlib.contextmanager
    def heard(self) -> Iterator[None]:
        """Listen within the block. Raises ConfigError for a stdin that cannot be waited for."""
        loop = asyncio.get_running_loop()
        try:
            loop.add_reader(self._fd, self._hear)
        except PermissionError as error:
            raise ConfigError("stdin is a file", hint="answer at a terminal") from error
        try:
            yield
        finally:
            loop.remove_reader(self._fd)

    def _hear(self) -> None:
        data = os.read(self._fd, READ_BYTES)
        for line in data.decode(errors="replace").splitlines():
            self._lines.put_nowait(line.strip().lower())
        if not data:
            asyncio.get_running_loop().remove_reader(self._fd)
            self._lines.put_nowait(None)

    async def ask(self, question: str, known: tuple[str, ...]) -> str:
        """Return one of the known answers. Raises Cancelled when stdin ends."""
        note(question)
        while (line := await self._lines.get()) not in known:
            if line is None:
                raise Cancelled("stdin has ended: nobody answers")
            note(question)
        return line
