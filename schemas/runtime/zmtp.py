"""ZMTP 3.1 for a ROUTER, without I/O: bytes in, events and bytes out.

Implements the server side of https://rfc.zeromq.org/spec/37/ with the NULL mechanism, for DEALER
and REQ peers of any ZeroMQ library from version 4.0 on. Every length is checked before a byte of it
is kept: memory is bounded by `WireLimits.message_max_bytes` and one read of the caller, whatever a
peer sends. Must not know sockets, loops or what a message means.
"""

import struct
from dataclasses import dataclass

SIGNATURE = b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x7f"
GREETING_BYTES = 64
MECHANISM = b"NULL".ljust(20, b"\x00")
GREETING = SIGNATURE + b"\x03\x01" + MECHANISM + bytes(32)
"""What a server says first: signature, version 3.1, mechanism, as-server 0, filler."""

MORE, LONG, COMMAND = 0x01, 0x02, 0x04
COMMAND_MAX_BYTES = 1024
"""READY with the longest identity (255 bytes) and a few properties of its own; PING has at most 23
bytes.
"""
CONTEXT_MAX_BYTES = 16
"""Longest context of a PING, which its PONG repeats (specification, "Connection heartbeating")."""
FRAMES_MAX = 8
"""Frames of one message. A DEALER sends one, a REQ two, a REQ with a request id three, and each
proxy on the way adds one; without end they are an attack.
"""
ENVELOPE_MAX_BYTES = 512
"""Bytes of the frames before the payload, which the answer repeats. A request id has 4 bytes, a
proxy's routing id at most 255.
"""
PEER_TYPES = frozenset((b"DEALER", b"REQ"))

_LONG_SIZE = struct.Struct(">Q")
_PROPERTY_SIZE = struct.Struct(">I")

_READY_BODY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x06ROUTER\x08Identity\x00\x00\x00\x00"
READY = bytes((COMMAND, len(_READY_BODY))) + _READY_BODY


class ZmtpError(Exception):
    """The peer broke the protocol or a limit that cannot be answered; the connection has to end.
    The text says how.
    """


@dataclass(frozen=True, slots=True)
class WireLimits:
    """Sizes in bytes. A message over `message_max_bytes` is skipped and reported, over
    `skip_max_bytes` it is an error.
    """

    message_max_bytes: int
    skip_max_bytes: int


@dataclass(frozen=True, slots=True)
class PeerReady:
    """The handshake has ended; messages may be sent from here on."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A PING, answered in `outgoing`, or a PONG. An event, so that the caller can bound the work of
    one turn.
    """


@dataclass(frozen=True, slots=True)
class Message:
    """One complete message. `envelope`: the frames up to an empty one, as they go over the wire;
    a REQ expects them back before the answer.

    `payload` is the last frame; empty where the frames were neither `[payload]` nor `[…, "",
    payload]`.
    """

    payload: bytes | bytearray
    envelope: bytes = b""


@dataclass(frozen=True, slots=True)
class Oversize:
    """A message of `size` bytes, over the limit of `limit` bytes, was skipped without being
    kept.
    """

    size: int
    limit: int
    envelope: bytes = b""


Event = PeerReady | Heartbeat | Message | Oversize


