"""A port of 127.0.0.1 in front of a sidecar's socket: the field's clients know ports only.

Bytes pass unread; framing, limits and requests are the socket's. A port has no permissions, so the
kernel's table of sockets names the user at the other end, who has to be one that may open the
socket's file. A server that judges its clients' requests has them read at the speed that they
deserve (`Conduct`).
"""

import asyncio
import contextlib
import logging
import os
import pwd
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Final

from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.ports import listen
from vram_arbiter.schemas.runtime.trust import ROOT, port_uids

CONNECTIONS_MAX = 64
ACCEPT_PAUSE_S: Final = 0.01
"""After each connection: those that come faster wait in the kernel, and cost the event loop
nothing."""
READ_BYTES = 256 * 1024
FREE_BYTES: Final = 4 * MIB
"""Unproven bytes of one connection that are read at once, an observation of four small cameras; or
twice its largest request that was served."""
UNPROVEN_BYTES_PER_S: Final = 8 * MIB
"""Of all connections together, beyond what is free."""
REFUSED_S: Final = 1.0
"""How long a connection is not read after a request of it was refused."""
FRAMING_BYTES: Final = 1024
"""Of one request at most, beside a sixteenth of its size."""
_log = logging.getLogger("sidecars")


@dataclass(slots=True)
class _Tab:
    unproven_bytes: int = 0
    free_bytes: int = FREE_BYTES
    stopped_s: float = 0.0  # until then it is not read


