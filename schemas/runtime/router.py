"""A ZeroMQ ROUTER on asyncio for unix sockets, for every server of the product.

Peers are untrusted. They may send anything, at any speed, and never read; the limits of `Limits`
hold in bytes as well
as in counts, per connection, process and user. The kernel names a peer once, at accept
(`peercred`). Work is done in
turns over users, processes and connections, so a flood delays others by a few messages. libzmq is
not involved: it
aborts or buffers without bound on such input before a program sees a byte. Must not know what a
message means.
"""

import asyncio
import errno
import logging
import os
import resource
import socket
import stat
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

from vram_arbiter.schemas.defaults import KIB, MESSAGE_MAX_BYTES, MIB
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer, PeerGone, identify
from vram_arbiter.schemas.runtime.turns import Turns
from vram_arbiter.schemas.runtime.zmtp import (
    Heartbeat,
    Message,
    Oversize,
    Ready,
    ServerConnection,
    ZmtpError,
    encode,
)
from vram_arbiter.schemas.runtime.zmtp import Limits as WireLimits

log = logging.getLogger(__name__)

LISTEN_BACKLOG = 512
ACCEPT_MAX = 4
"""Connections accepted in one turn of the loop: each costs some 0.3 ms until it is read or cut, and others wait so long."""
ACCEPT_PAUSE_S = 0.1
"""After a failed accept (EMFILE, ENFILE, ENOMEM); the backlog keeps new connections meanwhile."""
SWEEP_S = 0.5
"""Period in which silent connections and the socket's file are checked."""
TURN_S = 0.002
"""Longest work on waiting messages before the loop's other callbacks run."""
DIRECT_SHARE = 0.5
"""Share of the loop's time in which a message is handled as it arrives; beyond it messages wait for
their turn.
"""
REST_S = 0.005
"""A connection that is over its rate is not read for so long; the kernel's buffer then slows its
sender.
"""
READ_AHEAD_BYTES = 16 * KIB
"""Unread bytes from which on a connection that waits for its turn is not read any further."""
OUT_MESSAGES_MAX = 4096
"""Messages queued for a peer that does not read."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of a server; sizes in bytes, times in seconds."""

    message_max_bytes: int = MESSAGE_MAX_BYTES
    stranger_message_max_bytes: int = 64 * KIB
    """Largest message of a connection that is not admitted yet."""
    skip_max_bytes: int = 64 * MIB
    """A message beyond its limit is skipped and answered; beyond this the connection is cut."""
    handshake_s: float = 2.0
    hello_s: float = 5.0
    """A connection that is not admitted within this time is cut."""
    connections_max: int = 2048
    descriptor_reserve: int = 128
    """Descriptors of the process that connections never take."""
    user_share: float = 0.75
    """Largest share of the connections that one user may have."""
    process_share: float = 0.25
    """Largest share of the connections that one process may have."""
    out_max_bytes: int = 4 * MIB
    """Queued for one connection that does not read."""
    user_out_max_bytes: int = 64 * MIB
    user_in_max_bytes: int = 16 * MIB
    """Incomplete messages of all connections of one user."""
    work_share: float = 1.0
    """Largest share of the time for accepting and handling. Below 1 the loop rests between its
    turns, so that another thread of the process, as a control loop, gets the interpreter at once
    while a flood lasts.
    """


class Handler(Protocol):
    """What a server does with its connections. Every method is called on the loop and must not
    block.
    """

    def connected(self, connection: "Connection") -> None:
        """A peer has finished the handshake."""

    def received(self, connection: "Connection", payload: bytes | bytearray | Oversize) -> bool:
        """One message came; `Oversize` where it was skipped. Return False if its sender is over its
        rate.
        """

    def disconnected(self, connection: "Connection", reason: str) -> None:
        """A connection of which `connected` was told has ended."""


@dataclass(slots=True)
class _User:
    """Bytes and connections of one uid."""

    connections: int = 0
    in_bytes: int = 0
    out_bytes: int = 0


