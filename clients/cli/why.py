"""`vramctl why`: what keeps a consumer from running."""

import argparse
from functools import partial

from vram_arbiter.clients.cli import arguments, terminal, text
from vram_arbiter.clients.cli.replies import ENVELOPE, NO, OK, answer
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.wire.requests import AskWhy

INDENT = len("  blocked   ")

DESCRIPTIONS = {
    "why": "Explain why CONSUMER is not running: which leases block it, how many bytes, on which "
    "condition, what happens next and when. Exits 1 if it neither holds nor waits for a lease."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument(
        "consumer",
        metavar="CONSUMER",
        type=arguments.name,
        help="a consumer or a lease, as `status` shows it",
    )
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    code, reply = answer(
        partial(ask, AskWhy(args.consumer), args.endpoint),
        as_json=args.as_json,
        lines=_lines,
        hidden=ENVELOPE | {"epoch"},
    )
    return NO if code == OK and not reply["leases"] else code


def _lines(why: Message) -> list[str]:
    width = terminal.columns()
    return [part for line in text.why_lines(why) for part in terminal.folded(line, INDENT, width)]
