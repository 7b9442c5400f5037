"""A DEALER socket on an asyncio loop: messages in and out as maps, and a word when the other side hangs up.

libzmq's file descriptor is edge-triggered: after every send the socket is drained too, or a wake-up would be lost. The monitor
tells of a hang-up at once, where heartbeats would take seconds. It knows nothing of what the messages mean.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from vram_arbiter.clients._protocol.codec import pack
from vram_arbiter.clients.net.link import Link
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime.trust import Program

log = logging.getLogger(__name__)

DRAIN_MAX = 256  # messages in one go, then the loop's other work gets its turn
RETRY_S = 0.02  # the first pause before another connection is tried …
RETRY_MAX_S = 0.5  # … and the longest
UNSENT_MAX = 1000  # messages kept until there is a connection


class Transport:
    """Open from construction to `close`. `received(message)`, `hung_up()` and `refused(error)` are called on the loop.

    It tries until a server of a trusted user listens (`clients.net.link`), and sends then what was to be sent. It connects once: after
    `hung_up` or `refused` (UntrustedServer) the owner closes it.
    Raises ConfigError for a text that is not an endpoint; whether a server is there shows only later.
    """

    def __init__(
        self,
        endpoint: str,
        loop: asyncio.AbstractEventLoop,
        received: Callable[[dict[str, Any]], None],
        hung_up: Callable[[], None],
        refused: Callable[[VramError], None],
        *,
        program: Program,
    ) -> None:
        self._endpoint = endpoint
        self._program: Program = program
        self._loop = loop
        self._received = received
        self._hung_up = hung_up
        self._refused = refused
        self._unsent: deque[bytes] = deque()
        self._drain_scheduled = False
        self._pause_s = RETRY_S
        self._retry: asyncio.TimerHandle | None = None
        self._link: Link | None = None
        self._connect()

    def send(self, message: dict[str, Any]) -> bool:
        """Queue one message. False: the queue is full, the other side does not read."""
        payload = pack(message)
        if self._link is None or self._link.state != "open":
            if len(self._unsent) >= UNSENT_MAX:
                return False
            self._unsent.append(payload)
            return True
        sent = self._link.send(payload)
        self._schedule_drain()
        return sent

    def close(self) -> None:
        """Idempotent. What was not sent is dropped."""
        self._unsent.clear()
        if self._retry is not None:
            self._retry.cancel()
        self._disconnect()

    # -- the connection ----------------------------------------------------------------------------------------------
    def _connect(self) -> None:
        self._retry = None
        link = self._link = Link(zmq.Context.instance(), self._endpoint, self._program)
        self._loop.add_reader(link.socket.fileno(), self._drain)
        self._loop.add_reader(link.monitor.fileno(), self._advance)
        self._loop.call_soon(self._advance)  # libzmq only signals a reader that found nothing once

    def _disconnect(self) -> None:
        if self._link is not None:
            self._loop.remove_reader(self._link.socket.fileno())
            self._loop.remove_reader(self._link.monitor.fileno())
            self._link.close()
            self._link = None

    def _advance(self) -> None:
        link = self._link
        if link is None:
            return
        before = link.state
        try:
            state = link.advance()
        except VramError as error:
            self._refuse(error)
            return
        if before == "connecting" and state == "open":
            while self._unsent:
                link.send(self._unsent.popleft())
            self._schedule_drain()
        elif state == "ended" and before == "connecting":
            self._disconnect()
            self._retry = self._loop.call_later(self._pause_s, self._connect)
            self._pause_s = min(2 * self._pause_s, RETRY_MAX_S)
        elif state == "ended":
            self._drain()  # its last words
            if self._link is link:
                self._disconnect()
                self._hung_up()

    def _refuse(self, error: VramError) -> None:
        self._disconnect()
        self._refused(error)

    # -- messages ----------------------------------------------------------------------------------------------------
    def _schedule_drain(self) -> None:
        if not self._drain_scheduled:
            self._drain_scheduled = True
            self._loop.call_soon(self._drain)

    def _drain(self) -> None:
        self._drain_scheduled = False
        for _ in range(DRAIN_MAX):
            if self._link is None:
                return
            try:
                payload = self._link.receive()
            except VramError as error:
                self._refuse(error)
                return
            if payload is None:
                return
            try:
                message = msgpack.unpackb(payload, raw=False, strict_map_key=False)
            except (ValueError, msgpack.UnpackException) as error:
                log.warning("a frame that is no msgpack was dropped: %s", error)
                continue
            if isinstance(message, dict):
                self._received(message)
        self._schedule_drain()
