"""`vramctl status`: GPUs, leases and the queue."""

import argparse
from functools import partial

from vram_arbiter.clients.cli import text
from vram_arbiter.clients.cli.arguments import add_endpoint, add_json
from vram_arbiter.clients.cli.replies import answer
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.wire.requests import Status

DESCRIPTIONS = {"status": "Show GPUs, leases and the queue."}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add_json(parser)
    add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    code, _ = answer(
        partial(all_pages, args.endpoint), as_json=args.as_json, lines=text.status_lines
    )
    return code


def all_pages(endpoint: str | None) -> Message:
    """Return the whole status; the arbiter sends its leases in pages."""
    reply = ask(Status(), endpoint)
    after = reply.pop("next", None)
    while after is not None:
        page = ask(Status(after=after), endpoint)
        if not page.get("ok"):
            return page
        reply["leases"] += page["leases"]
        after = page.get("next")
    return reply
