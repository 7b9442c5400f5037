"""`vram-reasoner`: run one task with the present runner and sidecars, serve tasks one after the
other, or message a running reasoner.

Exit codes: 0 the task succeeded or the service was ended, 1 the task failed, 2 wrong usage or
configuration, 3 the runner, or the addressed reasoner, cannot be reached.
"""

import argparse
import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from collections.abc import Awaitable, Callable
from contextlib import nullcontext

from vram_arbiter.reasoner.confirm import Confirmations
from vram_arbiter.reasoner.json_lines import JsonLines
from vram_arbiter.reasoner.options import (
    check_files,
    check_task,
    endpoint,
    language_model,
    parser,
)
from vram_arbiter.reasoner.results import nothing_done
from vram_arbiter.reasoner.server import operator_server, send
from vram_arbiter.reasoner.service import serve
from vram_arbiter.reasoner.task_queue import Task, TaskQueue
from vram_arbiter.reasoner.workplace import Workplace
from vram_arbiter.schemas.errors import (
    BadState,
    ConfigError,
    ReasonerUnreachable,
    RunnerUnreachable,
    SidecarUnavailable,
    VramError,
)
from vram_arbiter.schemas.reasoner import HistoryLine, Result
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.telemetry.commands import command

log = logging.getLogger(__name__)

EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE = 1, 2, 3


@terminal.program
def main() -> int:
    arguments = parser(__doc__).parse_args()
    logs.set_up("vram-reasoner", "info", arguments.log_format, "%(asctime)s %(name)s %(message)s")
    name = _command(arguments)
    try:
        with command("vram-reasoner", name, serves=name == "serve"):
            _main(arguments, name)
    except ConfigError as error:  # of the telemetry: everything else is said within
        return _complain(error, EXIT_USAGE)
    return 0


def _command(arguments: argparse.Namespace) -> str:
    if arguments.command is not None:
        return str(arguments.command)
    for name in ("task", "say", "cancel", "submit"):
        if getattr(arguments, name) is not None:
            return name
    return "tasks" if arguments.tasks else "confirm"


def _main(arguments: argparse.Namespace, name: str) -> None:
    """Exits with the code, unless that is 0."""
    try:
        if name not in ("task", "serve"):
            asyncio.run(speak(arguments, name))
            return
        check_files(arguments)
        result = asyncio.run(_serve(arguments) if name == "serve" else _one_task(arguments))
    except (RunnerUnreachable, SidecarUnavailable, ReasonerUnreachable) as error:
        sys.exit(_complain(error, EXIT_UNREACHABLE))
    except VramError as error:
        sys.exit(_complain(error, EXIT_USAGE))
    if result is None:
        return
    if arguments.result is not None:
        arguments.result.write_text(json.dumps(result, indent=2) + "\n")
    sys.exit(0 if result["status"] == "success" else EXIT_FAILED)


def _complain(error: VramError, code: int) -> int:
    terminal.complain("vram-reasoner", error)
    return code


async def speak(arguments: argparse.Namespace, name: str) -> None:
    """Send one message to a running reasoner."""
    at = endpoint(arguments.listen, "reasoner")
    match name:
        case "say":
            await send(at, {"op": "say", "text": arguments.say})
        case "cancel":
            number = {} if arguments.number is None else {"task": arguments.number}
            await send(at, {"op": "cancel", "reason": arguments.cancel} | number)
        case "submit":
            reply = await send(at, {"op": "submit", "text": arguments.submit})
            print(f"task {reply['task']}, {reply['ahead']} before it")
        case "tasks":
            for task in (await send(at, {"op": "tasks"}))["tasks"]:
                print(json.dumps(task))
        case _:
            await answer_motion(at, yes=arguments.confirm, reason=arguments.deny or "")


async def answer_motion(at: str, *, yes: bool, reason: str) -> None:
    """Confirm or deny the motion that waits there. Raises BadState if none does."""
    motion = (await send(at, {"op": "state"}))["motion"]
    if motion is None:
        raise BadState("no motion waits for a confirmation")
    number = motion["number"]
    await send(at, {"op": "confirm", "motion": number, "yes": yes, "reason": reason})
    print(f"{'confirmed' if yes else 'denied'}: {motion['text']}")


async def _one_task(arguments: argparse.Namespace) -> Result:
    """Run a task; a signal ends it like an operator's cancel, so that there is a result."""
    check_task(arguments.task, arguments.planner)
    queue = TaskQueue.of_one(arguments.task)
    task = queue.running
    assert task is not None, "it begins at once"
    result: Result | None = None

    async def perform(workplace: Workplace) -> None:
        nonlocal result
        result = await workplace.perform(task.text, task.inbox)

    ended_by = await _work(arguments, queue, perform)
    return result or nothing_done(task.text, f"canceled: {ended_by}")


async def _serve(arguments: argparse.Namespace) -> None:
    """Serve tasks until a signal comes, which ends the running one like an operator's cancel."""
    history = JsonLines(arguments.history, "--history")

    def ended(task: Task) -> None:
        if task.result is not None:
            history.add(HistoryLine(task=task.view(), result=task.result))

    queue = TaskQueue(lambda text: check_task(text, arguments.planner), ended)

    async def perform(workplace: Workplace) -> None:
        log.info("serving tasks on %s", endpoint(arguments.listen, "reasoner"))
        await serve(queue, workplace)

    try:
        await _work(arguments, queue, perform)
    finally:
        history.close()


async def _work(
    arguments: argparse.Namespace,
    queue: TaskQueue,
    perform: Callable[[Workplace], Awaitable[None]],
) -> str:
    """Work with connections and the operator's socket until done or signaled. Returns the signals
    that came.
    """
    llm, playbook = language_model(arguments, os.environ)
    confirmations = Confirmations() if arguments.require_confirmation else None
    workplace = Workplace(arguments, llm, playbook, confirmations)
    here, heard = asyncio.current_task(), list[str]()
    assert here is not None, "inside asyncio.run there is a current task"

    def stop(number: signal.Signals) -> None:
        heard.append(f"by {number.name}")
        queue.stop(heard[-1])
        if not workplace.busy or len(heard) > 1:  # a second signal does not wait for a goal's end
            here.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop, number)
    at = endpoint(arguments.listen, "reasoner")
    with contextlib.suppress(asyncio.CancelledError):
        async with workplace, operator_server(at, queue, confirmations):
            with nullcontext() if confirmations is None else confirmations.on_terminal(sys.stdin):
                await perform(workplace)
    return " and ".join(heard)


if __name__ == "__main__":
    sys.exit(main())
