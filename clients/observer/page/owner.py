"""Which user of this machine is at the other end of a loopback connection.

A TCP socket has no SO_PEERCRED, but its other end is a socket of this machine too, and the kernel
tells its owner by sock_diag(7): one question for one socket, while a list of all of them takes
milliseconds.
"""

import contextlib
import socket
import struct

_NETLINK_SOCK_DIAG = 4
_SOCK_DIAG_BY_FAMILY = 20
_NLM_F_REQUEST = 1
_ANY_COOKIE = 0xFFFFFFFF
_ALL_STATES = 0xFFFFFFFF
_HEADER = struct.Struct("=IHHII")
_QUESTION = struct.Struct("=BBBxI")
_PORTS = struct.Struct("!HH")
_REST = struct.Struct("=III")
_UID_AT = _HEADER.size + 4 + 48 + 12
"""inet_diag_msg: family, state, timer, retransmits; the socket's id; expires, rqueue, wqueue."""


class Owners:
    """Questions to the kernel. Where it does not answer (no netlink), no owner is known."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        with contextlib.suppress(OSError):
            self._socket = socket.socket(
                socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_SOCK_DIAG
            )
            self._socket.setblocking(False)

    def uid(self, connection: socket.socket) -> int | None:
        """Return the user of the other end; None: the kernel does not say."""
        if self._socket is None:
            return None
        family = connection.family
        try:
            here, there = connection.getsockname(), connection.getpeername()
            ends = [
                socket.inet_pton(family, end[0].partition("%")[0]).ljust(16, b"\0")
                for end in (there, here)
            ]
            question = (
                _QUESTION.pack(family, socket.IPPROTO_TCP, 0, _ALL_STATES)
                + _PORTS.pack(there[1], here[1])
                + b"".join(ends)
                + _REST.pack(0, _ANY_COOKIE, _ANY_COOKIE)
            )
            size = _HEADER.size + len(question)
            head = _HEADER.pack(size, _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 0, 0)
            self._socket.send(head + question)
            answer = self._socket.recv(4096)
        except OSError:
            return None
        if _HEADER.unpack_from(answer)[1] != _SOCK_DIAG_BY_FAMILY or len(answer) < _UID_AT + 4:
            return None
        return int(struct.unpack_from("=I", answer, _UID_AT)[0])