class ServerConnection:
    """One connection as a ROUTER sees it.

    `feed` bytes, call `next_event` until it returns None, and send what `outgoing` returns. After a
    ZmtpError nothing may be called any more but `outgoing`.
    """

    def __init__(self, limits: WireLimits) -> None:
        self.limits = limits
        self.unread_bytes = 0
        """Bytes fed that `next_event` has not looked at."""
        self.kept_bytes = 0
        """Bytes held for this connection: unread ones, and the message under way."""
        self._data: bytes = b""
        self._at = 0
        self._outgoing = bytearray(GREETING)
        self._greeted = False
        self._ready = False
        # the frame under way
        self._body: bytes | bytearray | None = None  # None: its header is not complete
        self._missing = 0
        self._flags = 0
        # the message under way
        self._frames = 0
        self._size = 0
        self._skipping = False
        self._envelope = b""
        self._enveloped = 0  # number of the frame that ended the envelope; 0: none has

    def feed(self, data: bytes) -> None:
        """Take bytes from the peer, behind those that are unread."""
        self._data = data if self._at == len(self._data) else self._data[self._at :] + data
        self._at = 0
        self.unread_bytes = len(self._data)
        self.kept_bytes += len(data)

    def outgoing(self) -> bytes:
        """Return the bytes to send to the peer, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def next_event(self) -> Event | None:
        """Return the next event; None where more bytes are needed. Raises ZmtpError.

        1. The greeting, once. 2. The header of a frame, checked before a byte of its body is kept.
        3. What is there of its body. 4. Its end: a command, or the last frame of a message.
        """
        event = None
        if self._greeted or self._read_greeting():  # 1
            while event is None and (self._body is not None or self._begin_frame()):  # 2
                at = self._at
                taken = min(self._missing, len(self._data) - at)  # 3
                if not self._skipping or self._flags & COMMAND:
                    if taken == self._missing and not self._body:  # all of it in one read, as usual
                        self._body = self._data[at : at + taken]
                    else:
                        if not isinstance(self._body, bytearray):
                            self._body = bytearray()
                        self._body += memoryview(self._data)[at : at + taken]
                self._at += taken
                self._missing -= taken
                if self._missing:
                    break
                event = self._end_frame()  # 4
        self.unread_bytes = len(self._data) - self._at
        body = 0 if self._body is None else len(self._body)
        self.kept_bytes = self.unread_bytes + body + len(self._envelope)
        return event

    # -- greeting
    def _read_greeting(self) -> bool:
        have = self._data[self._at : self._at + GREETING_BYTES]
        # what is wrong is said as soon as it is there: a client of another protocol may never send
        # 64 bytes
        if have[:1] not in (b"", b"\xff") or (len(have) >= 10 and have[9] & 1 == 0):
            raise ZmtpError("not a ZMTP greeting")
        if len(have) >= 11 and have[10] < 3:
            raise ZmtpError(f"the peer speaks ZMTP {have[10]}.x, 3.0 or newer is needed")
        if len(have) < GREETING_BYTES:
            return False
        if have[12:32] != MECHANISM:
            raise ZmtpError("the peer asks for another security mechanism than NULL")
        self._at += GREETING_BYTES
        self._greeted = True
        self._outgoing += READY
        return True

    # -- frames
    def _begin_frame(self) -> bool:
        """Read flags and size of the next frame, and check both. False: more bytes are needed."""
        data, at = self._data, self._at
        if at >= len(data):
            return False
        flags = data[at]
        if flags & LONG:
            if len(data) - at < 9:
                return False
            (size,) = _LONG_SIZE.unpack_from(data, at + 1)
            self._at = at + 9
        else:
            if len(data) - at < 2:
                return False
            size = data[at + 1]
            self._at = at + 2
        if flags & ~(MORE | LONG | COMMAND) or flags & (MORE | COMMAND) == MORE | COMMAND:
            raise ZmtpError(f"frame flags {flags:#04x} are not allowed")
        self._flags, self._missing, self._body = flags, size, b""
        if flags & COMMAND:
            if size > COMMAND_MAX_BYTES:
                raise ZmtpError(
                    f"a command of {size} bytes, at most {COMMAND_MAX_BYTES} are allowed"
                )
        elif not self._ready:
            raise ZmtpError("a message before READY")
        else:
            self._frames += 1
            self._size += size
            if self._frames > FRAMES_MAX:
                raise ZmtpError(f"a message of more than {FRAMES_MAX} frames")
            if self._size > self.limits.skip_max_bytes:
                raise ZmtpError(
                    f"a message of {self._size} bytes or more, at most "
                    f"{self.limits.skip_max_bytes} are read"
                )
            if self._size > self.limits.message_max_bytes:
                self._skipping = True
        return True

    def _end_frame(self) -> Event | None:
        body = self._body
        assert body is not None
        self._body = None
        if self._flags & COMMAND:
            return self._command(bytes(body))
        if self._flags & MORE:
            if not self._enveloped:
                self._add_to_envelope(body)
            return None
        envelope = self._envelope if self._enveloped else b""
        event: Event
        if self._skipping:
            event = Oversize(self._size, self.limits.message_max_bytes, envelope)
        else:
            form_known = self._frames == self._enveloped + 1
            event = Message(body if form_known else b"", envelope)
        self._frames = self._size = self._enveloped = 0
        self._skipping = False
        self._envelope = b""
        return event

    def _add_to_envelope(self, frame: bytes | bytearray) -> None:
        """Keep a frame before the payload; an empty one ends the envelope."""
        size = len(frame)
        if self._skipping or size > 255 or len(self._envelope) + 2 + size > ENVELOPE_MAX_BYTES:
            # not an envelope: no later frame is taken for one, or for the payload behind it
            self._envelope, self._enveloped = b"", FRAMES_MAX
            return
        self._envelope += bytes((MORE, size)) + frame
        if not size:
            self._enveloped = self._frames

    # -- commands
    def _command(self, body: bytes) -> Event:
        if not body or len(body) < 1 + body[0]:
            raise ZmtpError("a command without a name")
        name, rest = body[1 : 1 + body[0]], body[1 + body[0] :]
        if not self._ready:
            if name == b"ERROR":
                raise ZmtpError("the peer refused the handshake")
            if name != b"READY":
                raise ZmtpError("a command before READY")
            _check_properties(rest)
            self._ready = True
            return PeerReady()
        if name == b"PING":
            if not 2 <= len(rest) <= 2 + CONTEXT_MAX_BYTES:
                raise ZmtpError(f"a PING of {len(rest)} bytes")
            pong = b"\x04PONG" + rest[2:]
            self._outgoing += bytes((COMMAND, len(pong))) + pong
            return Heartbeat()
        if name == b"PONG" and len(rest) <= CONTEXT_MAX_BYTES:
            return Heartbeat()
        raise ZmtpError(f"an unexpected command {name[:32].decode('latin-1')!a}")


def encode(payload: bytes, envelope: bytes = b"") -> bytes:
    """Return one message as it goes over the wire, behind the envelope of what it answers."""
    if len(payload) < 256:
        return envelope + bytes((0, len(payload))) + payload
    return envelope + b"\x02" + _LONG_SIZE.pack(len(payload)) + payload


def _check_properties(data: bytes) -> None:
    """Check READY's properties: well-formed, and the socket type of a peer that a ROUTER serves.
    Raises ZmtpError.
    """
    at, found = 0, None
    while at < len(data):
        name_end = at + 1 + data[at]
        if data[at] == 0 or len(data) < name_end + 4:
            raise ZmtpError("a malformed property in READY")
        (size,) = _PROPERTY_SIZE.unpack_from(data, name_end)
        value_end = name_end + 4 + size
        if len(data) < value_end:
            raise ZmtpError("a malformed property in READY")
        # names are case-insensitive (specification, "The NULL security mechanism")
        if data[at + 1 : name_end].lower() == b"socket-type":
            found = data[name_end + 4 : value_end]
        at = value_end
    if found not in PEER_TYPES:
        raise ZmtpError("the peer's socket is neither a DEALER nor a REQ")
