"""`vram-runner estop`: the emergency stop of a running runner. Exits 0 only when the motors have been told."""

from __future__ import annotations

import argparse

from clients.runner import RunnerClient
from schemas.errors import RunnerUnreachable

ANSWER_S = 3.0  # the server itself waits a second for its control loop


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """The flags of `vram-runner estop`."""
    estop = commands.add_parser(
        "estop", help="stop a robot's motors; its runner refuses goals until it is started again"
    )
    estop.add_argument("--reason", default="", help="kept in the log and in every refusal")
    estop.add_argument("--endpoint", help="the runner's endpoint; default ipc://RUNTIME/runner.sock")
    return estop


async def run(args: argparse.Namespace) -> int:
    """Raises RunnerUnreachable when no runner answers, InternalError when its control loop does not, RobotFault when the motors
    could not be told."""
    async with RunnerClient(args.endpoint, timeout_s=ANSWER_S) as runner:
        try:
            reply = await runner.estop(args.reason)
        except RunnerUnreachable as error:
            hint = "if a robot moves, cut its power"
            raise RunnerUnreachable(error.message, hint=hint, details=error.details) from error
    print(
        f"{reply.get('robot') or runner.endpoint}: {reply['message']}"
    )  # which one: a machine may have several
    return 0
