"""The process at the other end of a unix socket, as the kernel names it.

SO_PEERCRED and SO_PEERGROUPS hold the credentials of the moment of connecting. A pid alone is
reused, so a pidfd is opened at once and the start time is read while the pidfd shows the process
alive: the three name one process for ever.
"""

import os
import pwd
import select
import socket
import struct
from dataclasses import dataclass

from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import procfs

SO_PEERPIDFD = 77
"""Linux ≥ 6.5, asm-generic/socket.h; the socket module of Python 3.12 does not name it."""
SO_PEERGROUPS = 59
"""Linux ≥ 4.13, as above."""
_GROUPS_BYTES = 1024
"""The most that `getsockopt` of Python takes: 256 groups of four bytes."""
_UCRED = struct.Struct("iII")  # pid, uid, gid (unix(7))


class PeerGone(Exception):
    """The process that connected has ended, or another one has its pid now."""


@dataclass(frozen=True, slots=True)
class Peer:
    """The process that connected. `pidfd` stays open as long as one of its connections; dup() it to
    keep it.

    `process.pid` is 0, and `pidfd` -1, for a process of a pid namespace that cannot be seen from
    here.
    """

    process: ProcessKey
    uid: int
    gid: int
    pidfd: int
    groups: tuple[int, ...] = ()
    """Supplementary groups; () where there are more than 256."""

    def belongs_to(self, group: int) -> bool:
        """Return whether a group is the process's own, or by its account the user's: neither a
        machine without this account nor a process that has left the group hides it."""
        if group in (self.gid, *self.groups):
            return True
        try:
            account = pwd.getpwuid(self.uid)
        except KeyError:
            return False
        return group in os.getgrouplist(account.pw_name, account.pw_gid)


def is_guest(peer: Peer, guests_gid: int | None) -> bool:
    """Return whether a peer is a member of the guests' group, whatever else it belongs to; never
    root or this process's user."""
    if guests_gid is None or peer.uid in (0, os.getuid()):
        return False
    return peer.belongs_to(guests_gid)


def credentials(sock: socket.socket) -> tuple[int, int, int]:
    """Return pid, uid and gid of the peer of a connected unix socket."""
    pid, uid, gid = _UCRED.unpack(
        sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size)
    )
    return pid, uid, gid


def _groups(sock: socket.socket) -> tuple[int, ...]:
    try:
        found = sock.getsockopt(socket.SOL_SOCKET, SO_PEERGROUPS, _GROUPS_BYTES)
    except OSError:  # ERANGE: too many
        return ()
    return struct.unpack(f"{len(found) // 4}I", found)


def identify(sock: socket.socket) -> Peer:
    """Return the process at the other end of an accepted unix socket, with a pidfd that the caller
    closes.

    Raises PeerGone, and OSError where no descriptor is left.
    """
    pid, uid, gid = credentials(sock)
    if pid == 0:
        return Peer(ProcessKey(0, 0), uid, gid, -1, _groups(sock))
    try:
        pidfd = sock.getsockopt(socket.SOL_SOCKET, SO_PEERPIDFD)
        certain = True
    except OSError as error:
        if isinstance(error, ProcessLookupError):
            raise PeerGone(f"process {pid} has ended") from None
        pidfd, certain = _open(pid), False
    try:
        os.set_inheritable(pidfd, False)
        stat = procfs.read_stat(pid)
        # alive now: /proc/PID was its own until here, not that of a process with the same pid
        if stat is None or _ended(pidfd):
            raise PeerGone(f"process {pid} has ended")
        if not certain and uid not in _uids(pid):
            raise PeerGone(f"pid {pid} belongs to another process now")
    except BaseException:
        os.close(pidfd)
        raise
    return Peer(ProcessKey(pid, stat.start_ticks), uid, gid, pidfd, _groups(sock))


def _open(pid: int) -> int:
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        raise PeerGone(f"process {pid} has ended") from None


def _ended(pidfd: int) -> bool:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(0))


def _uids(pid: int) -> set[int]:
    """Real, effective, saved and file-system uid."""
    try:
        with open(f"/proc/{pid}/status", "rb") as file:
            for line in file:
                if line.startswith(b"Uid:"):
                    return {int(word) for word in line.split()[1:]}
    except (FileNotFoundError, ProcessLookupError):
        pass
    return set()
