"""Shell completion of `vramctl`, generated from the parsers of its commands (shtab).

The scripts are static: completing a word starts no program.
"""

import argparse
from importlib import import_module
from pathlib import Path
from typing import Final

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
    return {place: shtab.complete(parser, shell=shell) for shell, place in PLACES.items()}


def whole_parser() -> argparse.ArgumentParser:
    """Return one parser with the arguments of every command of `vramctl`."""
    from vram_arbiter.clients.cli.main import COMMANDS

    parser = argparse.ArgumentParser(prog="vramctl", allow_abbrev=False)
    commands = parser.add_subparsers(metavar="COMMAND")
    for name, command in COMMANDS.items():
        made = commands.add_parser(name, help=command.summary)
        if not command.passes_on:  # another program parses these
            module = import_module(f"vram_arbiter.clients.cli.{command.module}")
            module.add_arguments(made, name)
    return parser
