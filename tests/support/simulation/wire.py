"""The simulated wire between processes and the daemon: what ZeroMQ over `ipc://` does, with
everything that can go wrong.

Order is kept within one connection; across connections it is not. A connection that breaks loses
what is under way; the daemon sees its end behind all that arrived on it, perhaps after the same
client's next connection, and the client perhaps is not told. Messages are bytes and go through the
real codec on both sides.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import msgpack

from tests.support.simulation.clock import Clock, ProcessLoop
from vram_arbiter.schemas.runtime.peercred import Peer

LATENCY_S = (0.00005, 0.0004)
RECONNECT_S = (0.02, 0.5)
QUEUE_MAX = 4096
"""As `schemas.runtime.connection.OUT_MESSAGES_MAX`: a peer that does not read loses what comes
beyond."""


class Server(Protocol):
    """The daemon, as the wire needs it."""

    def deliver(self, line: "Line", payload: bytes) -> None: ...

    def lost(self, line: "Line") -> None: ...


@dataclass(slots=True)
class WireFaults:
    """How bad the wire is now. Probabilities are per message."""

    delayed: float = 0.0
    delay_s: float = 0.0
    duplicated: float = 0.0


class Line:
    """One connection as the daemon sees it, like `schemas.runtime.connection.Connection`."""

    def __init__(self, serial: int, link: "Link") -> None:
        self.serial = serial
        self.peer = link.peer
        self._link = link

    def admit(self) -> None:
        """There is no time limit for hellos here."""

    def send(self, payload: bytes) -> bool:
        link = self._link
        return link.line is self and not link.loop.dead and link.send_down(payload)

    def close(self, reason: str) -> None:
        self._link.wire.clock.after(self._link.wire.delay_s(), self._hang_up)

    def _hang_up(self) -> None:
        if self._link.line is self:
            self._link.cut(told=True)


class Link:
    """One DEALER socket of a process, from its opening to its closing; the shape of
    `clients.net.dealer.Dealer`."""

    def __init__(
        self,
        wire: "SimWire",
        loop: ProcessLoop,
        peer: Peer,
        received: Callable[[dict[str, Any]], None],
        hung_up: Callable[[], None],
    ) -> None:
        self.wire = wire
        self.loop = loop
        self.peer = peer
        self.line: Line | None = None  # None: not connected
        self.queue_max = QUEUE_MAX
        self.closed = False
        self._received = received
        self._hung_up = hung_up
        self._generation = 0
        self._unsent: list[bytes] = []  # waiting for a connection
        self._up_at = self._down_at = 0.0  # when the newest message of a direction arrives
        self._in_flight_down = 0
        self._inbox: deque[bytes | None] = deque()  # None: the connection broke
        self._arrived = asyncio.Event()
        wire.opened(self)

    # -- the process's side
    def send(self, message: dict[str, Any]) -> bool:
        if self.closed or self.loop.dead:
            return True
        payload: bytes = msgpack.packb(message, use_bin_type=True)
        if self.line is None:
            self._unsent.append(payload)
        else:
            self._go_up(payload)
        return True

    async def run(self) -> None:
        """Hand on what arrives, as a task of the client does."""
        try:
            while True:
                while self._inbox:
                    payload = self._inbox.popleft()
                    if payload is None:
                        self._hung_up()
                        return
                    self._received(msgpack.unpackb(payload, raw=False, strict_map_key=False))
                self._arrived.clear()
                await self._arrived.wait()
        finally:
            self.close()

    def close(self) -> None:
        """LINGER 0: what the kernel does not have yet is lost; what it has arrives, perhaps after a
        newer connection's first word."""
        if self.closed:
            return
        self.closed = True
        if self.wire.clock.chance(0.5):
            self._generation += 1
        self._end()
        self.wire.forget(self)

    # -- the world's side
    def connect(self) -> None:
        """The socket found the daemon."""
        if self.closed or self.loop.dead or self.line is not None or self.wire.server is None:
            return
        self._generation += 1
        self.line = self.wire.register(self)
        self._up_at = self._down_at = 0.0
        self._in_flight_down = 0
        unsent, self._unsent = self._unsent, []
        for payload in unsent:
            self._go_up(payload)

    def cut(self, *, told: bool) -> None:
        """The connection breaks; the socket comes back by itself. `told`: the socket's monitor says
        so to its owner."""
        if self.closed or self.line is None:
            return
        self._generation += 1
        self._end()
        if told:
            self.wire.clock.after(0.001, lambda: self.loop.enter(self._tell_hung_up))
        self.wire.seek(self)

    def _end(self) -> None:
        """The daemon reads the end of the connection behind everything else."""
        if self.line is None:
            return
        line, self.line = self.line, None
        wire, server = self.wire, self.wire.server
        self._up_at = max(self._up_at, wire.clock.now + wire.delay_s())
        wire.clock.at(self._up_at, lambda: wire.arrive_end(server, line))

    def send_down(self, payload: bytes) -> bool:
        """The daemon sends. False: the queue is full."""
        if self._in_flight_down >= self.queue_max:
            self.wire.dropped += 1
            return False
        generation = self._generation
        clock = self.wire.clock
        copies = 2 if clock.chance(self.wire.faults.duplicated) else 1
        for _ in range(copies):
            self._in_flight_down += 1
            self._down_at = max(self._down_at, clock.now + self.wire.delay_s())
            clock.at(
                self._down_at,
                lambda: self.loop.enter(lambda: self._arrive_down(generation, payload)),
            )
        self.wire.duplicates += copies - 1
        return True

    def _go_up(self, payload: bytes) -> None:
        generation, line = self._generation, self.line
        assert line is not None, "sending on a socket without a connection"
        clock, server = self.wire.clock, self.wire.server
        copies = 2 if clock.chance(self.wire.faults.duplicated) else 1
        for _ in range(copies):
            self._up_at = max(self._up_at, clock.now + self.wire.delay_s())
            clock.at(
                self._up_at,
                lambda: self.wire.arrive_up(line, generation == self._generation, server, payload),
            )
        self.wire.duplicates += copies - 1

    def _arrive_down(self, generation: int, payload: bytes) -> None:
        if self.closed or generation != self._generation:
            return
        self._in_flight_down -= 1
        self._inbox.append(payload)
        self._arrived.set()

    def _tell_hung_up(self) -> None:
        if not self.closed:
            self._inbox.append(None)
            self._arrived.set()


