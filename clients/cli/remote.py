"""`vramctl remote`: a robot's tunnel to a GPU server, over OpenSSH."""

import argparse
import asyncio
import contextlib
import os
import signal
import sys
import time
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli import authorize, text
from vram_arbiter.clients.cli.arguments import add_json, count
from vram_arbiter.clients.cli.replies import NO, OK, answer
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.remote import ssh
from vram_arbiter.clients.remote.tunnel import keep
from vram_arbiter.schemas.errors import AlreadyRunning, VramError
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.endpoints import IPC, SYSTEM_RUNTIME
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder
from vram_arbiter.schemas.runtime.printable import makes_printable
from vram_arbiter.schemas.runtime.systemd import Notifier

DESCRIPTIONS = {
    "remote": "Use the models of a GPU server from a robot: its arbiter and its sidecars, over "
    "OpenSSH. The server's arbiter takes the robot as a guest, which marks uses and holds no lease."
}
ACTIONS: Final = {
    "authorize": "On the server: let a robot's key in, for the arbiter, the sidecars and the doors "
    "that are named. Shows what the robot may then do, and what not.",
    "up": "Keep the tunnel to a server, until it is ended. Ends at once, with a reason, if the "
    "server refuses; after a loss it connects again.",
    "status": "Show each tunnel of this user, and whether the server's arbiter answers.",
}
STATUS_S: Final = 3.0  # to be answered through a tunnel


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    commands = parser.add_subparsers(metavar="ACTION", required=True)
    for name, add in (("authorize", authorize.add), ("up", _add_up), ("status", _add_status)):
        add(commands.add_parser(name, help=ACTIONS[name], description=ACTIONS[name]))


def run(args: argparse.Namespace) -> int:
    return int(args.action(args))


# -- up
def _add_up(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(action=_up)
    parser.add_argument(
        "host", metavar="HOST", help="[USER@]NAME[:PORT]; NAME may be a Host of ~/.ssh/config"
    )
    parser.add_argument("sidecars", metavar="SIDECAR", nargs="*", help="sidecars to forward")
    door = "loopback port of a sidecar's door: here, and there if it differs"
    parser.add_argument(
        "--door", type=_door, action="append", default=[], metavar="PORT[:PORT]", help=door
    )
    parser.add_argument("--identity", type=Path, metavar="FILE", help="the robot's private key")
    place = "the server's folder of sockets (default: %(default)s)"
    parser.add_argument("--server-runtime", default=SYSTEM_RUNTIME, metavar="FOLDER", help=place)


def _door(written: str) -> tuple[int, int]:
    here, _, there = written.partition(":")
    port = count(1, 65535)
    return int(port(here)), int(port(there or here))


def _up(args: argparse.Namespace) -> int:
    """Keep the tunnel until SIGTERM or SIGINT. Raises RemoteRefused, ConfigError,
    AlreadyRunning."""
    folder = ssh.folder_of(args.host, os.environ, os.getuid())
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    hosts, names = settings / "vram-arbiter/known_hosts", (ssh.ARBITER, *args.sidecars)
    tunnel = ssh.Tunnel(
        args.host, folder, hosts, names, tuple(args.door), args.server_runtime, args.identity
    )
    tunnel.command()  # what is wrong with it, before a folder is made
    private_folder(folder.parent.parent, shared=True)
    private_folder(folder.parent)
    private_folder(folder)
    lock = _lock(folder)
    lock.acquire()  # until the program ends
    return asyncio.run(_keep(tunnel))


def _lock(folder: Path) -> LockFile:
    return LockFile(folder / "tunnel.lock", f"the tunnel to {ssh.host_of(folder)}", "a program")


async def _keep(tunnel: ssh.Tunnel) -> int:
    notifier = Notifier(os.environ)

    def tell(line: str, up: bool) -> None:
        print(line, file=sys.stderr, flush=True)
        (notifier.ready if up else notifier.status)(line)

    keeping = asyncio.ensure_future(keep(tunnel, tell))
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, keeping.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await keeping
    return OK


# -- status
def _add_status(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(action=_status)
    add_json(parser)


def _status(args: argparse.Namespace) -> int:
    """Return 0 if every tunnel is up, 1 if one is not or there is none."""
    code, told = answer(_tunnels, as_json=args.as_json, lines=_lines)
    return code if {one["state"] for one in told["tunnels"]} == {"up"} else NO


def _tunnels() -> Message:
    place = ssh.tunnels_folder(os.environ, os.getuid())
    return {"ok": True, "tunnels": [_tunnel(folder) for folder in sorted(place.glob("*"))]}


def _tunnel(folder: Path) -> Message:
    """Return what is known of a tunnel: `state` (up, connecting, down), and if it is up what the
    server's arbiter says."""
    sockets = {path.stem: f"{IPC}{path}" for path in sorted(folder.glob("*.sock"))}
    told: Message = {"host": ssh.host_of(folder), "state": "connecting", "sidecars": sockets}
    endpoint = sockets.pop(ssh.ARBITER, "")
    try:
        _lock(folder).check_free()
        return {**told, "state": "down"}
    except AlreadyRunning:
        return told | (asyncio.run(_asked(endpoint)) if is_listening(endpoint) else {})


async def _asked(endpoint: str) -> Message:
    try:
        async with AsyncClient("vramctl", endpoint=endpoint, connect_timeout_s=STATUS_S) as arbiter:
            began_s = time.monotonic()
            await arbiter.ping(timeout_s=STATUS_S)
            round_trip_ms = round(1e3 * (time.monotonic() - began_s), 2)
            return {"state": "up", "role": arbiter.role, "round_trip_ms": round_trip_ms}
    except VramError as error:
        return {"problem": error.message}


@makes_printable
def _lines(told: Message) -> list[str]:
    if not told["tunnels"]:
        return ["no tunnel; `vramctl remote up HOST` makes one"]
    columns = {"host": "HOST", "state": "STATE", "round_trip_ms": "MS", "role": "ROLE"}
    rows = []
    for one in told["tunnels"]:
        shown = one.get("problem") or ", ".join(one["sidecars"])
        rows.append([*(str(one.get(key, "")) for key in columns), shown])
    return text.table([*columns.values(), "SIDECARS"], rows)
