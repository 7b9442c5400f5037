"""`vramctl top`: the arbiter live on a whole terminal, with keys for operators."""

import argparse
import asyncio
import os
import sys

from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.schemas.errors import ConfigError

DESCRIPTIONS = {
    "top": "Show GPUs, leases, waiters with their reasons, and events live on a terminal. Keys: s "
    "sort, e evict, p pin, d drain, q quit. Orders need a confirmation and "
    "an operator. NO_COLOR turns colors off."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    check_terminal()
    return asyncio.run(top(args.endpoint))


def check_terminal() -> None:
    """Raise ConfigError unless a person can see and type here. Textual draws on stderr."""
    if not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise ConfigError(
            "vramctl top needs a terminal as its input, output and error output",
            hint="use `vramctl status` once, or `vramctl history -f` for lines of events",
        )
    if os.environ.get("TERM", "dumb") == "dumb":
        raise ConfigError(
            "vramctl top needs a terminal that can move its cursor, TERM says none",
            hint="set TERM, or use `vramctl status` or `vramctl history -f`",
        )


async def top(endpoint: str | None) -> int:
    """Show until `q`. Raises ArbiterUnreachable if no arbiter answers at first; later it waits for
    one."""
    from vram_arbiter.clients.cli.top.app import Top
    from vram_arbiter.clients.cli.top.feed import Feed
    from vram_arbiter.clients.client import AsyncClient
    from vram_arbiter.clients.net.request import TIMEOUT_S

    client = AsyncClient(
        "vramctl top", endpoint=endpoint, role="observer", connect_timeout_s=TIMEOUT_S
    )
    async with client:
        await Top(Feed(client)).run_async()
    return OK
