"""The gateway: its parts joined, from the first contact with the arbiter to SIGTERM."""

import asyncio
import gc
import logging
import resource
import signal
from collections import Counter
from collections.abc import Collection, Mapping
from heapq import nlargest
from pathlib import Path
from typing import Any, Final

from aiohttp import web
from aiohttp.web_protocol import RequestHandler

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.config.gateway import GatewayConfig
from vram_arbiter.schemas.defaults import DEMANDS_MAX, PROCESS_SHARE
from vram_arbiter.schemas.errors import BadRequest, ConfigError, VramError
from vram_arbiter.schemas.urls import HttpAddress, http_address
from vram_arbiter.sidecars.gateway.front import Front
from vram_arbiter.sidecars.gateway.keys import Keys, private_text, read_keys
from vram_arbiter.sidecars.gateway.reply import failure
from vram_arbiter.sidecars.gateway.server import Server
from vram_arbiter.sidecars.gateway.upstream import HIGH_BYTES

log = logging.getLogger(__name__)

NAME: Final = "vram-gateway"
BACKLOG: Final = 1024
HEADERS_MAX: Final = 128
TOLD_MAX: Final = 200
"""Characters of what is wrong with a head."""
OPEN_FILES: Final = 65_536
"""A request takes two: the usual soft limit of 1,024 is too few for 1,000 clients that wait."""
TELL_S: Final = 1.0
"""Shortest time between two messages to the arbiter about requests."""
BUSIEST_MAX: Final = int(DEMANDS_MAX * PROCESS_SHARE)
"""Servers whose requests are told: as many as one process may tell of, unless configured."""
SHUTDOWN_S: Final = 0.1
"""For answers that are almost sent; 0 would be no limit."""


class _Handler(RequestHandler):
    """A connection. Errors are told as all others, and what a client got wrong is not logged."""

    __slots__ = ()

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        if isinstance(exc, ConnectionError):  # the client left, or does not read
            raise exc
        if status >= 500:
            return super().handle_error(request, status, exc, message)
        why = (message or "").partition("\n")[0][:TOLD_MAX]
        response = failure(BadRequest(f"the request cannot be read: {why}"))
        response.force_close()
        return response


class Listener(web.Server):
    """aiohttp's server with at most `per_peer` connections of one address."""

    def __init__(self, front: Front, config: GatewayConfig) -> None:
        limits = config.limits
        super().__init__(front.handle, handler_cancellation=True)
        self._options: Mapping[str, Any] = {
            "keepalive_timeout": limits.head_s,
            "max_line_size": limits.header_max_bytes,
            "max_field_size": limits.header_max_bytes,
            "max_headers": HEADERS_MAX,
            "auto_decompress": False,
            "read_bufsize": HIGH_BYTES,
            "access_log": None,
        }
        self._per_peer = limits.connections_per_peer
        self._peers: Counter[str] = Counter()
        self._peer_of: dict[RequestHandler, str] = {}

    def __call__(self) -> RequestHandler:
        return _Handler(self, loop=asyncio.get_running_loop(), **self._options)

    def connection_made(self, handler: RequestHandler, transport: asyncio.Transport) -> None:
        super().connection_made(handler, transport)
        peer = str((transport.get_extra_info("peername") or ("",))[0])
        self._peer_of[handler] = peer
        self._peers[peer] += 1
        if self._peers[peer] > self._per_peer:
            transport.abort()

    def connection_lost(self, handler: RequestHandler, exc: BaseException | None = None) -> None:
        super().connection_lost(handler, exc)
        peer = self._peer_of.pop(handler)
        self._peers[peer] -= 1
        if not self._peers[peer]:
            del self._peers[peer]


def check(config: GatewayConfig) -> tuple[Keys, dict[str, str]]:
    """Read the files that a configuration names. Return its keys, and the keys of its servers.
    Raises ConfigError."""
    upstream = {
        name: private_text(Path(server.upstream_key_file), f"{name}: upstream_key_file").strip()
        for name, server in config.servers.items()
        if server.upstream_key_file is not None
    }
    return read_keys(config), upstream


def _allow_files() -> None:
    """Raise the soft limit of open files to OPEN_FILES, or as far as may be."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    if 0 <= soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


async def _tell(client: AsyncClient, servers: Collection[Server]) -> None:
    """Tell the arbiter how many requests are in flight and wait, after changes."""
    told: Mapping[str, tuple[int, int]] = {}
    moved = asyncio.Event()
    for server in servers:
        server.on_change = moved.set
    while True:
        await moved.wait()
        moved.clear()
        counts = {server.name: (server.in_flight, server.waiting) for server in servers}
        busiest = nlargest(BUSIEST_MAX, counts, key=lambda name: sum(counts[name]))
        found = {name: counts[name] for name in sorted(busiest) if any(counts[name])}
        if found != told:
            told = found
            try:
                await client.demand(found)
            except VramError as error:
                log.warning("the arbiter is not told of requests: %s", error)
        await asyncio.sleep(TELL_S)


async def run(config: GatewayConfig, endpoint: str | None) -> None:
    """Serve until SIGTERM or SIGINT, then end the servers. Prints the address once it listens.

    Raises: ConfigError, ArbiterUnreachable, and what else a client's first contact raises.
    """
    keys, upstream_keys = check(config)
    _allow_files()
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    async with AsyncClient(NAME, endpoint=endpoint) as client:
        servers = {
            name: Server(name, server, client, keys.reserved(name))
            for name, server in config.servers.items()
        }
        wanted = http_address(config.listen)
        front = Front(config, wanted, servers, keys, upstream_keys)
        listener = Listener(front, config)
        try:
            listening = await loop.create_server(
                listener, wanted.host, wanted.port, backlog=BACKLOG
            )
        except OSError as error:
            raise ConfigError(
                f"{wanted} cannot be listened on: {error.strerror}", hint="choose another address"
            ) from error
        port = listening.sockets[0].getsockname()[1]
        gc.freeze()  # modules stay: no collection, which delays all requests, looks at them again
        print(f"http://{HttpAddress(wanted.host, port)}", flush=True)
        telling = asyncio.create_task(_tell(client, servers.values()))
        await asyncio.gather(*(server.adopt() for server in servers.values()))
        try:
            await stop.wait()
        finally:
            telling.cancel()
            listening.close()
            await listener.shutdown(SHUTDOWN_S)
            await asyncio.gather(*(server.close() for server in servers.values()))
