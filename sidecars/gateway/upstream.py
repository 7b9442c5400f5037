"""Connections to model servers. An answer is read to the end of its head; of its body only where it
ends is looked for, and the bytes go from one transport to the other as they came (RFC 9112).
"""

import asyncio
import math
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final

from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.schemas.urls import http_address

CONNECT_S: Final = 10.0
KEPT_S: Final = 1.0
"""A connection is used again within this time alone: servers close idle ones after 5 s and more,
and a request that meets that fails."""
HIGH_BYTES: Final = 1 << 16
"""More than this is not held for a receiver; no head is longer."""
SWITCHING: Final = 101
EVENT: Final = b"data:"
"""Begins the data of an event (WHATWG HTML, 9.2.6)."""
_FIELD: Final = re.compile(rb"([!#$%&'*+.^_`|~\w-]++):[ \t]*+([^\r\n\0]*)\r\n", re.ASCII)
_HEAD: Final = re.compile(
    rb"(?P<line>HTTP/1\.(?P<version>[01]) (?P<code>[1-5]\d\d)(?P<reason>(?: [^\r\n\0]*)?)\r\n)"
    rb"(?:%b)*+" % _FIELD.pattern,
    re.ASCII,
)
_SIZE: Final = re.compile(rb"(?:\r\n)?([0-9A-Fa-f]{1,15})[ \t]*(?:;[^\r\n]*)?\r\n")
"""Behind the end of the chunk before."""
_TRAILER: Final = re.compile(rb"[^\r\n]*\r\n")

type Field = tuple[bytes, bytes]


def malformed(what: str) -> SidecarUnavailable:
    return SidecarUnavailable(f"the server's answer is not HTTP/1.1: {what}", hint="see /logs")


class Counted:
    """A body of `left` bytes; math.inf: it ends with the connection, so is not
    `bounded`. `spare`: more bytes came."""

    def __init__(self, left: float) -> None:
        self.left, self.spare = left, False
        self.bounded = not math.isinf(left)

    @property
    def over(self) -> bool:
        return not self.left

    def take(self, data: bytes) -> bytes:
        """Return what the client gets of bytes that came."""
        if len(data) > self.left:
            data, self.spare = data[: int(self.left)], True
        self.left -= len(data)
        return data


class Chunked:
    """A body in chunks (RFC 9112, 7.1), passed as it is, or decoded."""

    def __init__(self, *, decoded: bool) -> None:
        self.over, self.spare, self.bounded = False, False, True
        self._decoded = decoded
        self._left = 0  # of a chunk
        self._line = b""  # a size or a trailer that is not whole yet
        self._ending = False  # the last chunk was there

    def take(self, data: bytes) -> bytes:
        """As `Counted.take`. Raises SidecarUnavailable."""
        at, known, parts = 0, len(self._line), []
        data, self._line = self._line + data, b""
        while at < len(data) and not self.over:
            if self._left:
                end = min(at + self._left, len(data))
                if self._decoded:
                    parts.append(data[at:end])
                self._left -= end - at
            elif (found := (_TRAILER if self._ending else _SIZE).match(data, at)) is not None:
                end = found.end()
                if self._ending:
                    self.over = found[0] == b"\r\n"
                else:
                    self._left = int(found[1], 16)
                    self._ending = not self._left
            elif b"\n" in data[at + 2 :] or len(data) - at > HIGH_BYTES:
                raise malformed("a chunk has no size")
            else:
                self._line, end = data[at:], len(data)
            at = end
        self.spare = at < len(data)
        return b"".join(parts) if self._decoded else data[known:at]


type Body = Counted | Chunked


@dataclass(frozen=True, slots=True)
class Head:
    """Status line and header fields of an answer. `version`: the digit behind `HTTP/1.`."""

    version: bytes
    status: int
    reason: bytes
    fields: list[Field]

    def values(self, name: bytes) -> list[bytes]:
        """Return the elements of a list field (RFC 9110, 5.6.1), in small letters."""
        lines = [value for key, value in self.fields if key.lower() == name]
        return [one.strip().lower() for value in lines for one in value.split(b",")]

    @property
    def lasts(self) -> bool:
        """Whether the server keeps the connection."""
        return self.version == b"1" and b"close" not in self.values(b"connection")

    def body(self, method: str, *, decoded: bool) -> Body:
        """Return the body that follows (RFC 9112, 6.3). Raises SidecarUnavailable for one without a
        certain end."""
        lengths, codings = {*self.values(b"content-length")}, self.values(b"transfer-encoding")
        if len(lengths) > 1 or (lengths and codings) or codings not in ([], [b"chunked"]):
            raise malformed("its length is ambiguous")
        if method == "HEAD" or self.status in (204, 304):
            return Counted(0)
        if codings:
            return Chunked(decoded=decoded)
        if not lengths:
            return Counted(math.inf)
        if not (length := lengths.pop()).isdigit() or len(length) > 18:
            raise malformed("its length is not a number")
        return Counted(int(length))


