"""The version of this installation, and `--version` for programs on argparse. Reads it only when it
is asked for."""

import argparse
from collections.abc import Sequence
from typing import Any

DISTRIBUTION = "vram-arbiter"


def version() -> str:
    """Of the installed distribution; `0+source` for a source tree that is not installed."""
    from importlib import metadata  # costs more than `vram-runner estop` may take

    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return "0+source"


def add_version(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")


class _Version(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        print(f"{DISTRIBUTION} {version()}")
        parser.exit()
