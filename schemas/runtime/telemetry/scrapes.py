"""The Prometheus endpoint: HTTP on loopback in one thread of its own, bounded so that no local user
keeps the scraper out.

Every user of this machine may connect to a loopback port. So connections are counted by the user
behind them: beyond its share, or beyond the total, the oldest connection of the user with the most
is closed, and a new one is always taken. A connection has SCRAPE_S for its request and its answer
together. Pages are made at most every PAGE_S, however often they are read.
"""

import asyncio
import contextlib
import ipaddress
import logging
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)

CONNECTIONS_MAX = 64
CONNECTIONS_PER_USER = 16
BACKLOG = 128
SCRAPE_S = 5.0
REQUEST_MAX_BYTES = 8 * 1024
PAGE_S = 0.25
CLOSE_S = 2.0
OPENMETRICS = "application/openmetrics-text"

Page = Callable[[str], tuple[bytes, str]]
"""`page(accept)`: the metrics and their content type. `accept` is "" or OPENMETRICS."""


Peer = tuple[str, int]
Owners = Callable[[Peer], int | None]
"""Which user a connection comes from, by its other end; None where the kernel does not say."""


class KernelTable:
    """The kernel's list of this machine's TCP sockets as it was at one moment, read when it is
    first asked.

    A TCP socket has no SO_PEERCRED. But the other end of a loopback connection is a socket of this
    machine, and listed with its owner. A flood of connections makes the list long, so one reading
    serves all connections that were accepted before it.
    """

    def __init__(self) -> None:
        self._texts: dict[int, bytes] = {}

    def __call__(self, peer: Peer) -> int | None:
        address = ipaddress.ip_address(peer[0].partition("%")[0])
        words = struct.unpack(f"={len(address.packed) // 4}I", address.packed)
        needle = "".join(f"{word:08X}" for word in words) + f":{peer[1]:04X}"
        text = self._text(address.version)
        at = text.find(f": {needle} ".encode())
        if at < 0:
            return None
        return int(text[at : text.find(b"\n", at)].split()[7])

    def _text(self, version: int) -> bytes:
        if version not in self._texts:
            try:
                with open(
                    "/proc/self/net/tcp" if version == 4 else "/proc/self/net/tcp6", "rb"
                ) as table:
                    self._texts[version] = table.read()
            except OSError:
                self._texts[version] = b""
        return self._texts[version]


class ScrapeServer:
    """Binds in the constructor (OSError: the port is taken), serves from `start` to `close`."""

    def __init__(
        self,
        host: str,
        port: int,
        page: Page,
        owners: Callable[[], Owners] = KernelTable,
        scrape_s: float = SCRAPE_S,
    ) -> None:
        self._page = page
        self._make_owners = owners
        self._owners: Owners | None = None  # good for the connections of this turn of the loop
        self._scrape_s = scrape_s
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self._socket = socket.create_server(address[:2], family=family, backlog=BACKLOG)
        self.port: int = self._socket.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(
            lambda _, context: log.debug("metrics endpoint: %s", context)
        )
        self._thread = threading.Thread(target=self._run, name="prometheus", daemon=True)
        self._open: dict[asyncio.StreamWriter, int | None] = {}  # by age, oldest first
        self._pages: dict[str, tuple[float, bytes, str]] = {}

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop accepting, hang up on every reader. May be called without `start`."""
        if self._thread.ident is None:
            self._loop.close()
        else:
            with contextlib.suppress(RuntimeError):  # the loop is closed already
                self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(CLOSE_S)
        self._socket.close()

    def _run(self) -> None:
        loop = self._loop
        asyncio.set_event_loop(loop)
        serving = asyncio.start_server(
            self._serve, sock=self._socket, limit=REQUEST_MAX_BYTES, backlog=BACKLOG
        )
        server = loop.run_until_complete(serving)
        try:
            loop.run_forever()
        finally:
            server.close()
            for task in asyncio.all_tasks(loop):
                task.cancel()
            loop.run_until_complete(asyncio.sleep(0))
            for writer in list(self._open):
                writer.transport.abort()
            loop.run_until_complete(asyncio.sleep(0))
            loop.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._make_room(writer)
        try:
            async with asyncio.timeout(self._scrape_s):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._answer(head))
                writer.close()
                await writer.wait_closed()
        except (
            TimeoutError,
            asyncio.IncompleteReadError,
            asyncio.LimitOverrunError,
            OSError,
        ) as error:
            log.debug("a reader of the metrics was given up: %r", error)
        finally:
            self._open.pop(writer, None)
            writer.transport.abort()

    def _make_room(self, writer: asyncio.StreamWriter) -> None:
        if self._owners is None:
            self._owners = self._make_owners()
            self._loop.call_soon(self._forget_owners)
        user = self._owners(writer.get_extra_info("peername")[:2])
        held = Counter(self._open.values())
        crowded: int | None = user
        full = held[user] >= CONNECTIONS_PER_USER
        if not full and len(self._open) >= CONNECTIONS_MAX:
            (crowded, _), full = held.most_common(1)[0], True
        if full:
            oldest = next(one for one, its in self._open.items() if its == crowded)
            del self._open[oldest]
            oldest.transport.abort()
        self._open[writer] = user

    def _forget_owners(self) -> None:
        self._owners = None

    def _answer(self, head: bytes) -> bytes:
        line, _, rest = head.partition(b"\r\n")
        method, _, target = line.partition(b" ")
        if method not in (b"GET", b"HEAD"):
            return _response("405 Method Not Allowed", b"", "text/plain", head_only=False)
        if target.split(b" ")[0].split(b"?")[0] not in (b"/metrics", b"/"):
            return _response(
                "404 Not Found", b"see /metrics\n", "text/plain", head_only=method == b"HEAD"
            )
        accept = OPENMETRICS if OPENMETRICS.encode() in rest.lower() else ""
        made_at, body, kind = self._pages.get(accept, (-PAGE_S, b"", ""))
        if time.monotonic() - made_at >= PAGE_S:
            try:
                body, kind = self._page(accept)
            except Exception:
                log.exception("the metrics cannot be put together")
                return _response("500 Internal Server Error", b"", "text/plain", head_only=False)
            self._pages[accept] = (time.monotonic(), body, kind)
        return _response("200 OK", body, kind, head_only=method == b"HEAD")


def _response(status: str, body: bytes, kind: str, *, head_only: bool) -> bytes:
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\nConnection: "
        "close\r\n\r\n"
    )
    return head.encode() + (b"" if head_only else body)


def page_of(registry: Any) -> Page:
    """The page of a `prometheus_client` registry, in its text format or as OpenMetrics (with
    exemplars)."""
    from prometheus_client.exposition import choose_encoder

    def page(accept: str) -> tuple[bytes, str]:
        encode, kind = choose_encoder(accept)
        return encode(registry), kind

    return page
