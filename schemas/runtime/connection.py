"""One connection of the router: framing, the bounds on its bytes, and when it is read.

Must not know other connections: what concerns several is asked of its router.
"""

import asyncio
import logging
from dataclasses import dataclass
from typing import Protocol

from vram_arbiter.schemas.defaults import (
    KIB,
    MESSAGE_MAX_BYTES,
    MIB,
    RATE_PER_CLIENT_PER_S,
    RATE_PER_PROCESS_PER_S,
)
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.rate import Rate
from vram_arbiter.schemas.runtime.zmtp import (
    Heartbeat,
    Message,
    Oversize,
    PeerReady,
    ServerConnection,
    WireLimits,
    ZmtpError,
    encode,
)

log = logging.getLogger(__name__)

READ_AHEAD_BYTES = 16 * KIB
"""Unread bytes from which on a connection that waits for its turn is not read any further."""
OUT_MESSAGES_MAX = 4096
"""Messages queued for a peer that does not read."""
SKIPPED_SHARE = 64
"""Bytes that are skipped cost so many times less than bytes that are decoded."""


@dataclass(frozen=True, slots=True)
class Bounds:
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
    rate_per_client_per_s: float = RATE_PER_CLIENT_PER_S
    """Messages of one connection. Over its rate it is not read for so long; nothing is lost."""
    rate_per_process_per_s: float = RATE_PER_PROCESS_PER_S
    """The same for all connections of one process together."""
    charge_bytes: int = KIB
    """A message counts as one, and as one more for each of these many bytes."""
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

    def received(self, connection: "Connection", payload: bytes | bytearray | Oversize) -> None:
        """One message came; `Oversize` where it was skipped."""

    def disconnected(self, connection: "Connection", reason: str) -> None:
        """A connection of which `connected` was told has ended."""


@dataclass(slots=True)
class User:
    """Bytes and connections of one uid."""

    connections: int = 0
    in_bytes: int = 0
    out_bytes: int = 0


class Server(Protocol):
    """The server that a connection belongs to (`router.Router`)."""

    limits: Bounds
    loop: asyncio.AbstractEventLoop
    handler: Handler
    receiving: bool

    def admitted(self, connection: "Connection") -> None: ...
    def readable(self, connection: "Connection") -> None: ...
    def lost(self, connection: "Connection", reason: str) -> None: ...
    def complain(self, problem: str) -> None: ...
    def slowed(self, connection: "Connection") -> None: ...


class Connection(asyncio.Protocol):
    """One peer's connection. `serial` is unique within its router; a peer's own ZeroMQ identity is
    ignored.
    """

    def __init__(
        self, router: Server, serial: int, peer: Peer, user: User, process_rate: Rate, now: float
    ) -> None:
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
        rate = float(limits.rate_per_client_per_s)
        self._rates = Rate(rate, rate, now), process_rate
        self._wire = ServerConnection(
            WireLimits(limits.stranger_message_max_bytes, limits.skip_max_bytes)
        )
        self.envelope = b""
        """Of the last message received. Answers to it repeat it (`zmtp.Message.envelope`)."""
        self._resting = False  # over its rate
        self._clogged = False  # bytes wait for the peer to read
        self._finishing = False  # nothing more is sent
        self._paused = False  # not read for now
        self._in_bytes = 0
        self._out_bytes = 0
        self._out_messages = 0
        self._reason = "the peer hung up"

    def __repr__(self) -> str:
        return f"<connection {self.serial} of process {self.peer.process}, uid {self.peer.uid}>"

    # -- for handlers ----------------------------------------------------------------------------
    def admit(self) -> None:
        """The peer has said hello: the time limit of `hello_s` ends, and messages may have their
        full size.
        """
        self.admitted = True
        limits = self._router.limits
        self._wire.limits = WireLimits(limits.message_max_bytes, limits.skip_max_bytes)
        self._router.admitted(self)

    def send(self, payload: bytes, envelope: bytes | None = None) -> bool:
        """Queue one message, in the envelope of the last one received unless another one is given.
        False: the peer is gone or does not read.
        """
        transport = self._transport
        if transport is None or self._finishing or transport.is_closing():
            return False
        frames = encode(payload, self.envelope if envelope is None else envelope)
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
        self._router.loop.call_later(self._router.limits.handshake_s, transport.abort)

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
        self._router.readable(self)

    def pause_writing(self) -> None:
        self._clogged = True
        self._count_out()
        self.update_reading()

    def resume_writing(self) -> None:
        self._clogged = False
        self._out_messages = 0
        self._count_out()
        self._router.readable(self)  # requests wait until their sender has read the answers before

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._router.lost(self, self._reason if exc is None else f"{exc}")

    # -- for the router --------------------------------------------------------------------------
    def cut(self, reason: str) -> None:
        """Hang up now; what is queued is lost."""
        self._reason = reason
        if self._transport is not None:
            self._transport.abort()
        self._router.lost(self, reason)

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

        1. The next event, unless the peer is over its rate or does not read. 2. Its handler; one
        bad message must not cost the others their server. 3. Bytes kept, and reading on.
        """
        wire, event = self._wire, None
        try:
            if not (self._resting or self._clogged or self._finishing):
                event = wire.next_event()  # 1
        except ZmtpError as error:
            self._flush_wire()
            self._router.complain(f"process {self.peer.process} of uid {self.peer.uid}: {error}")
            self.cut(f"protocol error: {error}")
            return False
        try:
            match event:  # 2
                case Message() | Oversize() if self._router.receiving:
                    self.envelope = event.envelope
                    payload = event.payload if isinstance(event, Message) else event
                    self._charge(self._cost(payload))
                    self._router.handler.received(self, payload)
                case PeerReady():
                    self._flush_wire()
                    self.ready = True
                    self._charge(0)  # its process may owe some
                    self._router.handler.connected(self)
                case Heartbeat() | None:
                    self._flush_wire()
        except Exception:
            log.exception("a message of %r could not be handled", self)
        if wire.kept_bytes != self._in_bytes:  # 3
            self._count_in()
        if self.ended:
            return False
        if self._paused or self._resting or self._clogged or wire.unread_bytes:
            self.update_reading()
        stopped = self._resting or self._clogged or self._finishing
        return event is not None and wire.unread_bytes > 0 and not stopped

    def _cost(self, payload: bytes | bytearray | Oversize) -> int:
        each = self._router.limits.charge_bytes
        if isinstance(payload, Oversize):
            return 1 + payload.size // (SKIPPED_SHARE * each)
        return 1 + len(payload) // each

    def _charge(self, cost: int) -> None:
        """Charge the connection and its process, and handle nothing more until both may send
        again."""
        loop = self._router.loop
        now = loop.time()
        rest_s = max([rate.charge(cost, now) for rate in self._rates])
        if rest_s > 0:
            self._resting = True
            self._router.slowed(self)
            loop.call_later(rest_s, self._rested)

    def _rested(self) -> None:
        self._resting = False
        if not self.ended:
            self._router.readable(self)

    def _flush_wire(self) -> None:
        data = self._wire.outgoing()
        if data and self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    def update_reading(self) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        full = self._resting or self._clogged or self._wire.unread_bytes > READ_AHEAD_BYTES
        self._paused = full and not self._finishing
        if self._paused:
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
