"""The runner's command line: a thin dispatcher, one module a command (`runner/cli_COMMAND.py`).

A command's module has `add_parser(commands)`, which returns its parser, and `async run(args)`, which returns the exit code: 0 ended on
request, 1 failed, 2 wrong usage or configuration.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import sys
from types import ModuleType

from runner import cli_benchmark, cli_deploy, cli_estop, cli_sim
from schemas.errors import ConfigError, VramError

COMMANDS: tuple[ModuleType, ...] = (cli_sim, cli_benchmark, cli_deploy, cli_estop)


def parse(argv: list[str] | None) -> argparse.Namespace:
    """The flags of `vram-runner`; `args.run` is the command."""
    parser = argparse.ArgumentParser(
        prog="vram-runner", description="Runs a robot's skills and serves goals and frames."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for module in COMMANDS:
        command = module.add_parser(commands)
        command.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
        command.set_defaults(run=module.run)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Console script `vram-runner`."""
    args = parse(argv)
    logging.basicConfig(
        level=args.log_level.upper(), stream=sys.stderr, format="%(asctime)s runner %(levelname)s %(message)s"
    )
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # it announces an accelerator that nobody needs
    try:
        code: int = asyncio.run(args.run(args))
    except VramError as error:
        print(f"vram-runner: {error}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    return code


if __name__ == "__main__":
    sys.exit(main())
