"""Bytes between a client and a model server, both ways and unchanged, with backpressure.

Hop-by-hop headers stay on their hop (RFC 9110, 7.6.1). Nothing is retried: a request that reached
its server may have done its work.
"""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from contextlib import AbstractAsyncContextManager
from typing import Any, Final

from aiohttp import HttpVersion11, StreamReader, web

from vram_arbiter.schemas.errors import BadRequest, SidecarUnavailable, VramError
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.sidecars.gateway.reply import Reply
from vram_arbiter.sidecars.gateway.upstream import (
    HIGH_BYTES,
    SWITCHING,
    Connection,
    Field,
    Head,
    Upstream,
    malformed,
)

WS_QUIET_S: Final = 5.0
WS_GOING_AWAY: Final = b"\x88\x02\x03\xe9"
"""A close frame with 1001 (RFC 6455, 7.4.1)."""
WS_HEAD_MAX_BYTES: Final = 14
WS_PIECE_BYTES: Final = 1 << 14
EVENT_STREAM: Final = b"text/event-stream"
HOP_BY_HOP: Final = frozenset(
    (b"connection", b"keep-alive", b"proxy-authenticate", b"proxy-authorization",
     b"proxy-connection", b"te", b"trailer", b"transfer-encoding", b"upgrade")
)  # fmt: skip
OWN: Final = frozenset((b"host", b"expect"))
"""Headers that are between a client and the gateway."""
KEYS: Final = frozenset((b"authorization", b"x-api-key"))
"""As well, where they are checked here, or the server asks for a key of its own."""


class Unreached(SidecarUnavailable):
    """The server took no connection, so that the request can be sent again."""


def end_to_end(fields: Iterable[Field], without: frozenset[bytes]) -> list[Field]:
    """Return the header fields that go to the next hop."""
    dropped = HOP_BY_HOP | without
    for name, value in fields:
        if name.lower() == b"connection":
            dropped |= {token.strip().lower() for token in value.split(b",")}
    return [(name, value) for name, value in fields if name.lower() not in dropped]


def upstream_fields(
    request: web.BaseRequest, *, checked: bool, upstream_key: str | None
) -> list[Field]:
    """Return a request's headers for the server. `checked`: the gateway asks for keys, which are
    not the server's matter."""
    fields = end_to_end(request.raw_headers, OWN | KEYS if checked or upstream_key else OWN)
    if upstream_key:
        fields.append((b"Authorization", b"Bearer " + upstream_key.encode()))
    if is_websocket(request):
        fields += [(b"Connection", b"Upgrade"), (b"Upgrade", b"websocket")]
    if _chunked(request):
        fields.append((b"Transfer-Encoding", b"chunked"))
    return fields


def is_websocket(request: web.BaseRequest) -> bool:
    return request.headers.get("upgrade", "").lower() == "websocket"


def _chunked(request: web.BaseRequest) -> bool:
    return "transfer-encoding" in request.headers


def _head(start: bytes, fields: Iterable[Field]) -> bytes:
    lines = [start, *(name + b": " + value for name, value in fields)]
    return b"\r\n".join(lines) + b"\r\n\r\n"


async def read_some(
    request: web.BaseRequest, silence_s: float, most_bytes: int = HIGH_BYTES
) -> bytes:
    """Return what came of a body, b"" at its end. Raises BadRequest for one that is broken, or
    silent."""
    try:
        if data := request.content.read_nowait(most_bytes):
            return data
        async with asyncio.timeout(silence_s):
            return await request.content.read(most_bytes)
    except TimeoutError:
        raise BadRequest(f"nothing of the body came for {silence_s:g} s") from None
    except web.RequestPayloadError as error:
        raise BadRequest(f"the body cannot be read: {error}") from error


async def forward(
    upstream: Upstream,
    reply: Reply,
    target: str,
    fields: list[Field],
    begun: bytes,
    silence_s: float,
) -> Connection | None:
    """Send a request to a server, and its answer to the client. Return the connection where both
    changed to WebSocket; `tunnel` goes on with it.

    `begun`: what was read of the body. `silence_s`: longest pause of the rest. Raises Unreached,
    SidecarUnavailable; BadRequest: the body is broken or silent.
    """
    try:
        connection = await upstream.take()
    except OSError as error:
        raise Unreached(f"the server takes no connection: {error}", hint="see /logs") from error
    request, upload = reply.request, None
    try:
        host = (b"Host", upstream.host.encode())
        start = f"{request.method} {target} HTTP/1.1".encode("utf-8", "surrogateescape")
        begun += request.content.read_nowait()
        connection.write(_head(start, [host, *fields]) + _framed(request, begun))
        if not request.content.at_eof():
            upload = asyncio.create_task(_upload(connection, request, silence_s))
        head = await _answer(connection, reply)
    except OSError as error:
        connection.close()
        raise SidecarUnavailable(
            f"the server does not answer: {error}", hint="see /logs"
        ) from error
    except BaseException:
        connection.close()
        raise
    finally:
        whole = upload is None or upload.done()
        if upload is not None:
            upload.cancel()
    if head.status == SWITCHING:
        return connection
    if head.lasts and whole and connection.usable:
        upstream.keep(connection)
    else:
        connection.close()
    return None


def _framed(request: web.BaseRequest, data: bytes) -> bytes:
    """Return bytes of a body as the server gets them, with its end where all was read."""
    if not _chunked(request):
        return data
    chunk = b"%x\r\n%b\r\n" % (len(data), data) if data else b""
    return chunk + b"0\r\n\r\n" if request.content.at_eof() else chunk


