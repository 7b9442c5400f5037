"""A DEALER socket on an asyncio loop: messages in and out as maps, and a word when the other side hangs up.

libzmq's file descriptor is edge-triggered: after every send the socket is drained too, or a wake-up would be lost. The monitor
tells of a hang-up at once, where heartbeats would take seconds. It knows nothing of what the messages mean.
"""

import asyncio
import errno
import logging
import os
from collections.abc import Callable
from typing import Any

import msgpack
import zmq
import zmq.utils.monitor

from clients.packing import pack
from schemas.errors import ConfigError

log = logging.getLogger(__name__)

DRAIN_MAX = 256  # messages in one go, then the loop's other work gets its turn
RECONNECT_MS = 20  # libzmq's first pause before it tries again …
RECONNECT_MAX_MS = 500  # … and the longest
MESSAGE_LIMIT_BYTES = 64 * 1024 * 1024  # a reply is never near it; libzmq hangs up beyond


class Transport:
    """Open from construction to `close`. `received(message)` and `hung_up()` are called on the loop.

    Raises ConfigError for a text that is no address; whether anybody is there shows only later.
    """

    def __init__(
        self,
        endpoint: str,
        loop: asyncio.AbstractEventLoop,
        received: Callable[[dict[str, Any]], None],
        hung_up: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._received = received
        self._hung_up = hung_up
        self._drain_scheduled = False
        self._closed = False
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MAX_MS)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MESSAGE_LIMIT_BYTES)
        self._monitor: zmq.Socket[bytes] = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._monitor.setsockopt(zmq.LINGER, 0)
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close(0)
            raise ConfigError(
                f"{endpoint} is no endpoint: {os.strerror(error.errno or errno.EINVAL)}",
                hint="write ipc:///absolute/path.sock",
            ) from error
        loop.add_reader(self._socket.fileno(), self._drain)
        loop.add_reader(self._monitor.fileno(), self._drain_monitor)
        self._schedule_drain()
        loop.call_soon(self._drain_monitor)  # libzmq only signals a reader that found nothing once

    def send(self, message: dict[str, Any]) -> bool:
        """Queue one message. False: the queue is full, the other side does not read."""
        try:
            self._socket.send(pack(message), zmq.NOBLOCK)
        except zmq.Again:
            return False
        self._schedule_drain()
        return True

    def close(self) -> None:
        """Idempotent. What was not sent is dropped."""
        if self._closed:
            return
        self._closed = True
        self._loop.remove_reader(self._socket.fileno())
        self._loop.remove_reader(self._monitor.fileno())
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close(0)

    def _schedule_drain(self) -> None:
        if not self._drain_scheduled:
            self._drain_scheduled = True
            self._loop.call_soon(self._drain)

    def _drain(self) -> None:
        self._drain_scheduled = False
        for _ in range(DRAIN_MAX):
            if self._closed:
                return
            try:
                payload = self._socket.recv_multipart(zmq.NOBLOCK)[-1]
            except zmq.Again:
                return
            try:
                message = msgpack.unpackb(payload, raw=False, strict_map_key=False)
            except (ValueError, msgpack.UnpackException) as error:
                log.warning("a frame that is no msgpack was dropped: %s", error)
                continue
            if isinstance(message, dict):
                self._received(message)
        self._schedule_drain()

    def _drain_monitor(self) -> None:
        hung_up = False
        while not self._closed:
            try:
                frames = self._monitor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            hung_up |= zmq.utils.monitor.parse_monitor_message(frames)["event"] == zmq.EVENT_DISCONNECTED
        if hung_up and not self._closed:
            self._hung_up()
