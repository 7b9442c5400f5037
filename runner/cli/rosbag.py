"""`vram-runner rosbag --dataset DIR --episode N --out BAG`: a recorded episode for ROS 2."""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path

from vram_arbiter.clients.cli.arguments import count
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import note


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner rosbag`."""
    rosbag = commands.add_parser("rosbag", help="export a recorded episode as a rosbag2 (MCAP)")
    rosbag.add_argument("--dataset", type=Path, required=True, help="folder of the recording")
    rosbag.add_argument("--episode", type=count(0), required=True)
    rosbag.add_argument("--out", type=Path, required=True, help="the bag's folder, which is new")
    return rosbag


async def run(args: argparse.Namespace) -> int:
    """Write the bag. Raises ConfigError for a bad folder, BadRequest for a missing episode."""
    from vram_arbiter.runner.recording.rosbag import export

    count = await asyncio.to_thread(export, args.dataset, args.episode, args.out)
    note(f"{count} messages of episode {args.episode} in {args.out}")
    return 0
