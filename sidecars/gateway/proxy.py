"""Bytes between a client and a model server, both ways and unchanged, with backpressure.

Hop-by-hop headers stay on their hop (RFC 9110, 7.6.1). Nothing is retried: a request that reached
its server may have done its work.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import AbstractAsyncContextManager
from typing import Any, Final

from aiohttp import (
    ClientConnectionError,
    ClientConnectorError,
    ClientError,
    ClientSession,
    ClientTimeout,
    ClientWebSocketResponse,
    DummyCookieJar,
    TCPConnector,
    WSCloseCode,
    WSMsgType,
    web,
)
from multidict import CIMultiDict
from yarl import URL

from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

CONNECT_S: Final = 10.0
KEPT_S: Final = 1.0
"""A connection is used again within this time alone: servers close idle ones after 5 s and more,
and a request that meets that fails."""
CHUNK_BYTES: Final = 1 << 16
WS_MESSAGE_MAX_BYTES: Final = 64 << 20
WS_QUIET_S: Final = 5.0
PASSED_CODES: Final = frozenset((*range(1000, 1004), *range(1007, 1015), *range(3000, 5000)))
"""Codes of a close frame that may be sent (RFC 6455, 7.4)."""
HOP_BY_HOP: Final = frozenset(
    ("connection", "keep-alive", "proxy-authenticate", "proxy-authorization", "proxy-connection",
     "te", "trailer", "transfer-encoding", "upgrade")
)  # fmt: skip
OWN: Final = frozenset(("host", "expect", "authorization", "x-api-key"))
"""Headers that are between a client and the gateway; keys that are not checked here pass."""
WS_OWN: Final = frozenset(
    ("sec-websocket-key", "sec-websocket-version", "sec-websocket-extensions",
     "sec-websocket-protocol", "sec-websocket-accept")
)  # fmt: skip


class Unreached(SidecarUnavailable):
    """The server took no connection, so that the request can be sent again."""


def new_session() -> ClientSession:
    """Return the session of all upstream connections: no limit, no waiting, nothing decoded."""
    return ClientSession(
        connector=TCPConnector(limit=0, keepalive_timeout=KEPT_S),
        timeout=ClientTimeout(total=None, sock_connect=CONNECT_S),
        auto_decompress=False,
        skip_auto_headers=("user-agent", "accept", "accept-encoding", "content-type"),
        read_bufsize=CHUNK_BYTES,
        cookie_jar=DummyCookieJar(),
    )


def end_to_end(headers: Iterable[tuple[str, str]], without: frozenset[str]) -> CIMultiDict[str]:
    """Return the headers that go to the next hop."""
    pairs = list(headers)
    named = {
        token.strip().lower()
        for name, value in pairs
        if name.lower() == "connection"
        for token in value.split(",")
    }
    dropped = HOP_BY_HOP | without | named
    return CIMultiDict((name, value) for name, value in pairs if name.lower() not in dropped)


def upstream_headers(
    request: web.BaseRequest, *, checked: bool, upstream_key: str | None
) -> CIMultiDict[str]:
    """Return a request's headers for the server. `checked`: the gateway asks for keys, which are
    not the server's matter."""
    own = OWN if checked or upstream_key else OWN - {"authorization", "x-api-key"}
    headers = end_to_end(request.headers.items(), own)
    if upstream_key:
        headers["Authorization"] = f"Bearer {upstream_key}"
    return headers


async def forward(
    session: ClientSession,
    request: web.BaseRequest,
    url: str,
    headers: CIMultiDict[str],
    begun: bytes,
    response: web.StreamResponse | None,
) -> web.StreamResponse:
    """Send a request to `url` (its own target there), and its answer to the client.

    `begun`: what was read of the body. `response`: one that the client gets already; its status is
    said. Raises Unreached, or SidecarUnavailable, before anything of the answer was sent; later the
    connection is cut.
    """
    has_body = request.body_exists or begun
    if not has_body:
        headers.popall("content-length", None)
    try:
        async with session.request(
            request.method,
            URL(url, encoded=True),
            headers=headers,
            data=_body(begun, request) if has_body else None,
            allow_redirects=False,
        ) as answer:
            if response is None:
                raw = (
                    (name.decode("latin-1"), value.decode("latin-1"))
                    for name, value in answer.raw_headers
                )
                response = web.StreamResponse(
                    status=answer.status, reason=answer.reason, headers=end_to_end(raw, frozenset())
                )
                await response.prepare(request)
            try:
                tracing.event(telemetry.EVENT_FIRST_BYTE)
                async for data in answer.content.iter_any():
                    await response.write(data)
            except ClientError as error:
                raise ConnectionAbortedError(f"the server hung up: {error}") from error
            await response.write_eof()
            return response
    except ClientConnectorError as error:
        raise Unreached(f"the server takes no connection: {error}", hint="see /logs") from error
    except ClientConnectionError as error:
        raise SidecarUnavailable(
            f"the server does not answer: {error}", hint="see /logs"
        ) from error


async def _body(begun: bytes, request: web.BaseRequest) -> AsyncIterator[bytes]:
    if begun:
        yield begun
    async for data in request.content.iter_any():
        yield data


async def tunnel(
    session: ClientSession,
    request: web.BaseRequest,
    target: str,
    headers: CIMultiDict[str],
    turn: Callable[[], AbstractAsyncContextManager[Any]],
) -> web.StreamResponse:
    """Pass messages of a WebSocket both ways until either end hangs up.

    The handshake is a turn, and so is each burst of messages, until it was quiet for WS_QUIET_S: an
    open page of ComfyUI must not keep its server on the GPU. Raises SidecarUnavailable.
    """
    names = request.headers.get("sec-websocket-protocol", "")
    protocols = [name.strip() for name in names.split(",") if name.strip()]
    most = WS_MESSAGE_MAX_BYTES
    async with turn() as current:
        try:
            upstream = await session.ws_connect(
                URL(current.url + target, encoded=True),
                protocols=protocols,
                headers=end_to_end(headers.items(), WS_OWN),
                autoping=False,
                max_msg_size=most,
            )
        except ClientError as error:
            hint = "see /logs"
            raise SidecarUnavailable(f"no WebSocket at {target}: {error}", hint=hint) from error
        chosen = [upstream.protocol] if upstream.protocol else []
        client = web.WebSocketResponse(protocols=chosen, autoping=False, max_msg_size=most)
        await client.prepare(request)
    bursts = _Bursts(turn)
    there, back = _pass_on(client, upstream, bursts), _pass_on(upstream, client, bursts)
    tasks = [asyncio.create_task(work) for work in (bursts.run(), there, back)]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        code = upstream.close_code or client.close_code
        await upstream.close()
        if code is None or code not in PASSED_CODES:
            code = WSCloseCode.GOING_AWAY
        await client.close(code=code)
    return client


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


async def _pass_on(
    source: web.WebSocketResponse | ClientWebSocketResponse,
    sink: web.WebSocketResponse | ClientWebSocketResponse,
    bursts: _Bursts,
) -> None:
    async for message in source:
        match message.type:
            case WSMsgType.TEXT:
                await bursts.message()
                await sink.send_str(message.data)
            case WSMsgType.BINARY:
                await bursts.message()
                await sink.send_bytes(message.data)
            case WSMsgType.PING:  # says nothing of work
                await sink.ping(message.data)
            case WSMsgType.PONG:
                await sink.pong(message.data)
