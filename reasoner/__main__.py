"""`vram-reasoner`: run one task with the present runner and sidecars, or message a running one.

Exit codes: 0 the task succeeded, 1 it failed, 2 wrong usage or configuration, 3 the runner, or the
addressed reasoner, cannot be reached.
"""

import argparse
import asyncio
import json
import os
import signal
import sys
from contextlib import nullcontext

from vram_arbiter.reasoner.confirm import Confirmations
from vram_arbiter.reasoner.inbox import Cancel, Inbox
from vram_arbiter.reasoner.loop import nothing_done
from vram_arbiter.reasoner.options import check_task, endpoint, language_model, parser
from vram_arbiter.reasoner.server import OperatorServer, send
from vram_arbiter.reasoner.workplace import Workplace
from vram_arbiter.schemas.errors import (
    BadState,
    ConfigError,
    ReasonerUnreachable,
    RunnerUnreachable,
    SidecarUnavailable,
    VramError,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.reasoner import Result
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.telemetry.commands import command

EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE = 1, 2, 3


@terminal.program
def main() -> int:
    arguments = parser(__doc__).parse_args()
    logs.set_up("vram-reasoner", "info", arguments.log_format, "%(asctime)s %(name)s %(message)s")
    try:
        with command("vram-reasoner", _command(arguments)):
            _main(arguments)
    except ConfigError as error:  # of the telemetry: everything else is said within
        return _complain(error, EXIT_USAGE)
    return 0


def _command(arguments: argparse.Namespace) -> str:
    if arguments.task is not None:
        return "task"
    if arguments.say is not None:
        return "say"
    return "cancel" if arguments.cancel is not None else "confirm"


def _main(arguments: argparse.Namespace) -> None:
    """Exits with the code, unless that is 0."""
    try:
        if arguments.task is None:
            asyncio.run(_speak(arguments))
            return
        result = asyncio.run(_one_task(arguments))
    except (RunnerUnreachable, SidecarUnavailable, ReasonerUnreachable) as error:
        sys.exit(_complain(error, EXIT_UNREACHABLE))
    except VramError as error:
        sys.exit(_complain(error, EXIT_USAGE))
    if arguments.result is not None:
        arguments.result.write_text(json.dumps(result, indent=2) + "\n")
    sys.exit(0 if result["status"] == "success" else EXIT_FAILED)


def _complain(error: VramError, code: int) -> int:
    terminal.complain("vram-reasoner", error)
    return code


async def _speak(arguments: argparse.Namespace) -> None:
    """Send one message to a running reasoner."""
    at = endpoint(arguments.listen, "reasoner")
    request: Message
    if arguments.say is not None:
        request = {"op": "say", "text": arguments.say}
    elif arguments.cancel is not None:
        request = {"op": "cancel", "reason": arguments.cancel}
    else:
        motion = (await send(at, {"op": "state"}))["motion"]
        if motion is None:
            raise BadState("no motion waits for a confirmation")
        yes, reason = arguments.confirm, arguments.deny or ""
        request = {"op": "confirm", "motion": motion["number"], "yes": yes, "reason": reason}
        print(f"{'confirmed' if yes else 'denied'}: {motion['text']}")
    await send(at, request)


async def _one_task(arguments: argparse.Namespace) -> Result:
    """Run a task; a signal ends it like an operator's cancel, so that there is a result."""
    check_task(arguments.task)
    llm, playbook = language_model(arguments, os.environ)
    inbox = Inbox()
    confirmations = Confirmations() if arguments.require_confirmation else None
    workplace = Workplace(arguments, llm, playbook, confirmations)
    here, heard = asyncio.current_task(), list[str]()
    assert here is not None, "inside asyncio.run there is a current task"

    def stop(number: signal.Signals) -> None:
        heard.append(number.name)
        if workplace.began and len(heard) == 1:
            inbox.put(Cancel(f"by {number.name}"))
        else:  # nothing moves yet, or the goal's end takes too long for somebody
            here.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop, number)
    at = endpoint(arguments.listen, "reasoner")
    try:
        async with workplace, OperatorServer(at, arguments.task, inbox, confirmations):
            with confirmations.on_terminal(sys.stdin) if confirmations else nullcontext():
                return await workplace.perform(arguments.task, inbox)
    except asyncio.CancelledError:
        return nothing_done(arguments.task, f"canceled: by {' and '.join(heard)}")


if __name__ == "__main__":
    sys.exit(main())
