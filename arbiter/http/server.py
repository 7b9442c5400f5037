"""The HTTP server: its socket, its limits per peer, and which answer belongs to which path.

On loopback a peer is a user of this machine, elsewhere an address. Beyond its share, or beyond the
total, the oldest connection of the peer with the most is closed and the new one is taken, so that
no peer keeps another out.
"""

import asyncio
import ipaddress
import json
import logging
import socket
from collections import Counter
from collections.abc import Callable
from urllib.parse import parse_qs, urlsplit

from vram_arbiter.arbiter.http import site
from vram_arbiter.arbiter.http.access import Access
from vram_arbiter.arbiter.http.connection import Connection, Turns
from vram_arbiter.arbiter.http.feed import Feed
from vram_arbiter.arbiter.http.owner import Owners
from vram_arbiter.arbiter.http.site import Answer, problem
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.urls import HttpAddress
from vram_arbiter.schemas.wire.replies import HistoryReply

log = logging.getLogger(__name__)

CONNECTIONS_MAX = 48
CONNECTIONS_PER_PEER = 16
STREAMS_MAX = 12
STREAMS_PER_PEER = 6
STREAMS_OF_ROOT = 2
"""Of STREAMS_MAX: two users would keep the operator out."""
ACCEPTED_AT_ONCE = 8
"""Connections that are accepted in one turn of the loop."""
HISTORY_MAX = 200
"""Events of one answer: more would hold the loop for too long."""
SEQ_MAX = 1 << 53

type Peer = tuple[str, int]
ROOT: Peer = ("", 0)
type History = Callable[[int, int, tuple[str, ...], Callable[[HistoryReply], None]], None]


class HttpServer:
    """Binds in the constructor, serves from `start` to `close`."""

    def __init__(
        self,
        address: HttpAddress,
        access: Callable[[HttpAddress], Access],
        feed: Feed,
        history: History,
        server: str,
    ) -> None:
        self._socket = _bound(address)
        port: int = self._socket.getsockname()[1]
        self.address = HttpAddress(address.host, port)
        self._access = access(self.address)
        self._files = site.files()
        self._feed = feed
        self._history = history
        self._name = server
        self._owners = Owners() if address.loopback else None
        self._turns = Turns()
        self._peers: dict[Connection, Peer] = {}  # open connections, oldest first
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(
            lambda: Connection(self, self._name, self._turns),
            sock=self._socket,
            backlog=ACCEPTED_AT_ONCE,
        )

    def close(self) -> None:
        """Stop listening and hang up on every peer."""
        if self._server is not None:
            self._server.close()
        self._socket.close()
        for connection in list(self._peers):
            connection.abort()
        if self._owners is not None:
            self._owners.close()

    # -- connections
    def opened(self, connection: Connection) -> None:
        peer = self._peer_of(connection)
        held = Counter(self._peers.values())
        crowded: Peer | None = peer if held[peer] >= CONNECTIONS_PER_PEER else None
        if crowded is None and len(self._peers) >= CONNECTIONS_MAX:
            crowded = held.most_common(1)[0][0]
        if crowded is not None:
            oldest = next(one for one, its in self._peers.items() if its == crowded)
            del self._peers[oldest]
            oldest.abort()
        self._peers[connection] = peer

    def closed(self, connection: Connection) -> None:
        self._peers.pop(connection, None)
        self._feed.leave(connection)

    def _peer_of(self, connection: Connection) -> Peer:
        end = connection.socket
        assert end is not None
        if self._owners is not None:
            uid = self._owners.uid(end)
            return ("", -1 if uid is None else uid)
        try:
            address = ipaddress.ip_address(end.getpeername()[0].partition("%")[0])
        except (OSError, ValueError):
            return ("gone", 0)
        if address.version == 6:  # one subscriber line has a whole /64
            return (str(ipaddress.ip_network((int(address) >> 64 << 64, 64))), 0)
        return (str(address), 0)

    # -- requests
    def requested(
        self, connection: Connection, target: str, headers: dict[bytes, bytes], *, head: bool
    ) -> None:
        """Answer a request: a file, the events, or a page of the history."""
        denied = self._access.check(headers)
        try:
            path = urlsplit(target).path if target.startswith("/") else ""
        except ValueError:
            connection.answer(problem(400, "expected a path such as /events"))
            return
        if denied is not None:
            if denied.status == 401 and path == "/":
                cookie = self._access.cookie_for(target)
                if cookie is not None:
                    connection.answer(site.token_accepted(cookie))
                    return
            connection.answer(problem(denied.status, denied.text))
        elif path in self._files:
            connection.answer(self._files[path])
        elif path == "/events":
            self._stream(connection, head=head)
        elif path == "/history":
            self._tell_history(connection, target)
        else:
            connection.answer(problem(404, "there is /, /events and /history"))

    def _stream(self, connection: Connection, *, head: bool) -> None:
        peer = self._peers.get(connection)
        streams = Counter(its for one, its in self._peers.items() if one.streams)
        most = STREAMS_MAX if peer == ROOT else STREAMS_MAX - STREAMS_OF_ROOT
        if streams.total() >= most or (peer and streams[peer] >= STREAMS_PER_PEER):
            told = f"{streams.total()} pages are open; close some"
            connection.answer(problem(503, told))
            return
        connection.stream()
        if connection.streams:
            self._feed.join(connection)

    def _tell_history(self, connection: Connection, target: str) -> None:
        """`?after=SEQ&limit=N&kind=K`: as the wire's `history`, as JSON."""
        try:
            query = parse_qs(urlsplit(target).query, max_num_fields=64)
            after = int(query.get("after", ["0"])[0][:16])
            limit = int(query.get("limit", [str(HISTORY_MAX)])[0][:16])
        except ValueError:
            connection.answer(problem(400, "expected /history?after=NUMBER&limit=NUMBER&kind=KIND"))
            return

        def answer(reply: HistoryReply) -> None:
            body = json.dumps(to_map(reply), separators=(",", ":"), default=str).encode()
            connection.answer(Answer(200, body, site.JSON))

        after, limit = max(0, min(after, SEQ_MAX)), max(1, min(limit, HISTORY_MAX))
        self._history(after, limit, tuple(query.get("kind", ())), answer)


def _bound(address: HttpAddress) -> socket.socket:
    """Raises ConfigError."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        return socket.create_server(
            (address.host, address.port), family=family, backlog=ACCEPTED_AT_ONCE
        )
    except OSError as error:
        raise ConfigError(
            f"http.listen: cannot listen on {address}: {error.strerror}",
            hint="choose another port, or 0 for any free one",
        ) from error
