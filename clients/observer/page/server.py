"""The HTTP server: uvicorn with limits per peer.

On loopback a peer is a user of this machine, elsewhere an address. Beyond its share, or beyond the
total, the oldest connection of the peer with the most is closed and the new one is taken, so that
no peer keeps another out.
"""

import asyncio
import contextlib
import ipaddress
import socket
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.ports import listen
from vram_arbiter.schemas.runtime.trust import port_uids
from vram_arbiter.schemas.urls import HttpAddress

CONNECTIONS_MAX = 48
CONNECTIONS_PER_PEER = 16
STREAMS_MAX = 12
STREAMS_PER_PEER = 6
STREAMS_OF_ROOT = 2
"""Of STREAMS_MAX: two users would keep the operator out."""
HEAD_MAX_BYTES = 8 * 1024
REQUEST_S = 5.0
"""From a connection to its first request."""
IDLE_S = 30
STOP_S = 1
BACKLOG = 64

type Peer = tuple[str, int]
ROOT: Peer = ("", 0)
type End = tuple[str, int]
"""Address and port of the other end of a connection."""


@dataclass(slots=True)
class _Open:
    transport: asyncio.Transport
    peer: Peer
    streams: bool = False


class Connections:
    """Open connections, oldest first."""

    def __init__(self, *, loopback: bool) -> None:
        self._loopback = loopback
        self._open: dict[End, _Open] = {}

    def opened(self, end: End, transport: asyncio.Transport) -> None:
        peer = self._peer_of(end, transport)
        held = Counter(one.peer for one in self._open.values())
        crowded: Peer | None = peer if held[peer] >= CONNECTIONS_PER_PEER else None
        if crowded is None and len(self._open) >= CONNECTIONS_MAX:
            crowded = held.most_common(1)[0][0]
        if crowded is not None:
            oldest = next(end for end, one in self._open.items() if one.peer == crowded)
            self._open.pop(oldest).transport.abort()
        self._open[end] = _Open(transport, peer)

    def closed(self, end: End) -> None:
        self._open.pop(end, None)

    def may_stream(self, end: End) -> bool:
        """Return whether one more page may be open."""
        streams = Counter(one.peer for one in self._open.values() if one.streams)
        mine = self._open.get(end)
        if mine is None:
            return False
        most = STREAMS_MAX if mine.peer == ROOT else STREAMS_MAX - STREAMS_OF_ROOT
        return streams.total() < most and streams[mine.peer] < STREAMS_PER_PEER

    def streams(self, end: End) -> None:
        if (one := self._open.get(end)) is not None:
            one.streams = True

    def abort(self, end: End) -> None:
        if (one := self._open.pop(end, None)) is not None:
            one.transport.abort()

    def _peer_of(self, end: End, transport: asyncio.Transport) -> Peer:
        if self._loopback:
            try:
                uids = port_uids(transport.get_extra_info("socket"))
            except OSError:  # its other end has gone
                uids = set()
            return ("", min(uids, default=-1))
        address = ipaddress.ip_address(end[0].partition("%")[0])
        if address.version == 6:  # one subscriber line has a whole /64
            return (str(ipaddress.ip_network((int(address) >> 64 << 64, 64))), 0)
        return (str(address), 0)


def bound(address: HttpAddress) -> socket.socket:
    """Return a listening socket. Raises ConfigError."""
    try:
        return listen(address.host, address.port, BACKLOG)
    except OSError as error:
        raise ConfigError(
            f"http.listen: cannot listen on {address}: {error.strerror}",
            hint="choose another port, or 0 for any free one",
        ) from error


class _Server(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield  # the program handles them


async def serve(app: ASGIApp, listening: socket.socket, connections: Connections) -> None:
    """Serve until canceled."""

    class Limited(H11Protocol):
        """A connection that is counted, and ends without a request or with half of one."""

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._end: End = tuple(transport.get_extra_info("peername")[:2])
            connections.opened(self._end, transport)
            self._first = self.loop.call_later(REQUEST_S, self._silent)

        def connection_lost(self, exc: Exception | None) -> None:
            self._first.cancel()
            connections.closed(self._end)
            super().connection_lost(exc)

        def _silent(self) -> None:
            between = self.cycle is None or self.cycle.response_complete
            if between and self.timeout_keep_alive_task is None:  # a head has begun, or none came
                self.transport.abort()
            else:
                self._first = self.loop.call_later(IDLE_S, self._silent)

    config = uvicorn.Config(
        app,
        http=Limited,
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        backlog=BACKLOG,
        timeout_keep_alive=IDLE_S,
        timeout_graceful_shutdown=STOP_S,
        h11_max_incomplete_event_size=HEAD_MAX_BYTES,
    )
    server = _Server(config)
    try:
        await server.serve(sockets=[listening])
    finally:
        server.should_exit = True
