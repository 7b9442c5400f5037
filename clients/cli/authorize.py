"""`vramctl remote authorize`: let a robot's key in on this GPU server."""

import argparse
import os
import re
import shlex
from collections.abc import Callable
from pathlib import Path

from vram_arbiter.clients.cli.arguments import count
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.remote import authorize
from vram_arbiter.clients.remote.authorize import Guest
from vram_arbiter.schemas.runtime.endpoints import RUNTIME_VARIABLE, SYSTEM_RUNTIME

MAY_NOT = (
    "hold a lease, evict, pin or drain", "open another socket or port", "listen on this machine",
    "run a command, open a terminal, copy files",
)  # fmt: skip


def _of(pattern: str, what: str) -> Callable[[str], str]:
    def check(written: str) -> str:
        if not re.fullmatch(pattern, written):
            raise argparse.ArgumentTypeError(f"expected {what}, got {written!r}")
        return written

    return check


# of a robot's, `vram-` before it makes a Unix user's; neither may have what the key's line parts
_NAME = _of(r"[a-z][a-z0-9_-]{0,26}", "at most 27 of a-z, 0-9, _ and -, a letter first")
_SIDECAR = _of(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", "the name of a sidecar")
_PORT = count(1, 65535)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `remote authorize`."""
    parser.set_defaults(action=run)
    parser.add_argument("key", metavar="KEY", type=Path, help="the robot's public key, a .pub file")
    parser.add_argument("--name", required=True, type=_NAME, help="the robot's name, such as arm1")
    for flag, kind, value, what in (
        ("--sidecar", _SIDECAR, "NAME", "a sidecar that it may reach"),
        ("--door", _PORT, "PORT", "loopback port of a sidecar's door that it may reach"),
    ):
        parser.add_argument(flag, type=kind, action="append", default=[], metavar=value, help=what)
    parser.add_argument("--install", action="store_true", help="make the user, write its key")


def run(args: argparse.Namespace) -> int:
    """Print what lets the robot in, or do it. Raises ConfigError, InstallFailed."""
    runtime = os.environ.get(RUNTIME_VARIABLE, SYSTEM_RUNTIME)
    key = authorize.read_key(args.key)
    guest = Guest(args.name, key, tuple(args.sidecar), tuple(args.door), runtime)
    if args.install:
        authorize.install(guest)
        left = [f"wrote {guest.file}"]
    else:
        made, joined, written = map(shlex.join, guest.commands())
        commands = (made, joined, f"{written} <<< {shlex.quote(guest.line)}")
        left = ["as root, or with --install:", *(f"  {one}" for one in commands)]
    told = [guest.line, "", f"{guest.user} may, as a guest of this server's arbiter, open"]
    told += [f"  {one}" for one in guest.reached]
    print("\n".join([*told, "and may not", *(f"  {one}" for one in MAY_NOT), "", *left]))
    return OK
