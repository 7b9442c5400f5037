"""Shell completion of `vramctl`, generated from the parsers of its commands (shtab).

The scripts are static: completing a word starts no program.
"""

import argparse
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.main import COMMANDS, DESCRIPTION, EPILOG, command_parser

PLACES: Final = {
    "bash": Path("bash-completion/completions/vramctl"),
    "zsh": Path("zsh/site-functions/_vramctl"),
    "fish": Path("fish/vendor_completions.d/vramctl.fish"),
}
"""Below a folder of shared data, where each shell looks by itself."""


def completions() -> dict[Path, str]:
    """Return the script of each shell by its place."""
    import shtab  # only an installation needs it

    parser = whole_parser()
    (commands,) = (one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    for name, command in COMMANDS.items():
        commands.choices[name].description = command.summary  # a line beside each word
    return {place: shtab.complete(parser, shell=shell) for shell, place in PLACES.items()}


def whole_parser() -> argparse.ArgumentParser:
    """Return one parser of all commands; the program itself imports only the one that runs.

    A command that another program parses has no arguments here.
    """
    parser = argparse.ArgumentParser(prog="vramctl", description=DESCRIPTION, epilog=EPILOG)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        commands.add_parser(name, help=command.summary)
        if not command.passes_on:
            commands.choices[name] = command_parser(name)
    return parser
