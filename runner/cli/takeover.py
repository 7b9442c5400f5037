"""`vram-runner takeover [take|give-back|end]`: the operator's hand on the goal that runs."""

from __future__ import annotations

import argparse

from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, show

SAID = {
    "take": "the robot follows the teleoperator",
    "give-back": "the skill starts again where the robot is",
    "end": "ended as done",
}


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner takeover`."""
    takeover = commands.add_parser(
        "takeover", help="take the robot from the running goal's skill by the teleoperator"
    )
    takeover.add_argument(
        "do", nargs="?", default="take", choices=tuple(SAID),
        help="take it (default), give it back to the skill, or end the goal as done",
    )  # fmt: skip
    takeover.add_argument("--goal", default="", help="only if the goal is this one")
    add_client_flags(takeover)
    return takeover


async def run(args: argparse.Namespace) -> int:
    """Change hands. Raises BadState where that cannot be, RobotFault for a dead teleoperator."""
    async with client_of(args) as client:
        answer = await client.take_over(args.do.replace("-", "_"), args.goal)
    show(f"goal {answer['goal_id']}: {SAID[args.do]}")
    return 0
