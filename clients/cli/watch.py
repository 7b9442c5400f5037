"""`vramctl watch`: the status, live, with the newest events below; plain event lines where the
output is no terminal."""

import argparse
import asyncio
import contextlib
import sys
from collections import deque

from vram_arbiter.clients.cli import arguments, text
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.request import TIMEOUT_S
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.plain import JsonObject

REFRESH_S = 0.5
"""Between two readings of the status; every event refreshes at once as well."""


DESCRIPTIONS = {
    "watch": "Show leases and events live; plain lines of events where the output is not a "
    "terminal. Ctrl-C ends it."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument(
        "--events",
        type=arguments.count(0, 200),
        default=12,
        help="events shown below the table (default: %(default)s)",
    )
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    return asyncio.run(watch(args.endpoint, args.events))


async def watch(endpoint: str | None, events_shown: int) -> int:
    """Show until Ctrl-C. Raises ArbiterUnreachable if no arbiter answers at first; later it waits
    for one."""
    client = AsyncClient(
        "vramctl watch", endpoint=endpoint, role="observer", connect_timeout_s=TIMEOUT_S
    )
    async with client:
        with contextlib.suppress(asyncio.CancelledError):
            if sys.stdout.isatty():
                await _live(client, events_shown)
            else:
                async for event in client.subscribe():
                    print(text.event_line(event), flush=True)
    return OK


async def _live(client: AsyncClient, events_shown: int) -> None:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    newest: deque[JsonObject] = deque(maxlen=max(1, events_shown))
    changed = asyncio.Event()

    async def follow() -> None:
        async for event in client.subscribe():
            newest.append(dict(event))
            changed.set()

    following = asyncio.create_task(follow())
    try:
        with Live(console=Console(), auto_refresh=False, screen=True) as live:
            lines: list[str] = ["…"]
            while not following.done():
                if client.connected:
                    lines = text.status_lines(to_map(await client.status()))
                else:
                    lines = [
                        f"no contact to the arbiter at {client.endpoint}; what it said last:",
                        "",
                        *lines[-40:],
                    ]
                shown = [text.event_line(event) for event in newest][-events_shown or len(newest) :]
                live.update(
                    Text("\n".join([*lines, "", *shown]), no_wrap=True, overflow="ellipsis"),
                    refresh=True,
                )
                changed.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), REFRESH_S)
        await following
    finally:
        following.cancel()
