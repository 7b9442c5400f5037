"""Operators' actions: `evict`, `pin`, `unpin`, `drain`, `resume`, `release-dead`."""

import argparse
from functools import partial

from vram_arbiter.clients.cli import arguments, text
from vram_arbiter.clients.cli.replies import answer
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.wire.requests import REQUESTS

DESCRIPTIONS = {
    "evict": "Revoke a lease. A use in flight finishes first; a pinned lease is refused. With "
    "--kill end the process of a stuck holder: SIGTERM, and SIGKILL when it is asked for again; "
    "refused while another process uses one of its leases, or it uses one of another process. "
    "Operators only.",
    "pin": "Protect a lease from eviction until it is unpinned. Operators only.",
    "unpin": "Undo an operator's pin. Operators only.",
    "drain": "Grant nothing new until `vramctl resume`; holders keep their leases. Outlives the "
    "daemon, not the machine. Operators only.",
    "resume": "Grant again after a drain. Operators only.",
    "release-dead": "End the lease of a silent holder before its TTL is over; its bytes are still "
    "measured gone. Refused for a lease in use, and for a holder that was heard. Operators only.",
}
_WITH_TARGET = frozenset({"evict", "pin", "unpin", "release-dead"})
_WITHOUT_REASON = frozenset({"unpin", "resume"})


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    if command in _WITH_TARGET:
        parser.add_argument(
            "target",
            metavar="TARGET",
            type=arguments.name,
            help="a lease (L3-17), or a consumer that has exactly one",
        )
    if command == "evict":
        parser.add_argument(
            "--kill", action="store_true", help="end its process: SIGTERM; asked for again, SIGKILL"
        )
    optional = command in _WITHOUT_REASON
    parser.add_argument(
        "-r",
        "--reason",
        required=not optional,
        default="",
        type=arguments.remark if optional else arguments.reason,
        help="why; kept in history with your name",
    )
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    kill = args.command_name == "evict" and args.kill
    action = "kill" if kill else args.command_name.replace("-", "_")
    target = (args.target,) if args.command_name in _WITH_TARGET else ()
    code, _ = answer(
        partial(ask, REQUESTS[action](args.reason, *target), args.endpoint, role="operator"),
        as_json=args.as_json,
        lines=lambda reply: text.by_hand_lines(action, reply),
    )
    return code
