"""Command line of the runner: a thin dispatcher, one module per command (`runner/cli/COMMAND.py`).

A command's module has `add_parser(commands)`, which returns its parser, and `async run(args)`,
which returns the exit code: 0 ended on request, 1 failed, 2 wrong usage or configuration. `SERVES =
True` marks a server: each of its requests has a trace of its own.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module

from vram_arbiter.schemas.errors import ConfigError, EstopRequested, ManifestInvalid, VramError
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.telemetry.commands import Command, command
from vram_arbiter.schemas.runtime.version import add_version

COMMANDS = (
    "sim", "benchmark", "deploy", "estop", "goal", "state", "frame", "reset", "mark", "takeover",
    "record", "episodes", "replay", "ros2", "rosbag",
)  # fmt: skip
URGENT = "estop"
CLIENTS = (URGENT, "goal", "state", "frame", "reset", "mark", "takeover", "record")  # without a GPU


def parser(names: Sequence[str] = COMMANDS) -> argparse.ArgumentParser:
    """Return the parser of `vram-runner` with these commands; `args.run` is the command."""
    made = argparse.ArgumentParser(
        prog="vram-runner", description="Runs a robot's skills and serves goals and frames."
    )
    add_version(made)
    commands = made.add_subparsers(dest="command", required=True)
    for name in names:
        module = import_module(f"vram_arbiter.runner.cli.{name}")
        flags = module.add_parser(commands)
        add_version(flags)
        flags.add_argument(
            "--log-level", default="info", choices=("debug", "info", "warning", "error")
        )
        flags.add_argument(
            "--log-format", default="human", choices=logs.FORMS, help="json: one object a line"
        )
        flags.set_defaults(run=module.run, serves=getattr(module, "SERVES", False))
    return made


def parse(argv: list[str] | None) -> argparse.Namespace:
    """Parse the command line; only the module of its command is imported: a second of imports is a
    second of motion before an emergency stop."""
    given = sys.argv[1:] if argv is None else argv
    known = bool(given) and given[0] in COMMANDS
    args = parser(given[:1] if known else COMMANDS).parse_args(given)
    args.argv = given  # for a command that starts itself elsewhere
    return args


@terminal.program
def main(argv: list[str] | None = None) -> int:
    """Console script `vram-runner`."""
    args = parse(argv)
    logs.set_up(
        "vram-runner",
        args.log_level,
        args.log_format,
        "%(asctime)s runner %(levelname)s %(message)s",
    )
    logging.getLogger("OpenGL").setLevel(
        logging.WARNING
    )  # it announces an accelerator that this program does not use
    try:
        # a stop has no span: neither telemetry variables nor the runner's own port may refuse it
        urgent = args.command == URGENT
        with (
            nullcontext(Command())
            if urgent
            else command("vram-runner", args.command, serves=args.serves) as running
        ):
            if args.command not in CLIENTS:
                import_module("vram_arbiter.runner.gpu_memory").observe_gpu()
            running.code = asyncio.run(args.run(args))
    except VramError as error:
        terminal.complain("vram-runner", error)
        a_person_has_to_act = isinstance(error, ConfigError | ManifestInvalid | EstopRequested)
        return 2 if a_person_has_to_act else 1
    return running.code


if __name__ == "__main__":
    sys.exit(main())
