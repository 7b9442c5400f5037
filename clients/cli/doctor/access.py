"""Checks of the way to the arbiter: its socket, the user that serves it, users with access."""

import os
import stat
from collections.abc import Iterator

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, error, note, warning
from vram_arbiter.clients.cli.doctor.machine import Machine, unix_sockets
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.endpoints import EXAMPLE, SYSTEM_RUNTIME, socket_path

SYSTEM_SOCKET = f"{SYSTEM_RUNTIME}/arbiter.sock"


def socket(m: Machine) -> Iterator[Finding]:
    """An arbiter that may be believed answers at the endpoint."""
    try:
        path = socket_path(m.endpoint)
    except ConfigError as wrong:
        yield error("socket.endpoint", wrong.message, f"export VRAM_ARBITER_ENDPOINT={EXAMPLE}")
        return
    problem = m.arbiter.problem
    if problem is None:
        return
    said = problem.message
    if problem.code == "untrusted_server":
        found = m.stat(path)
        uid = "" if found is None else str(found.st_uid)
        yield error("socket.untrusted", said, f"export VRAM_ARBITER_SERVER_USERS={uid}")
    elif path != SYSTEM_SOCKET and unix_sockets(m).get(SYSTEM_SOCKET):
        what = f"no arbiter at {m.endpoint}, and the system's arbiter listens at {SYSTEM_SOCKET}"
        yield error("socket.elsewhere", what, f"export VRAM_ARBITER_ENDPOINT={EXAMPLE}")
    elif (closed := _closed(m, path)) is not None:
        yield error("socket.closed", said, _join(m, closed))
    elif not m.exists(path):
        yield error("socket.missing", said, m.service("start"))
    elif not unix_sockets(m).get(path):
        yield error("socket.dead", said, m.service("start"))
    else:
        yield error("socket.silent", said, m.service("restart"))


def permissions(m: Machine) -> Iterator[Finding]:
    """The socket is open to its group and to no other user; this user is in that group; the daemon
    does not run as root."""
    path, name = m.socket, m.user_name(m.uid)
    if (closed := _closed(m, path)) is not None:
        group = m.group_name(closed.st_gid)
        if name in m.group_members(group):
            what = f"{name} is a member of {group}, but this session began before that"
            yield error("permissions.session", what, f"newgrp {group}")
        else:
            yield error("permissions.group", f"{name} may not use {path}", _join(m, closed))
        return
    found, folder = m.stat(path), os.path.dirname(path)
    above = m.stat(folder)
    if found is None or above is None:
        raise CouldNotLook(f"{path} is not there")
    if found.st_mode & stat.S_IWOTH:
        what = f"{path} has mode {stat.S_IMODE(found.st_mode):04o}: every user may take leases"
        yield warning("permissions.socket", what, f"{m.sudo}chmod 0660 {path}")
    writable = above.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if above.st_mode & stat.S_IWOTH or (writable and not above.st_mode & stat.S_ISVTX):
        bits = stat.S_IMODE(above.st_mode)
        what = f"{folder} has mode {bits:04o}: others may replace its sockets"
        yield warning("permissions.folder", what, f"{m.sudo}chmod 1770 {folder}")
    if m.arbiter.uid == 0 and m.is_system:
        yield warning(
            "permissions.root",
            "the daemon runs as root; its unit runs it as vram-arbiter without any capability",
            f"{m.sudo}kill {m.arbiter.pid} && {m.sudo}systemctl start vram-arbiter",
        )


def operators(m: Machine) -> Iterator[Finding]:
    """Whether this user may act by hand. Most users need not."""
    name = m.user_name(m.uid)
    others = m.is_system and m.uid not in (0, m.arbiter.uid)
    if others and name not in m.group_members("vram-operators"):
        what = f"{name} may look and lease, not evict, pin or drain"
        join = f"{m.sudo}usermod --append --groups vram-operators {name}"
        yield note("operators.may-not", what, join)


def _closed(m: Machine, path: str) -> os.stat_result | None:
    """Return the folder of a socket, or the socket, whichever is closed to this user."""
    for place, needed in ((os.path.dirname(path), 0o1), (path, 0o2)):
        found = m.stat(place)
        if found is not None and not m.may(found, needed):
            return found
    return None


def _join(m: Machine, closed: os.stat_result) -> str:
    join = f"{m.sudo}usermod --append --groups {m.group_name(closed.st_gid)} {m.user_name(m.uid)}"
    return f"{join}   # then log in again"
