"""`--display` of a serving command: ticks, the state between goals and the arbiter's leases."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from collections import Counter
from pathlib import Path

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.display.display import Display
from vram_arbiter.runner.protocols import InferenceRunner
from vram_arbiter.schemas.errors import VramError

LEASES_PERIOD_S = 1.0


def add_display_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--display", metavar="rerun",
        help="show cameras, state, actions, leases and goal: rerun starts the viewer,"
        " rerun+http://HOST:PORT/proxy connects to one, FILE.rrd is written",
    )  # fmt: skip


def check_display_flag(args: argparse.Namespace) -> None:
    """Raise ConfigError for an unknown target or missing packages, before anything is opened."""
    if args.display is not None:
        from vram_arbiter.runner.display.stream import check_display

        check_display(args.display)
        if args.display.endswith(".rrd"):
            check_output("--display", Path(args.display))


def display_runner(
    args: argparse.Namespace,
    runner: InferenceRunner,
    name: str,
    arbiter: AsyncClient | None,
    stack: contextlib.AsyncExitStack,
) -> None:
    """Show the runner until the stack is left, beside its recorder."""
    if args.display is None:
        return
    from vram_arbiter.runner.display.stream import RerunStream

    display = Display(lambda: RerunStream(args.display, name), lambda: runner.world)
    stack.push_async_callback(asyncio.to_thread, display.close)
    runner.follow(display)
    if arbiter is not None:
        polling = asyncio.create_task(_show_leases(arbiter, display), name="leases' display")
        stack.callback(polling.cancel)


async def _show_leases(arbiter: AsyncClient, display: Display) -> None:
    while True:
        with contextlib.suppress(VramError):  # a daemon that restarts is asked again
            charged: Counter[str] = Counter()
            for lease in (await arbiter.status()).leases:
                charged[lease.consumer] += lease.charge_bytes
            display.leases(charged)
        await asyncio.sleep(LEASES_PERIOD_S)