class SimWire:
    """All connections. `server` is the daemon that listens now, None while there is none."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.server: Server | None = None
        self.faults = WireFaults()
        self._open: dict[Link, None] = {}
        self._serial = 0
        self.delays = self.dropped = self.duplicates = self.lost = 0

    def delay_s(self) -> float:
        delay = self.clock.random.uniform(*LATENCY_S)
        if self.faults.delayed and self.clock.chance(self.faults.delayed):
            self.delays += 1
            delay += self.clock.random.random() * self.faults.delay_s
        return delay

    def opened(self, link: Link) -> None:
        self._open[link] = None
        self.clock.after(self.delay_s(), link.connect)

    def forget(self, link: Link) -> None:
        """The process closed its socket."""
        self._open.pop(link, None)

    def register(self, link: Link) -> Line:
        self._serial += 1
        return Line(self._serial, link)

    def seek(self, link: Link) -> None:
        self.clock.after(self.clock.random.uniform(*RECONNECT_S), link.connect)

    def listening(self, server: Server) -> None:
        self.server = server
        for link in self._open:
            self.seek(link)

    def gone(self) -> None:
        """The daemon's socket is gone: every connection breaks. Libzmq's monitors tell most of the
        clients."""
        self.server = None
        for link in list(self._open):
            link.cut(told=self.clock.chance(0.8))

    def arrive_up(
        self, line: Line, same_connection: bool, server: Server | None, payload: bytes
    ) -> None:
        """Also from a socket closed meanwhile: then the messages are older than what its owner says
        now."""
        if self.server is None or self.server is not server or not same_connection:
            self.lost += 1
            return
        self.server.deliver(line, payload)

    def arrive_end(self, server: Server | None, line: Line) -> None:
        if self.server is not None and self.server is server:
            self.server.lost(line)

    def open_links(self) -> list[Link]:
        return [link for link in self._open if link.line is not None and not link.loop.dead]
