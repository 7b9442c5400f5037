"""Who is at the other end of a connection: the kernel's word, never the message's.

On an `ipc://` socket libzmq keeps the peer's credentials (SO_PEERCRED, taken when the connection was made) as the frame property
`Peer-Address`: `localhost:UID:GID:PID`. A pid alone is reused, so it is joined with the process start time from /proc. Must not know
sessions or requests.
"""

import grp
import os
import pwd
from dataclasses import dataclass
from typing import Literal

from schemas.errors import NotPermitted
from schemas.ids import ProcessKey

Role = Literal["client", "observer", "operator"]


@dataclass(frozen=True, slots=True)
class Credentials:
    """What the kernel said about a peer when it connected."""

    uid: int
    gid: int
    pid: int


@dataclass(frozen=True, slots=True)
class Peer:
    """A living process at the other end."""

    credentials: Credentials
    process: ProcessKey


def parse_peer_address(text: str) -> Credentials:
    """Read `localhost:UID:GID:PID` strictly from the right: the part before may itself hold colons.

    Raises ValueError on anything else, pid 0 included (a process of another pid namespace that we cannot see).
    """
    parts = text.rsplit(":", 3)
    if len(parts) != 4 or not all(part.isascii() and part.isdecimal() for part in parts[1:]):
        raise ValueError(f"not the address of a local peer: {text!r}")
    uid, gid, pid = (int(part) for part in parts[1:])
    if pid == 0:
        raise ValueError("the peer's process is not visible from here (another pid namespace)")
    return Credentials(uid, gid, pid)


def start_ticks(pid: int) -> int | None:
    """Field 22 of /proc/PID/stat; None if there is no such process. The name in field 2 may hold spaces and parentheses."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            stat = file.read()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return int(stat[stat.rindex(b")") + 2 :].split()[19])


def identify(address: str) -> Peer:
    """The process behind a peer address. Raises NotPermitted if it cannot be known or has ended."""
    if address.endswith(":0"):
        raise NotPermitted(
            "the process at the other end cannot be seen from here: it runs in another pid namespace, not below the arbiter's",
            hint="run the arbiter in the host's pid namespace (docker: --pid=host); clients may be in containers",
        )
    try:
        credentials = parse_peer_address(address)
    except ValueError as error:
        raise NotPermitted(str(error), hint="connect over the ipc:// endpoint of this machine") from error
    ticks = start_ticks(credentials.pid)
    if ticks is None:
        raise NotPermitted(f"process {credentials.pid} has ended")
    return Peer(credentials, ProcessKey(credentials.pid, ticks))


def is_operator(peer: Credentials, operators_gid: int | None) -> bool:
    """Root, the daemon's own user, or a member (primary or supplementary) of the operators' group."""
    if peer.uid in (0, os.getuid()):
        return True
    if operators_gid is None:
        return False
    if peer.gid == operators_gid:
        return True
    try:
        account = pwd.getpwuid(peer.uid)
    except KeyError:
        return False
    return operators_gid in os.getgrouplist(account.pw_name, account.pw_gid)


def how_to_operate(operators_gid: int | None) -> str:
    """What a peer that may not act by hand can do, with the group's name."""
    if operators_gid is None:
        return "use its user or root, or let the daemon name a group (wire.operators_group); looking is open to observers"
    try:
        name = grp.getgrgid(operators_gid).gr_name
    except KeyError:
        name = str(operators_gid)
    return f"use its user or root, or join the group {name} (wire.operators_group, then log in again); looking is open to observers"


def group_id(name: str) -> int | None:
    """Number of a Unix group; None if there is none of that name."""
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        return None
