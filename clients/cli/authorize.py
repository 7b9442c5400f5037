"""`vramctl remote authorize`: let a robot's key in on this GPU server."""

import argparse
import os
import pwd
import re
import shlex
from collections.abc import Callable
from pathlib import Path

from vram_arbiter.clients.cli.arguments import count
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.remote import authorize
from vram_arbiter.clients.remote.authorize import Guest
from vram_arbiter.schemas.errors import InstallFailed
from vram_arbiter.schemas.runtime.endpoints import SYSTEM_RUNTIME

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


_name = _of(authorize.NAME, "at most 27 of a-z, 0-9, _ and -, a letter first")
_sidecar = _of(authorize.SIDECAR, "the name of a sidecar")
_folder = _of(authorize.FOLDER, "an absolute path of letters, digits and _.@+-")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `remote authorize`."""
    parser.set_defaults(action=run)
    parser.add_argument("key", metavar="KEY", type=Path, help="the robot's public key, a .pub file")
    parser.add_argument("--name", required=True, type=_name, help="the robot's name, such as arm1")
    parser.add_argument(
        "--sidecar",
        type=_sidecar,
        action="append",
        default=[],
        metavar="NAME",
        help="a sidecar that it may reach",
    )
    parser.add_argument(
        "--door",
        type=count(1, 65535),
        action="append",
        default=[],
        metavar="PORT",
        help="loopback port of a sidecar's door that it may reach",
    )
    parser.add_argument(
        "--runtime",
        default=SYSTEM_RUNTIME,
        type=_folder,
        metavar="FOLDER",
        help="this server's folder of sockets (default: %(default)s)",
    )
    parser.add_argument(
        "--install", action="store_true", help="make the user and write its key, as root"
    )


def run(args: argparse.Namespace) -> int:
    """Print what lets the robot in, or do it. Raises ConfigError, InstallFailed."""
    guest = Guest(
        args.name,
        authorize.read_key(args.key),
        tuple(args.sidecar),
        tuple(args.door),
        args.runtime,
    )
    exists = _exists(guest.user)
    if args.install:
        if os.geteuid() != 0:
            raise InstallFailed("only root makes users", hint="run it with sudo")
        authorize.install(guest, exists=exists)
    print("\n".join(_lines(guest, exists=exists, installed=args.install)))
    return OK


def _lines(guest: Guest, *, exists: bool, installed: bool) -> list[str]:
    told = [guest.line, "", f"{guest.user} may, as a guest of this server's arbiter, open"]
    told += [f"  {one}" for one in guest.reached]
    told += ["and may not", *(f"  {one}" for one in MAY_NOT)]
    if installed:
        return [*told, "", f"wrote {guest.file}"]
    commands = [shlex.join(command) for command in guest.commands(exists=exists)]
    write = f"install -D -m 644 /dev/stdin {guest.file} <<< {shlex.quote(guest.line)}"
    return [*told, "", "as root, or with --install:", *(f"  {one}" for one in (*commands, write))]


def _exists(user: str) -> bool:
    try:
        pwd.getpwnam(user)
    except KeyError:
        return False
    return True
