"""A small asyncio ROUTER server for the programs that are not the arbiter (sidecars, runner): one msgpack map per frame.

It owns the socket, decoding, size limits and the error reply for frames that are no messages. It knows nothing of ops: a handler
gets the decoded map and may answer at once, later, or several times. Speaks to DEALER (one frame) and REQ (empty delimiter) peers alike.
Only `ipc://` and loopback `tcp://` endpoints are bound; an ipc socket gets mode 0660.
"""

import asyncio
import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgpack
import zmq
import zmq.asyncio

from clients.packing import pack
from schemas.defaults import IMAGE_MESSAGE_MAX_BYTES
from schemas.errors import AlreadyRunning, BadFrame, ConfigError, MessageTooLarge, VramError

Message = dict[str, Any]
REASON_MAX_CHARS = 500
MAX_DEPTH_BYTES = IMAGE_MESSAGE_MAX_BYTES + 64 * 1024  # an image plus its envelope
LINGER_S = 3.0
"""How long a server that ends waits until its last answers are with the kernel; only peers that do not read cost so long."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Whoever sent a message: where to answer, and which process the kernel says it is (None on tcp)."""

    identity: bytes
    delimiter: bool
    pid: int | None


Handler = Callable[[Peer, Message], Awaitable[None]]
ErrorReply = Callable[[VramError], Message]


