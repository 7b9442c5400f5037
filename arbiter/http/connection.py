"""One HTTP/1.1 connection: h11 between the bytes and the requests, with a bound on everything.

A head has at most HEAD_MAX_BYTES and REQUEST_S, a body is refused, an idle connection ends after
IDLE_S. In each turn of the loop the bytes of one connection are parsed, and a pipelined request
waits until the answer before it has left. Whatever a peer sends ends in an answer or in the
connection's end.
"""

import asyncio
import logging
import socket
from typing import Protocol

import h11

from vram_arbiter.arbiter.http.site import EVENTS, HEADERS, Answer, problem

log = logging.getLogger(__name__)

HEAD_MAX_BYTES = 8 * 1024
RECEIVE_BYTES = 4 * 1024
"""Taken from a socket in one turn of the loop."""
REQUEST_S = 5.0
IDLE_S = 30.0
STREAM_BUFFER_BYTES = 2 * 1024 * 1024
"""Of events that a page has not taken: one that is slower is dropped, and connects again."""


class Handler(Protocol):
    """Takes requests and the ends of connections."""

    def opened(self, connection: "Connection") -> None: ...

    def requested(
        self, connection: "Connection", target: str, headers: dict[bytes, bytes], *, head: bool
    ) -> None:
        """Answer by `answer` or `stream`, now or later."""
        ...

    def closed(self, connection: "Connection") -> None: ...


class Turns:
    """Connections with bytes to parse: one in each turn of the loop, so that other work of the
    loop waits for one head and not for those of all peers."""

    def __init__(self) -> None:
        self._waiting: dict[Connection, None] = {}

    def ask(self, connection: "Connection") -> None:
        if not self._waiting:
            asyncio.get_running_loop().call_soon(self._next)
        self._waiting[connection] = None

    def _next(self) -> None:
        connection = next(iter(self._waiting))
        try:
            connection.advance()
        finally:
            del self._waiting[connection]
            if self._waiting:
                asyncio.get_running_loop().call_soon(self._next)


class Connection(asyncio.BufferedProtocol):
    """Parses requests and writes answers. Streams after `stream` until an end closes it."""

    def __init__(self, handler: Handler, server: str, turns: Turns) -> None:
        self._handler = handler
        self._turns = turns
        self._fixed = [*HEADERS.items(), ("Server", server)]
        self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=HEAD_MAX_BYTES)
        self._buffer = bytearray(RECEIVE_BYTES)
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._busy = False  # a request is being answered
        self._full = False  # the answer before has not left yet
        self._head_only = False
        self.streams = False

    # -- the transport's side
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(0)
        self._end_after(REQUEST_S)
        self._handler.opened(self)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if self.streams:
            return  # a page has nothing more to say
        self._http.receive_data(bytes(self._buffer[:nbytes]))
        if self._transport is not None:
            self._transport.pause_reading()
        self._turns.ask(self)

    def eof_received(self) -> bool:
        return False  # close: half of a connection is of no use to a page

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False
        if not self.streams:
            self._turns.ask(self)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._transport = None
        self._handler.closed(self)

    # -- the handler's side
    @property
    def socket(self) -> socket.socket | None:
        """The socket of an open connection."""
        return None if self._transport is None else self._transport.get_extra_info("socket")

    def answer(self, answer: Answer) -> None:
        """Answer the request under way."""
        if self._transport is None or not self._busy:
            return
        fixed = [("Content-Type", answer.kind), ("Content-Length", str(len(answer.body)))]
        close = [("Connection", "close")] if answer.close else []
        headers = [*self._fixed, *fixed, *answer.more, *close]
        self._write(h11.Response(status_code=answer.status, headers=headers))
        if not self._head_only:
            self._write(h11.Data(data=answer.body))
        self._write(h11.EndOfMessage())
        self._busy = False
        if self._http.our_state is h11.MUST_CLOSE or answer.close:
            self._close()
            return
        self._end_after(IDLE_S)
        self._http.start_next_cycle()
        asyncio.get_running_loop().call_soon(self._turns.ask, self)  # not in the turn of this one

    def stream(self) -> None:
        """Answer the request under way with events, from `send`."""
        if self._transport is None or not self._busy:
            return
        headers = [*self._fixed, ("Content-Type", EVENTS), ("Connection", "close")]
        self._write(h11.Response(status_code=200, headers=headers))
        if self._head_only:
            self._write(h11.EndOfMessage())
            self._close()
            return
        self.streams = True
        self._transport.resume_reading()  # to notice its end
        if self._timer is not None:
            self._timer.cancel()

    def send(self, data: bytes) -> bool:
        """Send events. False: the page has not taken what it was sent, and is dropped."""
        if self._transport is None:
            return False
        if self._transport.get_write_buffer_size() + len(data) > STREAM_BUFFER_BYTES:
            log.info("http: a page that does not read its events is dropped")
            self.abort()
            return False
        self._write(h11.Data(data=data))
        return True

    def abort(self) -> None:
        """End the connection now."""
        if self._transport is not None:
            self._transport.abort()

    def advance(self) -> None:
        """Parse the next request, if the answer before it has left."""
        if self._transport is None or self._transport.is_closing() or self._busy or self._full:
            return
        try:
            event = self._http.next_event()
            if event is h11.NEED_DATA:
                self._transport.resume_reading()
                return
            if not isinstance(event, h11.Request):  # ConnectionClosed
                self._close()
                return
            self._busy, self._head_only = True, event.method == b"HEAD"
            self._end_after(REQUEST_S)
            self._take(event)
        except h11.RemoteProtocolError as error:
            log.debug("http: %s", error)
            self._refuse(error.error_status_hint)

    # -- steps
    def _take(self, request: h11.Request) -> None:
        if request.method not in (b"GET", b"HEAD"):
            # its body is not read, so the connection cannot go on
            self.answer(problem(405, "this page is read-only", close=True))
            return
        headers = dict(request.headers)
        if b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0":
            self.answer(problem(413, "a request to this page has no body", close=True))
            return
        event = self._http.next_event()
        assert isinstance(event, h11.EndOfMessage)
        target = request.target.decode("latin-1")
        self._handler.requested(self, target, headers, head=self._head_only)

    def _refuse(self, status: int) -> None:
        """Answer bytes that are not a request, and close."""
        if self._http.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            self._busy, self._head_only = True, False
            self.answer(problem(status, "not a request that this page understands", close=True))
        else:
            self.abort()

    def _write(self, event: h11.Event) -> None:
        assert self._transport is not None
        for piece in self._http.send_with_data_passthrough(event) or ():
            if piece and self._transport is not None:
                self._transport.write(piece)

    def _close(self) -> None:
        """Close once the answer has left, and do not wait for ever for that."""
        if self._transport is not None:
            self._end_after(REQUEST_S)
            self._transport.close()

    def _end_after(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(seconds, self.abort)
