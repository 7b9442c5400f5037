"""`vram-runner goal OWNER/SKILL [PROMPT]`: send a goal to a running runner and await its result."""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

from vram_arbiter.clients.cli.arguments import count, positive
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, note, show_json
from vram_arbiter.schemas.plain import JsonMap

if TYPE_CHECKING:
    from vram_arbiter.schemas.goals import FeedbackPush


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner goal`."""
    goal = commands.add_parser(
        "goal", help="send a goal to a running runner and wait for its result"
    )
    goal.add_argument("skill", metavar="OWNER/SKILL")
    goal.add_argument("prompt", nargs="?", default="")
    goal.add_argument(
        "--params", type=_object, default={}, metavar="JSON", help="the goal's parameters"
    )
    goal.add_argument("--deadline", type=positive, default=0.0, metavar="SECONDS")
    goal.add_argument("--max-ticks", type=count(1))
    goal.add_argument("--id", help="name of the goal; default: a new one")
    add_client_flags(goal)
    return goal


async def run(args: argparse.Namespace) -> int:
    """Send the goal, show its progress on stderr and its result on stdout; Ctrl-C cancels it.

    Returns: 0 it succeeded, 1 it did not. Raises what the client raises.
    """
    async with client_of(args) as client:
        goal = await client.send_goal(
            args.skill,
            prompt=args.prompt,
            goal_params=args.params,
            deadline_s=args.deadline,
            max_ticks=args.max_ticks,
            goal_id=args.id,
        )
        loop, canceling = asyncio.get_running_loop(), set[asyncio.Task[None]]()

        def cancel(number: signal.Signals) -> None:
            loop.remove_signal_handler(number)  # a second one ends this program
            note(f"canceling goal {goal.goal_id}")
            canceling.add(loop.create_task(goal.cancel()))

        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, cancel, number)
        showing = loop.create_task(_show_progress(goal.goal_id, goal.feedback()))
        try:
            result = await goal.result()
        finally:
            showing.cancel()
            await asyncio.gather(showing, *canceling, return_exceptions=True)
    show_json(result)
    return 0 if result["success"] else 1


async def _show_progress(goal_id: str, feedback: AsyncIterator[FeedbackPush]) -> None:
    said = ""
    async for push in feedback:
        detail = f": {push['detail']}" if push["detail"] else ""
        text = f"goal {goal_id}: {push['state']} {push['progress']:.0%}{detail}"
        if text != said:
            note(text)
        said = text


def _object(text: str) -> JsonMap:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a JSON object: {error}") from error
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"expected a JSON object, got {text!r}")
    return value