async def _upload(connection: Connection, request: web.BaseRequest, silence_s: float) -> None:
    try:
        while not request.content.at_eof():
            data = await read_some(request, silence_s)
            connection.write(_framed(request, data))
            await connection.drain()
    except (OSError, VramError) as error:
        connection.fail(error)


async def _answer(connection: Connection, reply: Reply) -> Head:
    """Pass an answer on, and return its head. Raises SidecarUnavailable, OSError."""
    request = reply.request
    head = await connection.head()
    tracing.event(telemetry.EVENT_FIRST_BYTE)
    fields = end_to_end(head.fields, frozenset())
    start = b"HTTP/1.1 %d%b" % (head.status, head.reason)
    if head.status == SWITCHING:
        if not is_websocket(request):
            raise malformed("it changes the protocol")
        fields += [(b"Connection", b"Upgrade"), (b"Upgrade", b"websocket")]
        reply.transport.write(_head(start, fields))
        reply.passes = True
        return head
    decoded = reply.streams or request.version < HttpVersion11
    body = head.body(request.method, decoded=decoded)
    if head.values(b"transfer-encoding") and not decoded:
        fields.append((b"Transfer-Encoding", b"chunked"))
    reply.lasts = request.keep_alive and not decoded and body.bounded
    if not reply.lasts:
        fields.append((b"Connection", b"close"))
    said = b"" if reply.streams else _head(start, fields)
    reply.passes, reply.status = True, head.status
    streams = any(kind.startswith(EVENT_STREAM) for kind in head.values(b"content-type"))
    on_event = reply.streamed if streams and head.status == 200 else None
    await connection.pass_body(said, body, reply.transport, request.writer.drain, on_event)
    return head


async def tunnel(
    reply: Reply, server: Connection, turn: Callable[[], AbstractAsyncContextManager[Any]]
) -> None:
    """Pass the bytes of a WebSocket both ways until either end hangs up.

    A turn is taken for each burst of messages, until it was quiet for WS_QUIET_S: an open page of
    ComfyUI must not keep its server on the GPU.
    """
    request, client = reply.request, reply.transport
    incoming = StreamReader(request.protocol, HIGH_BYTES, loop=asyncio.get_running_loop())
    request.protocol.set_parser(_Incoming(incoming))  # type: ignore[arg-type]
    bursts, back = _Bursts(turn), _Frames()
    tasks = [
        asyncio.create_task(bursts.run()),
        asyncio.create_task(
            _one_way(incoming.readany, _Frames(), bursts, server.write, server.drain)
        ),
        asyncio.create_task(
            _one_way(server.read, back, bursts, client.write, request.writer.drain)
        ),
    ]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        server.close()
        if back.between:
            client.write(WS_GOING_AWAY)


async def _one_way(
    read: Callable[[], Awaitable[bytes]],
    frames: "_Frames",
    bursts: "_Bursts",
    write: Callable[[bytes], None],
    drain: Callable[[], Awaitable[None]],
) -> None:
    while data := await read():
        for at in range(0, len(data), WS_PIECE_BYTES):
            piece = data[at : at + WS_PIECE_BYTES]
            if frames.message_in(piece):
                await bursts.message()
            write(piece)
            await drain()
            await asyncio.sleep(0)  # others go on: thousands of frames may be in a piece


class _Incoming:
    """Hands a client's bytes on, as aiohttp asks a parser."""

    def __init__(self, reader: StreamReader) -> None:
        self._reader = reader
        self.feed_eof = reader.feed_eof

    def feed_data(self, data: bytes) -> tuple[bool, bytes]:
        self._reader.feed_data(data)
        return False, b""


class _Frames:
    """Tells messages from control frames in one way of a WebSocket (RFC 6455, 5.2)."""

    def __init__(self) -> None:
        self._head, self._left = b"", 0
        self._is_message = False

    @property
    def between(self) -> bool:
        """Whether no frame is begun."""
        return not self._head and not self._left

    def message_in(self, data: bytes) -> bool:
        """Return whether bytes of a message are among these."""
        at, found = 0, False
        while at < len(data):
            if not self._left:
                head = self._head + data[at : at + WS_HEAD_MAX_BYTES]
                size, self._left = _sizes(head)
                at += min(size, len(head)) - len(self._head)
                self._head = head if len(head) < size else b""
                self._is_message = not head[0] & 0x08
            found = found or self._is_message
            passed = min(self._left, len(data) - at)
            self._left -= passed
            at += passed
        return found


def _sizes(head: bytes) -> tuple[int, int]:
    """Return the bytes of a frame's head, and of its payload, 0 unless the head is whole."""
    if len(head) < 2:
        return 2, 0
    length, masked = head[1] & 0x7F, head[1] >> 7
    wide = {126: 2, 127: 8}.get(length, 0)
    size = 2 + wide + 4 * masked
    if wide:
        length = int.from_bytes(head[2 : 2 + wide])
    return size, length if len(head) >= size else 0


class _Bursts:
    """Turns of a WebSocket: one from a message on until it was quiet for a while."""

    def __init__(self, turn: Callable[[], AbstractAsyncContextManager[Any]]) -> None:
        self._turn = turn
        self._now = asyncio.get_running_loop().time
        self._last = 0.0
        self._wanted, self._has = asyncio.Event(), asyncio.Event()

    async def message(self) -> None:
        """Wait until a message may pass."""
        self._last = self._now()
        self._wanted.set()
        await self._has.wait()

    async def run(self) -> None:
        while True:
            await self._wanted.wait()
            async with self._turn():
                self._has.set()
                left_s = WS_QUIET_S
                while left_s > 0:
                    await asyncio.sleep(left_s)
                    left_s = self._last + WS_QUIET_S - self._now()
                self._has.clear()
                self._wanted.clear()