def check_free(endpoint: str) -> None:
    """Before a server has moved or recorded anything: may it serve there? Claims nothing; who serves in the end is decided when it binds.

    Raises what `RouterServer` does.
    """
    _check_form(endpoint)
    if not endpoint.startswith("ipc://"):
        return
    path = Path(endpoint.removeprefix("ipc://"))
    try:
        lock = os.open(_lock_of(path), os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return  # nobody served there yet; what else is wrong with it binding will say
    try:
        _lock(lock, path)
    finally:
        os.close(lock)


def _check_form(endpoint: str) -> None:
    if not endpoint.startswith(("ipc://", "tcp://127.0.0.1:", "tcp://localhost:")):
        raise ConfigError(f"cannot serve on {endpoint}", hint="use ipc://PATH or tcp://127.0.0.1:PORT")


def _lock_of(path: Path) -> str:
    return f"{path}.lock"


def _lock(lock: int, path: Path) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.pread(lock, 32, 0).decode(errors="replace").strip()
        raise AlreadyRunning(f"{path} is served by process {owner or '?'}", hint="stop it first") from None


class RouterServer:
    """`async with RouterServer(endpoint, on_error) as server: await server.serve(handler)`.

    Each message is handled in a task of its own, so that a slow one never delays `ping` or `revoke`; at most `concurrent_max` run, then reading
    stops and ZeroMQ's own queue holds the rest (high-water mark `queue_max` per peer).
    Raises ConfigError for a foreign endpoint, or one where nothing can be bound, AlreadyRunning when a living server owns it.
    """

    def __init__(
        self, endpoint: str, on_error: ErrorReply, *, concurrent_max: int = 64, queue_max: int = 256
    ) -> None:
        _check_form(endpoint)
        self.endpoint = endpoint
        self._on_error = on_error
        self._slots = asyncio.Semaphore(concurrent_max)
        self._queue_max = queue_max
        self._tasks: set[asyncio.Task[None]] = set()
        self._stack = contextlib.AsyncExitStack()
        self._send_lock = asyncio.Lock()
        self._socket: zmq.asyncio.Socket | None = None

    async def __aenter__(self) -> Self:
        try:
            self._open()
        except (OSError, zmq.ZMQError) as error:
            await self._stack.aclose()
            if error.errno == errno.EADDRINUSE:
                raise AlreadyRunning(
                    f"{self.endpoint} is served by another process", hint="stop it first"
                ) from error
            raise ConfigError(
                f"cannot serve on {self.endpoint}: {os.strerror(error.errno or errno.EINVAL)}",
                hint="use a short path in a folder of your own",
            ) from error
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    def _open(self) -> None:
        if self.endpoint.startswith("ipc://"):
            self._claim(Path(self.endpoint.removeprefix("ipc://")))
        # a context of its own: that it has ended is all that libzmq says of what was sent
        context = zmq.asyncio.Context()
        self._stack.push_async_callback(asyncio.to_thread, context.term)
        socket: zmq.asyncio.Socket = context.socket(zmq.ROUTER)
        self._stack.callback(socket.close, round(LINGER_S * 1000))
        # beyond this libzmq drops the peer; below we can answer
        socket.setsockopt(zmq.MAXMSGSIZE, 4 * MAX_DEPTH_BYTES)
        socket.setsockopt(zmq.SNDHWM, self._queue_max)
        socket.setsockopt(zmq.RCVHWM, self._queue_max)
        old_umask = os.umask(0o117)
        try:
            socket.bind(self.endpoint)
        finally:
            os.umask(old_umask)
        self._socket = socket

    async def __aexit__(self, *_: object) -> None:
        """What was sent by now reaches its peer, though the process ends behind this. Then the endpoint is anybody's."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._stack.aclose()

    def _claim(self, path: Path) -> None:
        """Binding steals an existing ipc path without a word: a locked file beside it tells a living owner from a stale socket."""
        path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        lock = os.open(_lock_of(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o660)
        self._stack.callback(os.close, lock)
        _lock(lock, path)
        os.ftruncate(lock, 0)
        os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
        if path.exists() and stat.S_ISSOCK(path.stat().st_mode):
            path.unlink()

    async def serve(self, handler: Handler) -> None:
        """Read until cancelled."""
        assert self._socket is not None, "serve() belongs inside `async with`"
        while True:
            await self._slots.acquire()
            try:
                frames = await self._socket.recv_multipart(copy=False)
                identity, delimiter, payload = frames[0].bytes, len(frames) == 3, frames[-1]
                peer = Peer(identity, delimiter, _pid(payload))
                message = self._decode(frames)
            except VramError as error:
                self._slots.release()
                await self.send(Peer(identity, delimiter, None), self._on_error(error))
                continue
            except BaseException:
                self._slots.release()
                raise
            task = asyncio.create_task(self._run(handler, peer, message))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _run(self, handler: Handler, peer: Peer, message: Message) -> None:
        try:
            await handler(peer, message)
        finally:
            self._slots.release()

    @staticmethod
    def _decode(frames: list[zmq.Frame]) -> Message:
        payload = frames[-1]
        if len(payload) > MAX_DEPTH_BYTES:
            raise MessageTooLarge(
                f"a message of {len(payload)} bytes; the limit is {MAX_DEPTH_BYTES}",
                hint="send a smaller image",
            )
        try:
            message = msgpack.unpackb(payload.buffer, raw=False, strict_map_key=True)
        except (ValueError, msgpack.exceptions.UnpackException, RecursionError) as error:
            raise BadFrame(f"not msgpack: {error}", hint="send one msgpack map per message") from None
        if not isinstance(message, dict):
            raise BadFrame(
                f"a msgpack {type(message).__name__}, not a map", hint="send one msgpack map per message"
            )
        return message

    async def send(self, peer: Peer, message: Message) -> None:
        """Answer or push. A peer that is gone or too slow gets nothing."""
        assert self._socket is not None
        payload = pack(message)
        frames = [peer.identity, b"", payload] if peer.delimiter else [peer.identity, payload]
        async with self._send_lock:
            await self._socket.send_multipart(frames)


def reason_of(message: Message) -> str:
    """The `reason` of a request that must never be refused for its words, as a stop: on one line, and not for ever."""
    words = message.get("reason")
    text = "" if words is None else str(words)[: 4 * REASON_MAX_CHARS]
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()[:REASON_MAX_CHARS]


def _pid(frame: zmq.Frame) -> int | None:
    try:
        address = str(frame.get("Peer-Address"))  # localhost:UID:GID:PID on ipc, an ip address on tcp
    except zmq.ZMQError:
        return None
    tail = address.rsplit(":", 3)
    return int(tail[3]) if len(tail) == 4 and all(part.isdecimal() for part in tail[1:]) else None