@dataclass(slots=True)
class _Process:
    """A process with at least one connection; its pidfd is readable from its end on."""

    pidfd: int
    connections: "set[Connection]" = field(default_factory=set)


class Connection(asyncio.Protocol):
    """One peer's connection. `serial` is unique within its router; a peer's own ZeroMQ identity is
    ignored.
    """

    def __init__(self, router: "Router", serial: int, peer: Peer, user: _User, now: float) -> None:
        self.serial = serial
        self.peer = peer
        self.accepted_at = now
        self.admitted = False
        self.ready = False
        self.ended = False
        self._router = router
        self._user = user
        self._transport: asyncio.Transport | None = None
        limits = router.limits
        self._wire = ServerConnection(
            WireLimits(limits.stranger_message_max_bytes, limits.skip_max_bytes)
        )
        self._delimiter = False
        self._resting = False  # over its rate
        self._clogged = False  # bytes wait for the peer to read
        self._finishing = False  # nothing more is sent
        self._in_bytes = 0
        self._out_bytes = 0
        self._out_messages = 0
        self._reason = "the peer hung up"

    def __repr__(self) -> str:
        return f"<connection {self.serial} of process {self.peer.process}, uid {self.peer.uid}>"

    # -- for handlers ----------------------------------------------------------------------------
    def admit(self) -> None:
        """The peer said who it is: the time limit of `hello_s` ends, and messages may have their
        full size.
        """
        self.admitted = True
        limits = self._router.limits
        self._wire.limits = WireLimits(limits.message_max_bytes, limits.skip_max_bytes)
        self._router._admitted(self)

    def send(self, payload: bytes) -> bool:
        """Queue one message, in the envelope of the last one received. False: the peer is gone or
        does not read.
        """
        transport = self._transport
        if transport is None or self._finishing or transport.is_closing():
            return False
        frames = encode(payload, self._delimiter)
        if self._clogged:
            if not self._may_queue(len(frames)):
                self._count_out()
                if not self._may_queue(len(frames)):
                    return False
            self._out_messages += 1
            self._out_bytes += len(frames)
            self._user.out_bytes += len(frames)
        transport.write(frames)
        return True

    def close(self, reason: str) -> None:
        """Hang up as soon as what was sent has left, or after `handshake_s` if the peer does not
        read.
        """
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        self._reason = reason
        self._finishing = True
        transport.close()
        self._router._loop_or_fail.call_later(self._router.limits.handshake_s, transport.abort)

    # -- asyncio.Protocol ------------------------------------------------------------------------
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=0)  # reading stops while anything waits for the peer
        if self.ended:  # cut between accept and here
            transport.abort()
            return
        transport.write(self._wire.outgoing())

    def data_received(self, data: bytes) -> None:
        if self._finishing:  # read on all the same: the peer's end of file ends the connection
            return
        self._wire.feed(data)
        self._router._readable(self)

    def pause_writing(self) -> None:
        self._clogged = True
        self._count_out()
        self.update_reading()

    def resume_writing(self) -> None:
        self._clogged = False
        self._out_messages = 0
        self._count_out()
        self._router._readable(self)  # requests wait until their sender has read the answers before

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._router._lost(self, self._reason if exc is None else f"{exc}")

    # -- for the router --------------------------------------------------------------------------
    def cut(self, reason: str) -> None:
        """Hang up now; what is queued is lost."""
        self._reason = reason
        if self._transport is not None:
            self._transport.abort()
        self._router._lost(self, reason)

    def half_close(self) -> None:
        """Flush, then tell the peer that nothing more comes; it hangs up when it has read
        everything.
        """
        if self._transport is not None and not self._transport.is_closing():
            self._reason = "the server ends"
            self._finishing = True
            self._transport.write_eof()
            self.update_reading()

    def handle(self) -> bool:
        """Handle one event of what was read. True: more may be left, and the connection wants
        another turn.
        """
        event = None
        try:
            if not self._stopped and (event := self._wire.next_event()) is not None:
                self._handle(event)
        except ZmtpError as error:
            self._flush_wire()
            self._router._complain(f"process {self.peer.process} of uid {self.peer.uid}: {error}")
            self.cut(f"protocol error: {error}")
        if self.ended:
            return False
        self._flush_wire()
        self._count_in()
        self.update_reading()
        more = event is not None and self._wire.unread_bytes > 0
        return more and not self._stopped and not self.ended

    @property
    def _stopped(self) -> bool:
        """Nothing is handled for now, or any more."""
        return self._resting or self._clogged or self._finishing

    def _handle(self, event: Ready | Heartbeat | Message | Oversize) -> None:
        match event:
            case Message():
                self._delimiter = event.delimiter
                within_rate = self._router._deliver(self, event.payload)
            case Oversize():
                self._delimiter = event.delimiter
                within_rate = self._router._deliver(self, event)
            case Ready():
                self._flush_wire()
                self.ready = within_rate = True
                self._router.handler.connected(self)
            case Heartbeat():
                within_rate = True
        if not within_rate:
            self._resting = True
            self._router._loop_or_fail.call_later(REST_S, self._rested)

    def _rested(self) -> None:
        self._resting = False
        if not self.ended:
            self._router._readable(self)

    def _flush_wire(self) -> None:
        data = self._wire.outgoing()
        if data and self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    def update_reading(self) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        full = self._stopped or self._wire.unread_bytes > READ_AHEAD_BYTES
        if full and not self._finishing:
            transport.pause_reading()
        else:
            transport.resume_reading()

    def _may_queue(self, size: int) -> bool:
        limits = self._router.limits
        return (
            self._out_messages < OUT_MESSAGES_MAX
            and self._out_bytes + size <= limits.out_max_bytes
            and self._user.out_bytes + size <= limits.user_out_max_bytes
        )

    def _count_in(self) -> None:
        kept = self._wire.kept_bytes
        self._user.in_bytes += kept - self._in_bytes
        self._in_bytes = kept
        if self._user.in_bytes > self._router.limits.user_in_max_bytes and not self.ended:
            self.cut(f"incomplete messages of uid {self.peer.uid} exceed their limit")

    def _count_out(self) -> None:
        queued = 0 if self._transport is None else self._transport.get_write_buffer_size()
        self._user.out_bytes += queued - self._out_bytes
        self._out_bytes = queued

    def forget_bytes(self) -> None:
        self._user.in_bytes -= self._in_bytes
        self._user.out_bytes -= self._out_bytes
        self._in_bytes = self._out_bytes = 0