class Conduct:
    """How fast the connections of a port are read, by what became of their requests.

    Bytes are unproven until the server behind the port says that it served them. Those that no
    request makes good, and requests that are refused, cost their sender time instead of the
    server's: it is not read, and what it sends stays in its own kernel's buffers. Connections are
    known by the name of their end at the socket.
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self._tabs: dict[str, _Tab] = {}
        self._paid_s = 0.0  # when the unproven bytes so far are paid for, at the rate of them

    def served(self, end: str, size_bytes: int) -> None:
        """Note that a request of so many bytes was served."""
        if (tab := self._tabs.get(end)) is not None:
            proven = size_bytes + size_bytes // 16 + FRAMING_BYTES
            tab.unproven_bytes = max(0, tab.unproven_bytes - proven)
            tab.free_bytes = max(tab.free_bytes, 2 * proven)

    def refused(self, end: str) -> None:
        """Note that a request was one that no client of the protocol sends."""
        if (tab := self._tabs.get(end)) is not None:
            tab.stopped_s = self._clock() + REFUSED_S

    @contextlib.contextmanager
    def connected(self, end: str) -> Iterator[None]:
        """Know a connection within the block. What is unproven at its end delays later ones."""
        tab = self._tabs[end] = _Tab()
        try:
            yield
        finally:
            del self._tabs[end]
            self._owe(min(tab.unproven_bytes, tab.free_bytes))

    def debt_s(self) -> float:
        """Return for how long the unproven bytes so far keep new connections waiting."""
        return max(0.0, self._paid_s - self._clock())

    def came(self, end: str, size_bytes: int) -> float:
        """Note bytes of a connection. Returns for how many seconds they are not passed on."""
        tab = self._tabs[end]
        tab.unproven_bytes += size_bytes
        free = tab.unproven_bytes <= tab.free_bytes
        due_s = tab.stopped_s if free else max(tab.stopped_s, self._owe(size_bytes))
        return max(0.0, due_s - self._clock())

    def _owe(self, size_bytes: int) -> float:
        """Add to the unproven bytes. Returns when they are paid for."""
        self._paid_s = max(self._paid_s, self._clock()) + size_bytes / UNPROVEN_BYTES_PER_S
        return self._paid_s


@contextlib.asynccontextmanager
async def on_port(
    port: int,
    path: Path,
    connections_max: int = CONNECTIONS_MAX,
    conduct: Conduct | None = None,
) -> AsyncIterator[None]:
    """Pass connections to the port on to the unix socket `path` within the block, at most
    `connections_max` at a time, as fast as their `conduct` allows. Raises ConfigError for a port
    that cannot be had."""
    passing: set[asyncio.Task[None]] = set()
    looking = asyncio.Lock()  # one at a time: refused users must not cost the event loop its time

    async def connected(client: socket.socket) -> None:
        try:
            reader, writer = await asyncio.open_connection(sock=client)
            with contextlib.closing(writer):
                if conduct is not None:
                    await asyncio.sleep(conduct.debt_s())
                async with looking:
                    lets_in = await asyncio.to_thread(_may_connect, writer, path)
                if lets_in:
                    await _pass_on(reader, writer, path, conduct)
        except OSError as error:
            _log.warning("a connection to port %d ended: %s", port, error)

    async def accept() -> None:
        while True:
            try:
                client, _ = await asyncio.get_running_loop().sock_accept(listening)
            except OSError as error:  # it hung up, or there are too many open files
                _log.warning("a connection to port %d was not taken: %s", port, error)
            else:
                if len(passing) < connections_max:
                    task = asyncio.create_task(connected(client))
                    passing.add(task)
                    task.add_done_callback(passing.discard)
                else:
                    client.close()
            await asyncio.sleep(ACCEPT_PAUSE_S)

    try:
        listening = listen("127.0.0.1", port, connections_max)
    except OSError as error:
        raise ConfigError(
            f"port {port} of 127.0.0.1 cannot be served: {os.strerror(error.errno or 0)}",
            hint="choose another --port, or end the program that listens there",
        ) from error
    with listening:
        listening.setblocking(False)
        accepting = asyncio.create_task(accept())
        try:
            yield
        finally:
            ending = [accepting, *passing]
            for task in ending:
                task.cancel()
            await asyncio.gather(*ending, return_exceptions=True)


async def _pass_on(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    path: Path,
    conduct: Conduct | None = None,
) -> None:
    """Copy both ways until either end hangs up.

    The end at the socket is bound to a name of the kernel's choice, by which a server that serves
    several clients tells them apart.
    """
    inner = socket.socket(socket.AF_UNIX)
    try:
        inner.bind("")
        inner.setblocking(False)
        await asyncio.get_running_loop().sock_connect(inner, str(path))
    except BaseException:
        inner.close()
        raise
    end = inner.getsockname().decode().lstrip("\0")
    inner_reader, inner_writer = await asyncio.open_unix_connection(sock=inner)
    with conduct.connected(end) if conduct is not None else contextlib.nullcontext():
        copies = [
            asyncio.create_task(_copy(reader, inner_writer, end, conduct)),
            asyncio.create_task(_copy(inner_reader, writer, end)),
        ]
        try:
            await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
        finally:
            inner_writer.close()  # first: a cancellation may come while the copies end
            for copy in copies:
                copy.cancel()
            await asyncio.gather(*copies, return_exceptions=True)


async def _copy(
    source: asyncio.StreamReader,
    sink: asyncio.StreamWriter,
    end: str,
    conduct: Conduct | None = None,
) -> None:
    while data := await source.read(READ_BYTES):
        if conduct is not None:
            await asyncio.sleep(conduct.came(end, len(data)))
        sink.write(data)
        await sink.drain()


def _may_connect(writer: asyncio.StreamWriter, path: Path) -> bool:
    """Whether the user at the other end may open the socket's file, which has mode 0660.

    A client that has hung up is refused: the kernel no longer names its user, and its requests may
    already have come. Raises OSError where it hangs up meanwhile: another user's connection may
    have its address by then.
    """
    connection = writer.get_extra_info("socket")
    file, uids = path.stat(), port_uids(connection)
    connection.getpeername()
    refused = [
        f"uid {uid}, which may not open {path}"
        for uid in uids
        if uid not in (ROOT, file.st_uid) and file.st_gid not in _groups_of(uid)
    ]
    if not uids:
        refused.append("a client that has hung up")
    if refused:
        _log.warning("refused a connection of %s", refused[0])
    return not refused


def _groups_of(uid: int) -> list[int]:
    try:
        user = pwd.getpwuid(uid)
    except KeyError:
        return []
    return os.getgrouplist(user.pw_name, user.pw_gid)
