"""`vram-runner reset [--seed N]`: restart the scene of a running simulator."""

from __future__ import annotations

import argparse

from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, show


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner reset`."""
    reset = commands.add_parser("reset", help="restart the scene of a running simulator")
    reset.add_argument("--seed", type=int, help="seed of another scene; default: the current one")
    add_client_flags(reset)
    return reset


async def run(args: argparse.Namespace) -> int:
    """Reset the scene. Raises BadState while a goal runs, and what the client raises."""
    async with client_of(args) as client:
        answer = await client.reset(args.seed)
    show(f"the scene of seed {answer['seed']} stands")
    return 0
