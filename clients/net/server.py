"""The server of the programs that are not the arbiter (sidecars, runner, reasoner): one msgpack map
per message, on `schemas.runtime.router`.

It owns the socket, decoding, size limits and the error reply for what is not a message. A handler
gets the decoded map and may answer at once, later, or several times. Peers are unmodified pyzmq
DEALER and REQ sockets. Only `ipc://PATH` is served: on loopback tcp any user of the machine could
drive the robot. It must not know what a message means.
"""

import asyncio
import contextlib
import grp
import logging
import os
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

from pydantic import TypeAdapter, ValidationError

from vram_arbiter.schemas.defaults import IMAGE_MESSAGE_MAX_BYTES, MIB
from vram_arbiter.schemas.errors import (
    BadRequest,
    LimitExceeded,
    MessageTooLarge,
    NotPermitted,
    UnknownOp,
    VramError,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.connection import Bounds, Connection
from vram_arbiter.schemas.runtime.endpoints import socket_path
from vram_arbiter.schemas.runtime.folders import LockFile, socket_folder
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, leading_id, pack, unpack_map
from vram_arbiter.schemas.runtime.peercred import is_guest
from vram_arbiter.schemas.runtime.router import Router
from vram_arbiter.schemas.runtime.zmtp import Oversize

log = logging.getLogger(__name__)

GUESTS: Final = "vram-guests"
"""Unix group of robots behind ssh, as configs/ssh/vram-guests.conf and sysusers.d name it."""

REASON_MAX_CHARS = 500
ENVELOPE_MAX_BYTES = 64 * 1024
IMAGES_MAX_BYTES = IMAGE_MESSAGE_MAX_BYTES + ENVELOPE_MAX_BYTES
VALUES_MAX = 12_288
"""msgpack values of one message: 800 points of a trajectory of six joints; at most 4 ms of
decoding.
"""
KEYS_MAX = 256
"""Keys of one map: each that is unknown costs the event loop one more error, 3 µs."""
ITEMS_MAX = 1024
"""Items of one list."""
LINGER_S = 3.0
"""How long a server that ends waits until its last answers are read; only peers that do not read
cost so long.
"""
SILENT_S = 300.0
"""A connection without one good message is cut then, and earlier where its place is needed. libzmq
connects again by itself.
"""
CONNECTIONS_MAX = 512
WAITING_MAX = 512
"""Requests of one user that wait for their answers."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Sender of a message: where to answer, and which process and user the kernel says it is.

    `identity` is the serial of its connection, never reused. `pid` is 0 for a process that cannot
    be seen from here. `envelope` is the message's own: a REQ that stopped waiting for an answer
    tells by it that a late one is not for its next request.
    """

    identity: int
    pid: int
    uid: int
    envelope: bytes = field(default=b"", compare=False)


Handler = Callable[[Peer, Message], Awaitable[None]]
ErrorReply = Callable[[VramError], Message]


@dataclass(slots=True)
class _Client:
    """What the server keeps of a connection."""

    connection: Connection
    peer: Peer
    is_guest: bool


@dataclass(slots=True)
class _Waiting:
    """Requests of one user that are being answered."""

    count: int = 0
    size_bytes: int = 0


def check_free(endpoint: str) -> None:
    """Before a server has moved or recorded anything: may it serve there? Claims nothing; binding
    decides which server gets the endpoint.

    Raises what `RouterServer` does.
    """
    path = path_of(endpoint)
    _lock_of(path).check_free()


def path_of(endpoint: str) -> Path:
    """Path of the socket of an endpoint that a server may bind. Raises ConfigError."""
    return Path(socket_path(endpoint))


def _lock_of(path: Path) -> LockFile:
    return LockFile(Path(f"{path}.lock"), f"ipc://{path}", "a server")


def _number_of(group: str | None) -> int | None:
    """Return the number of a Unix group; None where there is none."""
    try:
        return None if group is None else grp.getgrnam(group).gr_gid
    except KeyError:
        return None


class RouterServer:
    """`async with RouterServer(endpoint, on_error) as server: await server.serve(handler)`.

    A handler runs in a task of its own, so that a slow one delays no other request; its work up to
    the first wait is done at once.
    Args: `message_max_bytes` bounds one request; beside binary values, as pictures are, it holds at
    most 1 MiB. `work_share` as in `schemas.runtime.connection.Bounds`. `closed_to`: a Unix group
    whose members are answered NotPermitted, None: there is none.
    Raises ConfigError for an endpoint that cannot be bound, AlreadyRunning when a living server has
    it.
    """

    def __init__(
        self,
        endpoint: str,
        on_error: ErrorReply,
        *,
        message_max_bytes: int = IMAGES_MAX_BYTES,
        work_share: float = 1.0,
        closed_to: str | None = GUESTS,
    ) -> None:
        self.endpoint = endpoint
        self._path = path_of(endpoint)
        self._on_error = on_error
        self._closed_to = _number_of(closed_to)
        self._unpack = UnpackLimits(
            message_max_bytes, values_max=VALUES_MAX, keys_max=KEYS_MAX, items_max=ITEMS_MAX
        )
        several_bytes = max(64 * MIB, 8 * message_max_bytes)
        self._waiting_max_bytes = several_bytes
        limits = Bounds(
            message_max_bytes=message_max_bytes,
            # these wires have no hello: the first request may be a picture
            stranger_message_max_bytes=message_max_bytes,
            skip_max_bytes=several_bytes,
            hello_s=SILENT_S,
            connections_max=CONNECTIONS_MAX,
            out_max_bytes=several_bytes,
            user_out_max_bytes=2 * several_bytes,
            user_in_max_bytes=several_bytes,
            charge_bytes=message_max_bytes,  # a picture is one message
            work_share=work_share,
        )
        self._router = Router(self._path, self, limits)
        self._clients: dict[int, _Client] = {}  # by serial
        self._waiting: dict[int, _Waiting] = {}  # by uid
        self._handler: Handler | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        socket_folder(self._path.parent, os.environ, shared=True)
        lock = _lock_of(self._path)
        lock.acquire()
        self._stack.callback(lock.release)
        try:
            self._router.bind()
        except BaseException:
            await self._stack.aclose()
            raise
        self._stack.push_async_callback(self._router.aclose, LINGER_S)
        return self

    async def __aexit__(self, *_: object) -> None:
        """What was sent by now reaches its peer, though the process ends behind this. Then the
        endpoint is free.
        """
        self._router.stop_receiving()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._stack.aclose()

    async def serve(self, handler: Handler) -> None:
        """Read until cancelled."""
        loop = asyncio.get_running_loop()
        self._handler = handler
        self._router.start(loop)
        try:
            await loop.create_future()
        finally:
            self._router.stop_receiving()

    async def send(self, peer: Peer, message: Message | list[Message]) -> None:
        """Answer or push. A peer that is gone gets nothing; one that does not read is hung
        up on."""
        client = self._clients.get(peer.identity)
        if client is not None and not client.connection.send(pack(message), peer.envelope):
            client.connection.close("it does not read its answers")

    # -- for the router
    def connected(self, connection: Connection) -> None:
        peer = Peer(connection.serial, connection.peer.process.pid, connection.peer.uid)
        guest = is_guest(connection.peer, self._closed_to)
        self._clients[connection.serial] = _Client(connection, peer, guest)

    def disconnected(self, connection: Connection, reason: str) -> None:
        del self._clients[connection.serial]

    def received(self, connection: Connection, payload: bytes | bytearray | Oversize) -> None:
        client, loop = self._clients[connection.serial], asyncio.get_running_loop()
        try:
            if client.is_guest:
                raise NotPermitted(
                    f"a guest may not use {self._path.stem}",
                    hint=f"ask on {os.uname().nodename}, as a user outside the guests' group",
                )
            message, size = self._decoded(payload)
            waiting = self._waiting_of(client.peer.uid, size)
        except VramError as error:
            connection.send(pack(self._refusal(payload, error)))
            return
        if not connection.admitted:
            connection.admit()
        waiting.count += 1
        waiting.size_bytes += size
        if connection.envelope != client.peer.envelope:  # requests under way keep theirs
            client.peer = replace(client.peer, envelope=connection.envelope)
        task = asyncio.Task(
            self._run(client.peer, message, waiting, size), loop=loop, eager_start=True
        )
        if not task.done():
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def _refusal(self, payload: bytes | bytearray | Oversize, error: VramError) -> Message:
        """Return the answer to a message that is not handled, with the id where it begins with
        one."""
        answer = self._on_error(error)
        request_id = None if isinstance(payload, Oversize) else leading_id(payload)
        return answer if request_id is None else {**answer, "re": request_id}

    def _decoded(self, payload: bytes | bytearray | Oversize) -> tuple[Message, int]:
        """The message and its size. Raises MessageTooLarge and BadFrame."""
        if isinstance(payload, Oversize):
            raise MessageTooLarge(
                f"the message has {payload.size} bytes, the limit is {payload.limit}",
                hint="send a smaller image",
                details={"size_bytes": payload.size, "limit_bytes": payload.limit},
            )
        return unpack_map(payload, self._unpack), len(payload)

    def _waiting_of(self, uid: int, size: int) -> _Waiting:
        """Raises LimitExceeded where a user has all the requests, or bytes of them, that
        may wait."""
        waiting = self._waiting.setdefault(uid, _Waiting())
        full = "requests" if waiting.count >= WAITING_MAX else "bytes of requests"
        if waiting.count >= WAITING_MAX or waiting.size_bytes + size > self._waiting_max_bytes:
            limit = WAITING_MAX if full == "requests" else self._waiting_max_bytes
            raise LimitExceeded(
                f"{limit} {full} of uid {uid} wait for their answers",
                hint="wait for answers before asking more",
                details={"limit": full, "value": limit},
            )
        return waiting

    async def _run(self, peer: Peer, message: Message, waiting: _Waiting, size: int) -> None:
        assert self._handler is not None, "nothing is received before serve()"
        try:
            await self._handler(peer, message)
        finally:
            waiting.count -= 1
            waiting.size_bytes -= size
            if not waiting.count:
                self._waiting.pop(peer.uid, None)


def parsed[T](message: Message, adapter: TypeAdapter[T], ops: Sequence[str]) -> T:
    """Return the request that a message holds.

    Raises UnknownOp (details.known), or BadRequest (details.fields) with each wrong field.
    """
    if message.get("op") not in ops:
        raise UnknownOp(
            f"unknown op {str(message.get('op'))[:64]!r}",
            hint=f"one of {', '.join(ops)}",
            details={"known": [*ops]},
        )
    try:
        return adapter.validate_python(message)
    except ValidationError as error:
        fields = [
            {"path": ".".join(str(part)[:64] for part in item["loc"][1:]), "problem": item["msg"]}
            for item in error.errors(include_url=False, include_input=False)
        ]
        text = "; ".join(f"{item['path']}: {item['problem']}" for item in fields)
        raise BadRequest(f"{message['op']}: {text}", details={"fields": fields}) from error


def refusal(request_id: int | None, error: VramError) -> Message:
    """Return the reply to a request that failed."""
    return {"re": request_id, "ok": False, "error": error.to_wire()}


def reason_of(message: Message) -> str:
    """The `reason` of a request that must never be refused for its words, as a cancel: on one line,
    of bounded length.
    """
    words = message.get("reason")
    text = "" if words is None else str(words)[: 4 * REASON_MAX_CHARS]
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()[
        :REASON_MAX_CHARS
    ]
