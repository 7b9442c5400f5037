"""`vram-runner episodes --dataset DIR`: recorded episodes, their ends and the operator's marks."""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path

from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.recording import commit
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.printable import printable_lines


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner episodes`."""
    episodes = commands.add_parser(
        "episodes", help="list recorded episodes and the operator's marks"
    )
    episodes.add_argument("--dataset", type=Path, required=True)
    episodes.add_argument(
        "--marked", choices=("success", "failure"),
        help="print only the numbers of these episodes, as lerobot's --dataset.episodes takes them",
    )  # fmt: skip
    return episodes


async def run(args: argparse.Namespace) -> int:
    """Print the episodes. Raises ConfigError for a folder that was not recorded into."""
    if not commit.is_ours(args.dataset):
        raise ConfigError(f"{args.dataset} is not a dataset that this program recorded")
    notes = await asyncio.to_thread(commit.notes, args.dataset)
    if args.marked is not None:
        print([note["episode"] for note in notes if note.get("marked") == args.marked])
        return 0
    for note in notes:
        mark = f", marked {note['marked']}" if "marked" in note else ""
        line = (
            f"{note['episode']:>5} {note['frames']:>6} frames {note['skill']} {note['task']!r}:"
            f" {note['status']}{mark}"
        )
        print(printable_lines(line))
    return 0