def read_head(data: bytes) -> Head:
    """Read a head without its empty line. Raises SidecarUnavailable."""
    status = _HEAD.fullmatch(data)
    if status is None:
        raise malformed("its head cannot be read")
    fields = _FIELD.findall(data, status.end("line"))
    return Head(status["version"], int(status["code"]), status["reason"], fields)


class Connection(asyncio.Protocol):
    """A connection to a server, for one request at a time."""

    def __init__(self) -> None:
        self._transport: asyncio.Transport
        self._data = bytearray()  # came, and is not taken
        self._body: Body = Counted(0)
        self._sink: asyncio.WriteTransport | None = None  # where the body goes
        self._on_event: Callable[[], None] | None = None  # waits for the first event of a stream
        self._blocked = False
        self._ended: Exception | None = None
        self._changed = asyncio.Event()
        self.kept_at = 0.0

    # -- what asyncio calls
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        if (sink := self._sink) is None:
            self._data += data
            full = len(self._data) > HIGH_BYTES
        else:
            try:
                passed = self._body.take(data)
                sink.write(passed)
                self._look_for_event(passed)
            except SidecarUnavailable as error:
                self.fail(error)
            full = sink.get_write_buffer_size() > HIGH_BYTES
        if full:
            self._transport.pause_reading()
        if full or sink is None or self._body.over:
            self._changed.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self._ended = self._ended or exc or ConnectionResetError("it hung up")
        self._changed.set()

    def pause_writing(self) -> None:
        self._blocked = True

    def resume_writing(self) -> None:
        self._blocked = False
        self._changed.set()

    # -- what a request does
    @property
    def usable(self) -> bool:
        """Whether the next request may use it."""
        return not self._data and not self._body.spare and not self._transport.is_closing()

    def write(self, data: bytes) -> None:
        self._transport.write(data)

    async def drain(self) -> None:
        """Wait until the server takes more. Raises what ended the connection."""
        await self._until(lambda: not self._blocked)
        if self._ended is not None:
            raise self._ended

    async def head(self) -> Head:
        """Return the head of the answer. Raises SidecarUnavailable, or what ended the
        connection."""
        while True:
            await self._until(lambda: b"\r\n\r\n" in self._data or len(self._data) > HIGH_BYTES)
            data, found, rest = self._take().partition(b"\r\n\r\n")
            if not found:
                raise self._ended or malformed("its head is too long")
            head = read_head(data + b"\r\n")
            self._data += rest
            if head.status >= 200 or head.status == SWITCHING:
                return head

    async def pass_body(
        self,
        head: bytes,
        body: Body,
        sink: asyncio.WriteTransport,
        drained: Callable[[], Awaitable[None]],
        on_event: Callable[[], None] | None = None,
    ) -> None:
        """Send `head` and the body to `sink`, until the body is over. `on_event`: called at the
        first event of an event stream. Raises what ended the connection before."""
        passed = body.take(self._take())
        sink.write(head + passed)
        self._body, self._sink, self._on_event = body, sink, on_event
        self._look_for_event(passed)
        try:
            while not body.over and self._ended is None:
                self._changed.clear()
                await drained()
                self._transport.resume_reading()
                await self._changed.wait()
        finally:
            self._sink = self._on_event = None
            self._transport.resume_reading()  # for the next request
        if self._ended is not None and not body.over and body.bounded:
            raise self._ended

    def _look_for_event(self, data: bytes) -> None:
        """Servers may send comments before the first event."""
        if self._on_event is not None and EVENT in data:
            self._on_event()
            self._on_event = None

    async def read(self) -> bytes:
        """Return what came; b"" at the end."""
        await self._until(lambda: bool(self._data))
        self._transport.resume_reading()
        return self._take()

    def fail(self, error: Exception) -> None:
        """End it; what waits for it gets the error."""
        self._ended = self._ended or error
        self._transport.abort()

    def close(self) -> None:
        self._transport.abort()

    async def _until(self, condition: Callable[[], bool]) -> None:
        """Wait for what the server does, or the end."""
        while not condition() and self._ended is None:
            self._changed.clear()
            await self._changed.wait()

    def _take(self) -> bytes:
        data = bytes(self._data)
        self._data.clear()
        return data


class Upstream:
    """A server, and its connections that wait for a request."""

    def __init__(self, url: str) -> None:
        self.host = url.removeprefix("http://")
        self._idle: list[Connection] = []

    async def take(self) -> Connection:
        """Return a kept connection, or a new one. Raises OSError."""
        loop = asyncio.get_running_loop()
        while self._idle:
            connection = self._idle.pop()
            if connection.usable and loop.time() < connection.kept_at + KEPT_S:
                return connection
            connection.close()
        address = http_address(self.host)
        async with asyncio.timeout(CONNECT_S):
            _, made = await loop.create_connection(Connection, address.host, address.port)
        return made

    def keep(self, connection: Connection) -> None:
        """Keep a connection whose request is over."""
        connection.kept_at = asyncio.get_running_loop().time()
        self._idle.append(connection)
