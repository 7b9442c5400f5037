"""A ZeroMQ ROUTER on asyncio for unix sockets, for every server of the product.

Peers are untrusted: they may send anything, at any speed, and never read. `Bounds` hold
in bytes as well as in counts, per connection, process and user. The kernel names a peer once,
at accept (`peercred`). Work is done in turns over users, processes and connections, so that a flood
delays others by a few messages. libzmq is not involved: it aborts or buffers without bound on such
input before a program sees a byte. Must not know what a message means.
"""

import asyncio
import logging
import os
import resource
import socket
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.connection import Bounds, Connection, Handler, User
from vram_arbiter.schemas.runtime.peercred import Peer, PeerGone, identify
from vram_arbiter.schemas.runtime.rate import Rate
from vram_arbiter.schemas.runtime.socket_file import SocketFile
from vram_arbiter.schemas.runtime.turns import Turns

log = logging.getLogger(__name__)

ACCEPT_MAX = 4
"""Connections accepted in one turn of the loop: each costs some 0.3 ms until it is read or cut, and
others wait so long."""
ACCEPT_PAUSE_S = 0.1
"""After a failed accept (EMFILE, ENFILE, ENOMEM); the backlog keeps new connections meanwhile."""
SWEEP_S = 0.5
"""Period in which silent connections and the socket's file are checked."""
TURN_S = 0.002
"""Longest work on waiting messages before the loop's other callbacks run."""
DIRECT_SHARE = 0.5
"""Share of the loop's time in which messages are handled as they arrive; beyond it they wait for
their turn.
"""
DIRECT_EVENTS = 4
"""Messages of one connection handled as they arrive, such as a holder's `revoke_ack`, `unloading`
and `release`; more of them wait for their turn."""


@dataclass(slots=True)
class _Process:
    """A process with at least one connection; its pidfd is readable from its end on."""

    pidfd: int
    connections: "set[Connection]" = field(default_factory=set)


