"""`vram-runner mark success|failure|discard`: the operator's verdict on a recorded episode."""

from __future__ import annotations

import argparse

from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, show


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner mark`."""
    mark = commands.add_parser(
        "mark", help="mark the recorded episode of the running goal, or of the last one"
    )
    mark.add_argument("verdict", choices=("success", "failure", "discard"))
    mark.add_argument("--goal", default="", help="only if the goal is this one")
    add_client_flags(mark)
    return mark


async def run(args: argparse.Namespace) -> int:
    """Mark the episode. Raises BadState where nothing is recorded, BadRequest for another goal."""
    async with client_of(args) as client:
        answer = await client.mark(args.verdict, args.goal)
    episode = answer["episode"]
    place = "once it ends" if episode is None else f"episode {episode}"
    show(f"goal {answer['goal_id']}, {place}: {args.verdict}")
    return 0
