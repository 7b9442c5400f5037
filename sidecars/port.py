"""A port of 127.0.0.1 in front of a sidecar's socket: the field's clients know ports only.

Bytes pass unread; framing, limits and requests are the socket's. A port has no permissions, so the
kernel's table of sockets names the user at the other end, who has to be one that may open the
socket's file.
"""

import asyncio
import contextlib
import logging
import os
import pwd
import socket
from collections.abc import AsyncIterator
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.trust import ROOT, port_uids

CONNECTIONS_MAX = 64
READ_BYTES = 256 * 1024
_log = logging.getLogger("sidecars")


@contextlib.asynccontextmanager
async def on_port(
    port: int, path: Path, connections_max: int = CONNECTIONS_MAX
) -> AsyncIterator[None]:
    """Pass connections to the port on to the unix socket `path` within the block, at most
    `connections_max` at a time. Raises ConfigError for a port that cannot be had."""
    passing: set[asyncio.Task[None]] = set()
    looking = asyncio.Lock()  # one at a time: refused users must not cost the event loop its time

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None, "a stream's callback is a task"
        if len(passing) >= connections_max:
            writer.close()
            return
        passing.add(task)
        try:
            async with looking:
                lets_in = await asyncio.to_thread(_may_connect, writer, path)
            if lets_in:
                await _pass_on(reader, writer, path)
        except OSError as error:
            _log.warning("a connection to port %d ended: %s", port, error)
        except asyncio.CancelledError:
            pass  # the port ends; asyncio's streams take a canceled callback for a defect
        finally:
            passing.discard(task)
            writer.close()

    try:
        server = await asyncio.start_server(connected, "127.0.0.1", port)
    except OSError as error:
        raise ConfigError(
            f"port {port} of 127.0.0.1 cannot be served: {os.strerror(error.errno or 0)}",
            hint="choose another --port, or end the program that listens there",
        ) from error
    try:
        yield
    finally:
        server.close()
        for task in passing:
            task.cancel()
        await asyncio.gather(*passing, return_exceptions=True)


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, path: Path) -> None:
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
    inner_reader, inner_writer = await asyncio.open_unix_connection(sock=inner)
    copies = [
        asyncio.create_task(_copy(reader, inner_writer)),
        asyncio.create_task(_copy(inner_reader, writer)),
    ]
    try:
        await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
    finally:
        inner_writer.close()  # first: a cancellation may come while the copies end
        for copy in copies:
            copy.cancel()
        await asyncio.gather(*copies, return_exceptions=True)


async def _copy(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    while data := await source.read(READ_BYTES):
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
