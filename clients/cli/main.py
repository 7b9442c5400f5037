"""Command line of `vramctl`: the table of commands and how one of them is run.

Each command is a module of this package with `add_arguments(parser)` and `run(args)`, which returns
the exit code; only the module of the command that runs is imported.
"""

import argparse
import difflib
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients.cli.replies import NO, OK, UNREACHABLE, USAGE, complain
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    ConfigError,
    UntrustedServer,
    VramError,
)
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.version import add_version

if TYPE_CHECKING:
    from vram_arbiter.schemas.runtime.telemetry.commands import Command as Running

FLUSH_S = 1.0
"""How long a command waits for its telemetry collector: a person waits for the prompt."""

DESCRIPTION = "See and use the VRAM arbiter: leases, the queue, and leases for any program."
EPILOG = """\
Exit codes: 0 done, 1 the answer is no or an error, 2 wrong usage, 3 the arbiter cannot be reached,
74 the output cannot be written.
Sizes are printed in GiB and MiB (1024-based); write 8GiB, 5.3GB or 450MiB.
VRAM_ARBITER_ENDPOINT or VRAM_ARBITER_RUNTIME name the arbiter's socket; VRAM_ARBITER_SERVER_USERS
names users that may serve it beside root, yourself and vram-arbiter."""


@dataclass(frozen=True, slots=True)
class Command:
    """One line of the table. `passes_on`: another program parses the arguments. `wraps`: what
    follows `--` is another program's command line, in `args.program`."""

    module: str
    summary: str
    traced: bool = True
    passes_on: bool = False
    wraps: bool = False


COMMANDS: Mapping[str, Command] = {
    "status": Command("status", "show GPUs, leases and the queue", traced=False),
    "why": Command("why", "explain why a consumer is not running", traced=False),
    "history": Command("history", "list grants, evictions and verdicts with their reasons"),
    "timeline": Command(
        "timeline.command", "draw GPU memory over time, also as .png or a Perfetto trace"
    ),
    "top": Command("top.command", "show everything live on a full screen, with operator keys"),
    "evict": Command("operators", "revoke a lease; a use in flight finishes first"),
    "pin": Command("operators", "protect a lease from eviction until it is unpinned"),
    "unpin": Command("operators", "undo an operator's pin"),
    "drain": Command("operators", "grant nothing new until `vramctl resume`"),
    "resume": Command("operators", "grant again after a drain"),
    "release-dead": Command("operators", "end the lease of a silent holder"),
    "run": Command("run", "run a program under a lease: vramctl run --vram 5GiB -- COMMAND"),
    "calibrate": Command(
        "calibrate", "measure what a model or a program needs, for the footprint file", wraps=True
    ),
    "remote": Command("remote", "use the models of a GPU server, over OpenSSH", traced=False),
    "doctor": Command("doctor", "check the installation, the daemon and its GPUs"),
    "selftest": Command("selftest", "prove on this machine's GPU what the product claims of it"),
    "install": Command("install", "make the arbiter a service, after showing the plan"),
    "uninstall": Command("install", "remove what `vramctl install` put on this machine"),
    "fleet": Command("fleet", "see the boxes of a Ray cluster, and where a model would go"),
    "mcp": Command("mcp", "serve status, why and history to agents"),
    "replay": Command("offline", "replay a recorded event log", passes_on=True),
    "demo": Command("demo", "run find, navigate and grab on a simulated arm in 8 GiB"),
}


@terminal.program
def run_main(argv: Sequence[str]) -> int:
    """Run one command. Returns the exit code."""
    if not argv or argv[0] not in COMMANDS:
        return _overview(argv)
    name, *rest = argv
    chosen = COMMANDS[name]
    module = import_module(f"vram_arbiter.clients.cli.{chosen.module}")
    # what follows `run` is another program's, and a self-test writes its JSON to a file
    as_json = "--json" in _own(rest) and name not in ("run", "selftest")
    try:
        with _span(name, traced=chosen.traced) as running:
            if chosen.passes_on:
                running.code = module.run(name, rest)
            else:
                running.code = _parse_and_run(name, module, rest)
            return int(running.code)
    except VramError as error:
        complain(error.to_wire(), as_json=as_json)
        if isinstance(error, ConfigError):
            return USAGE
        unreachable = isinstance(error, ArbiterUnreachable | UntrustedServer)
        return UNREACHABLE if unreachable else NO


def command_parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of one command; not of one that another program parses."""
    module = import_module(f"vram_arbiter.clients.cli.{COMMANDS[name].module}")
    parser = argparse.ArgumentParser(
        prog=f"vramctl {name}",
        description=module.DESCRIPTIONS[name],
        allow_abbrev=False,
    )
    module.add_arguments(parser, name)
    add_version(parser)
    return parser


def _parse_and_run(name: str, module: Any, arguments: Sequence[str]) -> int:
    parser = command_parser(name)
    wraps = COMMANDS[name].wraps
    args = parser.parse_args(_own(arguments) if wraps else arguments)
    args.command_name, args.parser = name, parser
    if wraps:
        args.program = list(arguments[len(_own(arguments)) + 1 :])
    return int(module.run(args))


def _own(arguments: Sequence[str]) -> Sequence[str]:
    """Return the arguments before `--`."""
    return arguments[: arguments.index("--")] if "--" in arguments else arguments


def _overview(argv: Sequence[str]) -> int:
    """Show help or the version, or refuse an unknown command."""
    parser = argparse.ArgumentParser(
        prog="vramctl",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_version(parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        commands.add_parser(name, help=command.summary)
    if not argv:
        parser.print_help(sys.stderr)
        return USAGE
    if close := difflib.get_close_matches(argv[0], COMMANDS, n=1):
        parser.error(f"unknown command {argv[0]!r}; did you mean {close[0]}?")
    parser.parse_args(argv)
    return OK


def _span(name: str, *, traced: bool) -> "AbstractContextManager[Running | _Untraced]":
    """Return the context of one command: a span if telemetry is asked for, else nothing."""
    if not traced or not any(variable.startswith("OTEL_") for variable in os.environ):
        return nullcontext(_Untraced())
    from vram_arbiter.schemas.runtime.telemetry.commands import command

    return command("vramctl", name, flush_s=FLUSH_S)


@dataclass(slots=True)
class _Untraced:
    code: int = OK


def main() -> None:
    """Entry point of `vramctl`."""
    sys.exit(run_main(sys.argv[1:]))
