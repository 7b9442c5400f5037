"""`vram-runner estop`: emergency stop of this machine's runners.

Without an endpoint it stops the runner of this login and the system service's, where they exist.
Exits 0 only when their motors have been told.
"""

from __future__ import annotations

import argparse
import asyncio
import os

from vram_arbiter.clients.estop import ANSWER_S, stop
from vram_arbiter.runner.cli import Commands
from vram_arbiter.schemas.errors import ConfigError, RunnerUnreachable, UntrustedServer
from vram_arbiter.schemas.estop import path_of
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.endpoints import SYSTEM_RUNTIME, program_endpoint, socket_path
from vram_arbiter.schemas.runtime.printable import printable


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner estop`."""
    estop = commands.add_parser(
        "estop", help="stop a robot's motors; its runner refuses goals until it is started again"
    )
    estop.add_argument("--reason", default="", help="kept in the log and in every refusal")
    estop.add_argument(
        "--endpoint",
        help="the runner's endpoint; default: ipc://RUNTIME/runner.sock and the system service's,"
        " where they exist",
    )
    return estop


async def run(args: argparse.Namespace) -> int:
    """Stop the runners.

    Returns: 0 when all motors were told. Raises, after all others have been told, RunnerUnreachable
    for a runner that does not answer, InternalError for a control loop that hangs, RobotFault for
    motors that could not be told.
    """
    endpoints = [args.endpoint] if args.endpoint else _there()
    outcomes = await asyncio.gather(
        *(_stop(endpoint, args.reason) for endpoint in endpoints), return_exceptions=True
    )
    errors = [outcome for outcome in outcomes if isinstance(outcome, BaseException)]
    for text in outcomes:
        if isinstance(text, str):
            print(printable(text))
    for error in errors[1:]:
        terminal.complain("vram-runner", error)
    if errors:
        raise errors[0]
    return 0


def _there() -> list[str]:
    """Return the endpoints of possible runners: this login's, and the system service's."""
    system = f"ipc://{SYSTEM_RUNTIME}/runner.sock"
    try:
        own = program_endpoint("runner", os.environ, os.getuid())
    except ConfigError:  # a user without a login session may still stop the system's
        own = system
    # os.path: a folder without permission must not keep the other runner from being stopped
    there = [name for name in dict.fromkeys((own, system)) if _exists(name)]
    return there or [own]


def _exists(endpoint: str) -> bool:
    try:
        return os.path.exists(path_of(endpoint)) or os.path.exists(socket_path(endpoint))
    except (
        ConfigError
    ):  # a runtime folder that cannot be one: the other runner is stopped all the same
        return False


async def _stop(endpoint: str, reason: str) -> str:
    try:
        stopped = await asyncio.to_thread(stop, endpoint, reason, timeout_s=ANSWER_S)
    except (RunnerUnreachable, UntrustedServer) as error:
        hint = "if a robot moves, cut its power"
        raise type(error)(error.message, hint=hint, details=error.details) from error
    return f"{stopped.robot or endpoint}: {stopped.message}"  # which one: there may be several
