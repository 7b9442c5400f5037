"""Which user serves a socket, by the kernel's word, and whether a client may believe it.

A client trusts root, its own user, the unit's user for the program it asks (`SERVICE_USERS`) and
the users named in `VRAM_ARBITER_SERVER_USERS`. A folder that others may write, or a socket left by
another user, is then no danger: the check is about the process that listens, not about files. A
loopback port, where the servers of the field listen, is looked up in the kernel's table of sockets.
It must not know what is said on the socket.
"""

import os
import pwd
import socket
import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

from vram_arbiter.schemas.errors import ConfigError, UntrustedServer
from vram_arbiter.schemas.runtime.peercred import credentials

USERS_VARIABLE: Final = "VRAM_ARBITER_SERVER_USERS"
ROOT: Final = 0

Program = Literal["arbiter", "runner", "sidecar", "reasoner"]
SERVICE_USERS: Final[Mapping[Program, str]] = {
    "arbiter": "vram-arbiter",
    "runner": "vram-robot",
    "sidecar": "vram-sidecar",
    "reasoner": "vram-robot",
}
"""The users of configs/systemd. Only root can make a user of such a name."""

_TABLES: Final = ("/proc/self/net/tcp", "/proc/self/net/tcp6")
_NOT_ACCEPTED: Final = ("01", "03")  # established, its handshake
_LISTEN: Final = "0A"
_MAPPED: Final = bytes(10) + b"\xff\xff"
"""Before an IPv4 address in the table of IPv6."""
_ANY: Final = ("00000000", "0" * 32)


def check_server(connected: socket.socket, program: Program, where: str) -> None:
    """Check the process that listens at the other end of a connected unix socket, before anything
    is sent or believed.

    `where` names the endpoint in the error. Raises UntrustedServer, ConfigError for a
    `VRAM_ARBITER_SERVER_USERS` that names unknown users.
    """
    check_uid(server_uid(connected), program, where)


def server_uid(connected: socket.socket) -> int:
    """The uid of the process that called listen() on the other end of a connected unix socket
    (SO_PEERCRED)."""
    return credentials(connected)[1]


def port_uids(connected: socket.socket) -> set[int]:
    """The users of the process at the other end of a loopback connection over TCP.

    That is the owner of the other end; while no process has accepted it, of every socket that
    listens there. Empty: there is no other end any more. Raises OSError.
    """
    there = connected.getpeername()
    ours = _in_tables(connected.family, connected.getsockname())
    theirs = _in_tables(connected.family, there)
    listens = theirs + [f"{address}:{there[1]:04X}" for address in _ANY]
    listening: set[int] = set()
    waiting = False
    for table in _TABLES:
        try:
            with open(table, encoding="ascii") as file:
                lines = file.read().splitlines()[1:]
        except FileNotFoundError:  # a kernel without IPv6
            continue
        for line in lines:
            _, local, remote, state, _, _, _, uid, _, inode, *_ = line.split()
            if local in theirs and remote in ours:
                if inode != "0":
                    return {int(uid)}
                waiting |= state in _NOT_ACCEPTED
            elif state == _LISTEN and local in listens:
                listening.add(int(uid))
    return listening if waiting else set()


def _in_tables(family: int, end: Sequence[Any]) -> list[str]:
    """An end as the kernel's tables have it: words in the machine's order, and the port. One of
    IPv4 may stand in both tables."""
    packed = socket.inet_pton(family, end[0].partition("%")[0])
    found = [packed, _MAPPED + packed] if family == socket.AF_INET else [packed]
    words = ["".join(f"{word:08X}" for (word,) in struct.iter_unpack("=I", one)) for one in found]
    return [f"{address}:{end[1]:04X}" for address in words]


def frame_uid(peer_address: object) -> int | None:
    """The uid in libzmq's `Peer-Address` of a frame (`localhost:UID:GID:PID` on ipc), None where it
    names none."""
    parts = peer_address.rsplit(":", 3) if isinstance(peer_address, str) else []
    return (
        int(parts[1]) if len(parts) == 4 and all(part.isdecimal() for part in parts[1:]) else None
    )


def check_uid(
    uid: int, program: Program, where: str, environ: Mapping[str, str] | None = None
) -> None:
    """Raises UntrustedServer unless a `program` that `uid` serves may be believed."""
    if trusts(uid, program, environ):
        return
    user = _name_of(uid)
    raise UntrustedServer(
        f"{where} is served by uid {uid}{f' ({user})' if user else ''}, not by a user that may "
        f"serve the {program}",
        hint=f"nothing was sent to it; if it may serve, set {USERS_VARIABLE}={uid}",
        details={"endpoint": where, "uid": uid, "user": user, "program": program},
    )


def trusts(uid: int, program: Program, environ: Mapping[str, str] | None = None) -> bool:
    """Whether a `program` that `uid` serves may be believed. Raises ConfigError as `check_server`
    does."""
    if uid in (ROOT, os.geteuid()):
        return True
    if _name_of(uid) == SERVICE_USERS[program]:
        return True
    chosen = (os.environ if environ is None else environ).get(USERS_VARIABLE, "")
    return uid in [_uid_of(user.strip()) for user in chosen.split(",") if user.strip()]


def _name_of(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return ""


def _uid_of(user: str) -> int:
    if user.isdecimal():
        return int(user)
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        raise ConfigError(
            f"{USERS_VARIABLE} names {user!r}, which is not a user of this machine",
            hint="write user names or uids, separated by commas",
        ) from None
