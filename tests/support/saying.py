"""What a program of the tests tells the test that started it, JSON with one event a line, and what
it is told."""

import asyncio
import json
import sys


def say(event: str, **facts: object) -> None:
    """Print one event at once."""
    print(json.dumps({"event": event, **facts}), flush=True)


async def told_lines() -> asyncio.StreamReader:
    """Return a reader of the standard input."""
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    return reader
