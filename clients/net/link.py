"""One DEALER on one connection to a server of a checked user.

libzmq connects in its own thread and would reconnect without a word, to whatever listens by then.
So its own reconnect is put off, and no message is given to it before its monitor names the
connection's descriptor, whose user the kernel names (SO_PEERCRED). The number of a descriptor is
reused, so the first frame has to carry the same user (libzmq's `Peer-Address`, read from the
connection itself; a port has none). A link that has ended is replaced. It needs no event loop and
must not know what messages mean.
"""

import math
import os
import socket
import struct
import time
from typing import Any, Final, Literal

import zmq

from vram_arbiter.schemas.errors import ConfigError, InternalError, VramError
from vram_arbiter.schemas.runtime.endpoints import loopback_port, socket_path
from vram_arbiter.schemas.runtime.trust import (
    Program,
    check_uid,
    frame_uid,
    port_uids,
    server_uid,
)

MESSAGE_LIMIT_BYTES: Final = 64 * 1024 * 1024  # a reply is never near it; libzmq hangs up beyond

KNOCK_S: Final = 1.0  # a server whose backlog is full lets a connection wait

NEVER_MS: Final = 2**31 - 1
"""Pause before libzmq's own reconnect: 24 days. Its -1 ("none") discards what was received and not
read yet at a hang-up."""

_WATCHED: Final = zmq.EVENT_CONNECTED | zmq.EVENT_CLOSED | zmq.EVENT_DISCONNECTED
_EVENT: Final = struct.Struct("=HI")  # zmq_socket_monitor(3): event, value

State = Literal["connecting", "open", "ended"]


class Link:
    """Connects at construction; `advance` when `monitor` is readable, until `state` is `open`. Then
    `send` and `receive`.

    `enveloped` messages stand behind an empty frame, which a server with a REP socket demands and
    a ROUTER repeats. Raises ConfigError for an endpoint that is not one.
    """

    def __init__(
        self,
        context: "zmq.Context[zmq.Socket[bytes]]",
        endpoint: str,
        program: Program,
        *,
        enveloped: bool = False,
    ) -> None:
        address = _address(endpoint, program)
        self.state: State = "connecting"
        self._endpoint = endpoint
        self._port = loopback_port(endpoint)
        self._program: Program = program
        self._enveloped = enveloped
        self._heard = self._port is not None
        self.socket: zmq.Socket[bytes] = context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RECONNECT_IVL, NEVER_MS)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MESSAGE_LIMIT_BYTES)
        self.monitor: zmq.Socket[bytes] = self.socket.get_monitor_socket(_WATCHED)
        self.monitor.setsockopt(zmq.LINGER, 0)
        self.socket.connect(address)  # type: ignore[arg-type]

    def advance(self) -> State:
        """Read what became of the connection. Raises UntrustedServer; the link has ended then."""
        while self.state != "ended":
            try:
                frames = self.monitor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            event, value = _EVENT.unpack(frames[0])
            if event == zmq.EVENT_CONNECTED and self.state == "connecting":
                self._connected(value)
            else:
                self.state = "ended"
        return self.state

    def wait(self, deadline: float) -> State:
        """Block until it is open or has ended, or until `deadline` (monotonic seconds). Raises
        UntrustedServer."""
        while self.advance() == "connecting" and self.monitor.poll(ms_until(deadline)):
            pass
        return self.state

    def send(self, payload: bytes) -> bool:
        """Queue one message. False: the queue is full, the server does not read. Only while `state`
        is `open`."""
        assert self.state == "open", "nothing is said before the server is known"
        try:
            if self._enveloped:
                self.socket.send(b"", zmq.NOBLOCK | zmq.SNDMORE)
            self.socket.send(payload, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> bytes | None:
        """The last frame of the next message; None: there is none yet. Raises UntrustedServer; the
        link has ended then."""
        try:
            if self._heard:
                return self.socket.recv_multipart(zmq.NOBLOCK)[-1]
            frame: Any = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)[-1]
        except zmq.Again:
            return None
        self._check(_uid_of(frame))
        self._heard = True
        return bytes(frame.bytes)

    def close(self) -> None:
        """Drop what was not sent. Idempotent."""
        self.state = "ended"
        if not self.socket.closed:
            self.socket.disable_monitor()
        self.monitor.close(0)
        self.socket.close(0)

    def _connected(self, descriptor: int) -> None:
        """Ask the kernel before anything is said. libzmq may have closed the descriptor by now."""
        try:
            with socket.socket(fileno=os.dup(descriptor)) as connection:
                if self._port is None:
                    uids = {server_uid(connection)}
                elif connection.getpeername()[:2] == ("127.0.0.1", self._port):
                    uids = port_uids(connection)
                else:
                    uids = set()  # the descriptor is another connection's by now
        except OSError:
            uids = set()
        if not uids:
            self.state = "ended"
            return
        for uid in sorted(uids, reverse=True):
            self._check(uid)
        self.state = "open"

    def _check(self, uid: int) -> None:
        try:
            check_uid(uid, self._program, self._endpoint)
        except VramError:
            self.state = "ended"
            raise


def _address(endpoint: str, program: Program) -> str | bytes:
    """What libzmq connects to. Raises ConfigError. Only a sidecar may be a server of the field,
    which listens on a port."""
    if program == "sidecar" and endpoint.startswith("tcp://"):
        port = loopback_port(endpoint)
        if port is None:
            raise ConfigError(
                f"{endpoint} is refused: only a server on this machine has a user to be checked",
                hint="write ipc://PATH, or tcp://127.0.0.1:PORT for another project's server",
                details={"endpoint": endpoint},
            )
        return f"tcp://127.0.0.1:{port}"
    return b"ipc://" + os.fsencode(socket_path(endpoint))  # bytes: a path need not be text


def is_listening(endpoint: str) -> bool:
    """Return False for a socket that is missing or that no process serves, True where only an
    exchange can tell.
    """
    if not endpoint.startswith("ipc://"):
        return True
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as knock:
        knock.settimeout(KNOCK_S)
        try:
            knock.connect(socket_path(endpoint))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


def ms_until(deadline: float) -> int:
    """Milliseconds that a poll may take, so that it does not end before `deadline` (monotonic
    seconds) for rounding."""
    return max(0, math.ceil(1000 * (deadline - time.monotonic())))


def _uid_of(frame: Any) -> int:
    """The user of the connection by which a frame came."""
    try:
        uid = frame_uid(frame.get("Peer-Address"))
    except zmq.ZMQError:
        uid = None
    if uid is None:
        raise InternalError(
            "this libzmq does not name the peer", hint="use pyzmq ≥ 27 with libzmq ≥ 4.3"
        )
    return uid