class Router:
    """`bind`, then `start` inside the running loop, `stop_receiving` and `aclose`. The caller holds
    the lock file.
    """

    def __init__(
        self, path: Path, handler: Handler, limits: Bounds | None = None, group: int | None = None
    ) -> None:
        self._file = SocketFile(path, group)
        self.handler = handler
        self.limits = limits or Bounds()
        self._direct_share = min(DIRECT_SHARE, self.limits.work_share)
        self._listener: socket.socket | None = None
        self.loop: asyncio.AbstractEventLoop  # from `start` on
        self.receiving = False
        self._serial = 0
        self._connections_max = self.limits.connections_max
        self._connections: set[Connection] = set()
        self._strangers: dict[Connection, None] = {}  # not admitted, the oldest first
        self._users: dict[int, User] = {}
        self._processes: dict[ProcessKey, _Process] = {}
        # they outlive connections: connecting again does not refill them. A process that cannot be
        # seen has pid 0, whichever it is
        self._rates: dict[tuple[int, ProcessKey], Rate] = {}
        self._slow = set[ProcessKey]()  # over their rate since the last sweep
        self._slow_before = set[ProcessKey]()
        self._turns: Turns[Connection] = Turns()
        self._turn_scheduled = False
        self._complaints = 0
        self._credit_s = TURN_S
        self._credit_at = 0.0
        self._sweep: asyncio.TimerHandle | None = None
        self._opening: set[asyncio.Task[object]] = set()
        self._empty: asyncio.Future[None] | None = None

    def __len__(self) -> int:
        """Number of open connections."""
        return len(self._connections)

    # -- life
    def bind(self) -> None:
        """Bind with mode 0660 from the first instant. Raises ConfigError."""
        self._listener = self._file.bind()

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin to accept and to read."""
        assert self._listener is not None, "bind() comes first"
        self.loop = loop
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        # a connection takes its socket and, for the first one of a process, a pidfd
        self._connections_max = max(
            4, min(self.limits.connections_max, (soft - self.limits.descriptor_reserve) // 2)
        )
        self.receiving = True
        self._credit_at = loop.time()
        loop.add_reader(self._listener.fileno(), self._accept)
        self._sweep = loop.call_later(SWEEP_S, self._sweep_once)

    def stop_receiving(self) -> None:
        """Shutdown, first half: nothing more is accepted or handled; answers can still be sent."""
        self.receiving = False
        if self._sweep is not None and self._listener is not None:
            self.loop.remove_reader(self._listener.fileno())
            self._sweep.cancel()
            self._sweep = None

    async def aclose(self, flush_s: float = 0.2) -> None:
        """Shutdown, second half: let peers read what was sent for up to `flush_s`, hang up, remove
        the socket's file.
        """
        self.stop_receiving()
        for connection in list(self._connections):
            connection.half_close()
        if self._connections:
            self._empty = self.loop.create_future()
            await asyncio.wait([self._empty], timeout=flush_s)
        for connection in list(self._connections):
            connection.cut("the server ends")
        if self._opening:
            await asyncio.gather(*self._opening, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self._file.remove()

    # -- accepting
    def _accept(self) -> None:
        """1. Take a few from the backlog. 2. Ask the kernel for the peer. 3. Room within the
        shares. 4. Open the transport. Where more may wait: 5. Rest.
        """
        assert self._listener is not None
        loop = self.loop
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
                self.complain(f"a connection: {gone}")
                sock.close()
                continue
            except OSError as error:
                sock.close()
                self._pause_accept(error)
                return
            if not self._make_room(peer):  # 3
                self.complain(f"process {peer.process} of uid {peer.uid}: too many connections")
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
        loop = self.loop
        assert self._listener is not None
        loop.remove_reader(self._listener.fileno())
        loop.call_later(ACCEPT_PAUSE_S, self._resume_accept)

    def _resume_accept(self) -> None:
        if self.receiving and self._listener is not None:
            self.loop.add_reader(self._listener.fileno(), self._accept)

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
                self.loop.add_reader(peer.pidfd, self._process_ended, peer.process)
        else:
            _close(peer.pidfd)
            peer = replace(peer, pidfd=process.pidfd)
        user = self._users.setdefault(peer.uid, User())
        user.connections += 1
        self._serial += 1
        now, per_s = self.loop.time(), float(self.limits.rate_per_process_per_s)
        rate = self._rates.setdefault((peer.uid, peer.process), Rate(per_s, per_s, now))
        connection = Connection(self, self._serial, peer, user, rate, now)
        process.connections.add(connection)
        self._connections.add(connection)
        self._strangers[connection] = None
        return connection

    def _process_ended(self, process: ProcessKey) -> None:
        """A child that inherited the connection must not speak for its parent."""
        known = self._processes[process]
        self.loop.remove_reader(known.pidfd)
        for connection in list(known.connections):
            connection.cut("its process has ended")

    def admitted(self, connection: Connection) -> None:
        self._strangers.pop(connection, None)

    def lost(self, connection: Connection, reason: str) -> None:
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
                self.loop.remove_reader(process.pidfd)
                _close(process.pidfd)
        if connection.ready:
            self.handler.disconnected(connection, reason)
        if self._empty is not None and not self._connections and not self._empty.done():
            self._empty.set_result(None)

    # -- handling
    def readable(self, connection: Connection) -> None:
        """Handle what has come at once while the loop has time for it, else when it is the
        connection's turn.
        """
        if connection.ended:
            return
        more = True
        if not self._turn_scheduled:
            now = self.loop.time()
            self._credit_s = min(
                TURN_S, self._credit_s + (now - self._credit_at) * self._direct_share
            )
            self._credit_at = now
            left = DIRECT_EVENTS
            while more and left and self._credit_s > 0:
                more = connection.handle()
                began, now, left = now, self.loop.time(), left - 1
                self._credit_s -= now - began
        if more and not connection.ended:
            connection.update_reading()
            self._turns.add(connection, (connection.peer.uid, connection.peer.process))
            self._schedule_turn()

    def _schedule_turn(self, after_s: float = 0.0) -> None:
        if not self._turn_scheduled:
            self._turn_scheduled = True
            if after_s > 0:
                self.loop.call_later(after_s, self._take_turns)
            else:
                self.loop.call_soon(self._take_turns)

    def _take_turns(self) -> None:
        self._turn_scheduled = False
        loop = self.loop
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

    def complain(self, what: str) -> None:
        """Log what was refused, once per sweep: a flood must not fill the log."""
        self._complaints += 1
        if self._complaints == 1:
            log.warning("refused %s", what)

    def slowed(self, connection: Connection) -> None:
        self._slow.add(connection.peer.process)

    # -- watching
    def _sweep_once(self) -> None:
        loop = self.loop
        now = loop.time()
        if self._complaints > 1:
            log.warning("refused %d more connections within %g s", self._complaints - 1, SWEEP_S)
        self._complaints = 0
        self._watch_rates(now)
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

    def _watch_rates(self, now: float) -> None:
        """Log the processes that are over their rate, each once, and forget the rates of those that
        are gone and owe nothing."""
        if fresh := self._slow - self._slow_before:
            log.warning("over their rate, and read more slowly: processes %s", sorted(fresh))
        self._slow_before, self._slow = self._slow, set()
        for key, rate in list(self._rates.items()):
            if key[1] not in self._processes and rate.is_full(now):
                del self._rates[key]

    def _restore_file(self) -> None:
        """Listen again where the socket's file was deleted: without it no client finds the
        server."""
        if self._listener is None or (fresh := self._file.bind_again()) is None:
            return
        self.loop.remove_reader(self._listener.fileno())
        self._listener.close()
        self._listener = fresh
        self.loop.add_reader(fresh.fileno(), self._accept)


def _the(connection: Connection) -> Connection:
    return connection


def _close(fd: int) -> None:
    if fd >= 0:
        os.close(fd)