class Router:
    """`bind`, then `start` inside the running loop, `stop_receiving` and `aclose`. The caller holds
    the lock file.
    """

    def __init__(
        self, path: Path, handler: Handler, limits: Limits | None = None, group: int | None = None
    ) -> None:
        self.path = path
        self.handler = handler
        self.limits = limits or Limits()
        self._group = group
        self._direct_share = min(DIRECT_SHARE, self.limits.work_share)
        self._listener: socket.socket | None = None
        self._inode: tuple[int, int] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._receiving = False
        self._serial = 0
        self._connections_max = self.limits.connections_max
        self._connections: set[Connection] = set()
        self._strangers: dict[Connection, None] = {}  # not admitted, the oldest first
        self._users: dict[int, _User] = {}
        self._processes: dict[ProcessKey, _Process] = {}
        self._turns: Turns[Connection] = Turns()
        self._turn_scheduled = False
        self._complaints = 0
        self._credit_s = TURN_S
        self._credit_at = 0.0
        self._sweep: asyncio.TimerHandle | None = None
        self._opening: set[asyncio.Task[object]] = set()
        self._empty: asyncio.Future[None] | None = None

    @property
    def _loop_or_fail(self) -> asyncio.AbstractEventLoop:
        assert self._loop is not None, "the router was not started"
        return self._loop

    def __len__(self) -> int:
        """Number of open connections."""
        return len(self._connections)

    # -- life ------------------------------------------------------------------------------------
    def bind(self) -> None:
        """Bind with mode 0660 from the first instant. Raises ConfigError."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.setblocking(False)
            # the socket's own mode is what its file gets, less the umask: no moment with a wider
            # one
            os.fchmod(listener.fileno(), 0o660)
            self._remove_stale()
            listener.bind(str(self.path))
            os.chmod(self.path, 0o660)
            if self._group is not None:
                os.chown(self.path, -1, self._group)
            listener.listen(LISTEN_BACKLOG)
            found = os.lstat(self.path)
        except OSError as error:
            listener.close()
            reason = error.strerror or str(error)
            raise ConfigError(
                f"cannot bind ipc://{self.path}: {reason}", hint="choose another endpoint"
            ) from error
        self._listener, self._inode = listener, (found.st_dev, found.st_ino)

    def _remove_stale(self) -> None:
        try:
            mode = os.lstat(self.path).st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISSOCK(mode):
            raise OSError(errno.EEXIST, "a file that is not a socket is in the way")
        self.path.unlink()

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin to accept and to read."""
        assert self._listener is not None, "bind() comes first"
        self._loop = loop
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        # a connection takes its socket and, for the first one of a process, a pidfd
        self._connections_max = max(
            4, min(self.limits.connections_max, (soft - self.limits.descriptor_reserve) // 2)
        )
        self._receiving = True
        self._credit_at = loop.time()
        loop.add_reader(self._listener.fileno(), self._accept)
        self._sweep = loop.call_later(SWEEP_S, self._sweep_once)

    def stop_receiving(self) -> None:
        """Shutdown, first half: nothing more is accepted or handled; answers can still be sent."""
        self._receiving = False
        if self._loop is not None and self._listener is not None:
            self._loop.remove_reader(self._listener.fileno())
        if self._sweep is not None:
            self._sweep.cancel()
            self._sweep = None

    async def aclose(self, flush_s: float = 0.2) -> None:
        """Shutdown, second half: let peers read what was sent for up to `flush_s`, hang up, remove
        the socket's file.
        """
        self.stop_receiving()
        for connection in list(self._connections):
            connection.half_close()
        if self._connections and self._loop is not None:
            self._empty = self._loop.create_future()
            await asyncio.wait([self._empty], timeout=flush_s)
        for connection in list(self._connections):
            connection.cut("the server ends")
        if self._opening:
            await asyncio.gather(*self._opening, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            if self._is_ours():
                self.path.unlink(missing_ok=True)

    def _is_ours(self) -> bool:
        try:
            found = os.lstat(self.path)
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._inode

    # -- accepting ---------------------------------------------------------------------------------
    def _accept(self) -> None:
        """1. Take a few from the backlog. 2. Ask the kernel for the peer. 3. Room within the
        shares. 4. Open the transport. Where more may wait: 5. Rest.
        """
        assert self._listener is not None
        loop = self._loop_or_fail
        began = loop.time()
        for _ in range(ACCEPT_MAX):
            try:
                sock, _address = self._listener.accept()  # 1
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                self._pause_accept(error)
                return
            sock.setblocking(False)
            try:
                peer = identify(sock)  # 2
            except PeerGone as gone:
                self._complain(f"a connection: {gone}")
                sock.close()
                continue
            except OSError as error:
                sock.close()
                self._pause_accept(error)
                return
            if not self._make_room(peer):  # 3
                self._complain(f"process {peer.process} of uid {peer.uid}: too many connections")
                _close(peer.pidfd)
                sock.close()
                continue
            connection = self._enter(peer)
            opening = loop.create_task(
                loop.connect_accepted_socket(partial(_the, connection), sock)
            )  # 4
            self._opening.add(opening)
            opening.add_done_callback(self._opened)
        if self.limits.work_share < 1:  # 5
            # opening and closing cost as much again, in callbacks of their own
            rest_s = self._rest_s(2 * (loop.time() - began))
            loop.remove_reader(self._listener.fileno())
            loop.call_later(rest_s, self._resume_accept)

    def _opened(self, opening: "asyncio.Task[object]") -> None:
        self._opening.discard(opening)
        if not opening.cancelled() and (error := opening.exception()) is not None:
            log.warning("a connection could not be opened: %s", error)

    def _pause_accept(self, error: OSError) -> None:
        log.error("accepting pauses for %g s: %s", ACCEPT_PAUSE_S, error.strerror)
        loop = self._loop_or_fail
        assert self._listener is not None
        loop.remove_reader(self._listener.fileno())
        loop.call_later(ACCEPT_PAUSE_S, self._resume_accept)

    def _resume_accept(self) -> None:
        if self._receiving and self._listener is not None:
            self._loop_or_fail.add_reader(self._listener.fileno(), self._accept)

    def _make_room(self, peer: Peer) -> bool:
        """Whether a connection fits its shares; a stranger of the process with the most of them
        leaves for it.
        """
        limits, total = self.limits, self._connections_max
        process = self._processes.get(peer.process)
        if process is not None and len(process.connections) >= max(
            1, int(total * limits.process_share)
        ):
            return self._evict_stranger(lambda other: other.process == peer.process)
        user = self._users.get(peer.uid)
        if user is not None and user.connections >= max(1, int(total * limits.user_share)):
            return self._evict_stranger(lambda other: other.uid == peer.uid)
        return len(self._connections) < total or self._evict_stranger(lambda _: True)

    def _evict_stranger(self, among: Callable[[Peer], bool]) -> bool:
        """Cut the oldest connection without a hello of the process that has the most of them."""
        oldest: dict[ProcessKey, Connection] = {}
        counts: Counter[ProcessKey] = Counter()
        for connection in self._strangers:
            if among(connection.peer):
                oldest.setdefault(connection.peer.process, connection)
                counts[connection.peer.process] += 1
        if not counts:
            return False
        oldest[counts.most_common(1)[0][0]].cut("no hello, and the place was needed")
        return True

    def _enter(self, peer: Peer) -> Connection:
        process = self._processes.get(peer.process)
        if process is None:
            process = self._processes[peer.process] = _Process(peer.pidfd)
            if peer.pidfd >= 0:
                self._loop_or_fail.add_reader(peer.pidfd, self._process_ended, peer.process)
        else:
            _close(peer.pidfd)
            peer = Peer(peer.process, peer.uid, peer.gid, process.pidfd)
        user = self._users.setdefault(peer.uid, _User())
        user.connections += 1
        self._serial += 1
        connection = Connection(self, self._serial, peer, user, self._loop_or_fail.time())
        process.connections.add(connection)
        self._connections.add(connection)
        self._strangers[connection] = None
        return connection

    def _process_ended(self, process: ProcessKey) -> None:
        """A child that inherited the connection must not speak for its parent."""
        known = self._processes[process]
        self._loop_or_fail.remove_reader(known.pidfd)
        for connection in list(known.connections):
            connection.cut("its process has ended")

    def _admitted(self, connection: Connection) -> None:
        self._strangers.pop(connection, None)

    def _lost(self, connection: Connection, reason: str) -> None:
        """Forget a connection. The second call, from asyncio after a cut, changes nothing."""
        if connection.ended:
            return
        connection.ended = True
        self._connections.discard(connection)
        self._strangers.pop(connection, None)
        self._turns.discard(connection)
        connection.forget_bytes()
        peer = connection.peer
        user = self._users[peer.uid]
        user.connections -= 1
        if not user.connections:
            del self._users[peer.uid]
        process = self._processes[peer.process]
        process.connections.discard(connection)
        if not process.connections:
            del self._processes[peer.process]
            if process.pidfd >= 0:
                self._loop_or_fail.remove_reader(process.pidfd)
                _close(process.pidfd)
        if connection.ready:
            self.handler.disconnected(connection, reason)
        if self._empty is not None and not self._connections and not self._empty.done():
            self._empty.set_result(None)

    # -- handling ----------------------------------------------------------------------------------
    def _readable(self, connection: Connection) -> None:
        """Handle what has come at once while the loop has time for it, else when it is the
        connection's turn.
        """
        if connection.ended:
            return
        more = True
        if not self._turns:
            now = self._loop_or_fail.time()
            self._credit_s = min(
                TURN_S, self._credit_s + (now - self._credit_at) * self._direct_share
            )
            self._credit_at = now
            if self._credit_s > 0:
                more = connection.handle()
                self._credit_s -= self._loop_or_fail.time() - now
        if more and not connection.ended:
            connection.update_reading()
            self._turns.add(connection, (connection.peer.uid, connection.peer.process))
            self._schedule_turn()

    def _schedule_turn(self, after_s: float = 0.0) -> None:
        if not self._turn_scheduled:
            self._turn_scheduled = True
            if after_s > 0:
                self._loop_or_fail.call_later(after_s, self._take_turns)
            else:
                self._loop_or_fail.call_soon(self._take_turns)

    def _take_turns(self) -> None:
        self._turn_scheduled = False
        loop = self._loop_or_fail
        began = loop.time()
        end = began + TURN_S
        while self._turns:
            connection = self._turns.pop()
            if connection.handle():
                self._turns.add(connection, (connection.peer.uid, connection.peer.process))
            if loop.time() >= end:
                break
        if self._turns:
            self._schedule_turn(self._rest_s(loop.time() - began))

    def _rest_s(self, worked_s: float) -> float:
        return worked_s * (1.0 / self.limits.work_share - 1.0)

    def _deliver(self, connection: Connection, payload: bytes | bytearray | Oversize) -> bool:
        if not self._receiving:
            return True
        try:
            return self.handler.received(connection, payload)
        except Exception:  # outermost: one bad message must not cost the others their server
            log.exception("a message of %r could not be handled", connection)
            return True

    def _complain(self, what: str) -> None:
        """Log what was refused, once per sweep: a flood must not fill the log."""
        self._complaints += 1
        if self._complaints == 1:
            log.warning("refused %s", what)

    # -- watching ----------------------------------------------------------------------------------
    def _sweep_once(self) -> None:
        loop = self._loop_or_fail
        now = loop.time()
        if self._complaints > 1:
            log.warning("refused %d more connections within %g s", self._complaints - 1, SWEEP_S)
        self._complaints = 0
        for connection in list(self._strangers):
            age = now - connection.accepted_at
            if age < self.limits.handshake_s:
                break
            if not connection.ready:
                connection.cut("no handshake in time")
            elif age >= self.limits.hello_s:
                connection.cut("no hello in time")
        self._restore_file()
        self._sweep = loop.call_later(SWEEP_S, self._sweep_once)

    def _restore_file(self) -> None:
        """Bind again where the socket's file was deleted: without it no client finds the server."""
        if self._is_ours() or self._listener is None:
            return
        if os.path.lexists(self.path):
            log.error("another file is at %s: clients cannot reach this server", self.path)
            return
        loop, old = self._loop_or_fail, self._listener
        try:
            self.bind()
        except ConfigError as error:
            log.error("the socket's file was deleted and cannot be made again: %s", error)
            return
        log.warning("the socket's file %s was deleted; bound again", self.path)
        loop.remove_reader(old.fileno())
        old.close()
        loop.add_reader(self._listener.fileno(), self._accept)


def _the(connection: Connection) -> Connection:
    return connection


def _close(fd: int) -> None:
    if fd >= 0:
        os.close(fd)
