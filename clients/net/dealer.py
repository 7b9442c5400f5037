"""A DEALER socket on anyio: messages in and out as maps, and a call when the server hangs up.

libzmq's file descriptor is edge-triggered: the socket is emptied after every wake-up, and a send
that found something to read wakes the reader. The socket's monitor tells of a hang-up at once,
where heartbeats would take seconds. The module must not know what messages mean.
"""

import logging
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Protocol

import anyio
import anyio.lowlevel
import msgpack
import zmq

from vram_arbiter.clients.net.link import MESSAGE_LIMIT_BYTES, Link
from vram_arbiter.schemas.errors import MessageTooLarge, ModelError, VramError
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.msgpack_codec import count_values, pack
from vram_arbiter.schemas.runtime.trust import Program

log = logging.getLogger(__name__)

BURST_MAX: Final = 256  # messages in one go, then other tasks get their turn
RETRY_S: Final = 0.02  # the first pause before another connection is tried …
RETRY_MAX_S: Final = 0.5  # … and the longest
UNSENT_MAX: Final = 1000  # messages kept until there is a connection
ANSWER_VALUES_MAX: Final = 65_536  # keys, list items and what they hold, of one answer


class Transport(Protocol):
    """One connection to a server (`Dealer`), as a client's session needs it."""

    def send(self, message: Message) -> bool: ...

    async def run(self) -> None: ...


class Dealer:
    """One connection, made and served by `run`, which its owner starts as a task.

    `run` tries until a server of a trusted user listens (`clients.net.link`), sends what was queued
    by then, and calls `received(message)` for each message. It ends after `hung_up()` or
    `refused(error)` (UntrustedServer), and where its task is canceled.

    `enveloped`: the server may be one of the field. Messages stand behind an empty frame, answers
    need not be maps, and the connection is `refused` with ModelError at one that is not msgpack: it
    belonged to a request, which would wait for it in vain.
    """

    def __init__(
        self,
        endpoint: str,
        received: Callable[[Any], None],
        hung_up: Callable[[], None],
        refused: Callable[[VramError], None],
        *,
        program: Program,
        enveloped: bool = False,
    ) -> None:
        self._endpoint = endpoint
        self._program: Program = program
        self._enveloped = enveloped
        self._received = received
        self._hung_up = hung_up
        self._refused = refused
        self._unsent: deque[bytes] = deque()
        self._link: Link | None = None  # while it is open
        self._reading: anyio.CancelScope | None = None  # while the reader waits

    def send(self, message: Message, max_bytes: int = MESSAGE_LIMIT_BYTES) -> bool:
        """Queue one message. False: the queue is full, the server does not read. Raises
        MessageTooLarge."""
        payload = pack(message)
        if len(payload) > max_bytes:
            raise MessageTooLarge(
                f"the request has {len(payload)} bytes, the limit is {max_bytes}",
                hint="send less in one message",
                details={"size_bytes": len(payload), "limit_bytes": max_bytes},
            )
        if self._link is None or self._link.state != "open":
            if len(self._unsent) >= UNSENT_MAX:
                return False
            self._unsent.append(payload)
            return True
        sent = self._link.send(payload)
        if self._reading is not None and int(self._link.socket.get(zmq.EVENTS)) & zmq.POLLIN:
            self._reading.cancel()  # sending took the reader's wake-up
        return sent

    async def run(self) -> None:
        """Serve one connection to its end. A text that is not an endpoint is `refused` too."""
        try:
            link = await self._connect()
            try:
                await self._serve(link)
            finally:
                self._link = None
                link.close()
        except VramError as error:
            self._refused(error)
        else:
            self._hung_up()

    # -- steps -------------------------------------------------------------------------------------
    async def _connect(self) -> Link:
        """Return an open link. Raises UntrustedServer."""
        pause_s = RETRY_S
        while True:
            link = Link(
                zmq.Context.instance(), self._endpoint, self._program, enveloped=self._enveloped
            )
            try:
                while link.advance() == "connecting":
                    await anyio.wait_readable(link.monitor.fileno())
            except BaseException:
                link.close()
                raise
            if link.state == "open":
                return link
            link.close()
            await anyio.sleep(pause_s)
            pause_s = min(2 * pause_s, RETRY_MAX_S)

    async def _serve(self, link: Link) -> None:
        """Send what was queued, then hand on messages until the server hangs up."""
        self._link = link
        while self._unsent:
            link.send(self._unsent.popleft())
        refusal: VramError | None = None
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._watch, link, tasks.cancel_scope)
            try:
                await self._read(link)
            except VramError as error:
                refusal = error
                tasks.cancel_scope.cancel()
        if refusal is not None:
            raise refusal
        while self._hand_on(link):  # its last words
            pass

    async def _watch(self, link: Link, reading: anyio.CancelScope) -> None:
        while link.advance() == "open":
            await anyio.wait_readable(link.monitor.fileno())
        reading.cancel()

    async def _read(self, link: Link) -> None:
        while True:
            if self._hand_on(link):
                await anyio.lowlevel.checkpoint()
                continue
            with anyio.CancelScope() as self._reading:
                await anyio.wait_readable(link.socket.fileno())
            self._reading = None

    def _hand_on(self, link: Link) -> bool:
        """Hand on what is there. True: there may be more."""
        for _ in range(BURST_MAX):
            payload = link.receive()
            if payload is None:
                return False
            try:
                if self._enveloped and count_values(payload, ANSWER_VALUES_MAX) > ANSWER_VALUES_MAX:
                    raise ValueError(f"more than {ANSWER_VALUES_MAX} values")
                message = msgpack.unpackb(payload, raw=False, strict_map_key=False)
            except (ValueError, msgpack.UnpackException) as error:
                if self._enveloped:
                    raise ModelError(
                        f"the answer of {self._endpoint} is not a msgpack value: {error}",
                        hint="is this the endpoint of a sidecar? see its log",
                        details={"endpoint": self._endpoint, "size_bytes": len(payload)},
                    ) from None
                log.warning("dropped a frame that is not msgpack: %s", error)
                continue
            if self._enveloped or isinstance(message, dict):
                try:
                    self._received(message)
                except Exception:
                    log.exception("a message from %s was not understood", self._endpoint)
        return True
