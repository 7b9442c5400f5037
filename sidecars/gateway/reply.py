"""What a client gets in answer to a request: comments while it waits, a server's answer, an error
as OpenAI's clients read it.
"""

import asyncio
import json
from collections.abc import Mapping
from typing import Final

from aiohttp import web
from aiohttp.abc import AbstractStreamWriter

from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    BadRequest,
    Evicted,
    KeyRefused,
    LimitExceeded,
    MessageTooLarge,
    NotPermitted,
    SidecarUnavailable,
    UnknownModel,
    VramError,
    WaitTimeout,
)

RETRY_AFTER_S: Final = 5
STATUS: Final[Mapping[type[VramError], int]] = {
    KeyRefused: 401,
    NotPermitted: 403,
    UnknownModel: 404,
    MessageTooLarge: 413,
    BadRequest: 400,
    LimitExceeded: 503,
    WaitTimeout: 503,
    Evicted: 503,
    ArbiterUnreachable: 503,
    SidecarUnavailable: 502,
}
RETRIED: Final = 503
"""Sent with Retry-After."""
_STREAM: Final = (
    b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nCache-Control: no-cache\r\n"
    b"Connection: close\r\n\r\n"
)


class Sent(web.StreamResponse):
    """An answer that is sent already. `lasts`: another request may follow it."""

    def __init__(self, *, lasts: bool) -> None:
        super().__init__()
        self._lasts = lasts

    @property
    def keep_alive(self) -> bool:
        return self._lasts

    async def prepare(self, request: web.BaseRequest) -> AbstractStreamWriter | None:
        return None

    async def write_eof(self, data: bytes = b"") -> None:
        return None


class Reply:
    """The answer to one request, as far as it is sent. With `every_s` comments of an event stream
    (`: waiting`) go before it.

    `streams`: the head of the event stream is sent. `passes`: the head of the server's answer.
    `lasts`: another request may follow it. `status`: the server's; 0: it has not answered.
    `event_at`: time of the first event that it streamed (seconds of the loop). `model`: the one
    that the body names, where it was looked at.
    """

    def __init__(self, request: web.BaseRequest, every_s: float | None) -> None:
        self.request, self._every_s = request, every_s
        self.streams = self.passes = self.lasts = False
        self.status, self.model = 0, ""
        self.event_at: float | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._asked_for_body = False

    @property
    def transport(self) -> asyncio.Transport:
        """Raises ConnectionResetError where the client left."""
        if (transport := self.request.transport) is None:
            raise ConnectionResetError("the client left")
        return transport

    def wait(self) -> None:
        """Send comments until `go`."""
        if self._every_s is not None:
            self._timer = asyncio.get_running_loop().call_later(self._every_s, self._comment)

    def go(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def ask_for_body(self) -> None:
        """Let a client send its body that waits for permission (RFC 9110, 10.1.1), once."""
        waits = self.request.headers.get("expect", "").lower() == "100-continue"
        if waits and not self._asked_for_body and not self.request.content.is_eof():
            self._asked_for_body = True
            self.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def streamed(self) -> None:
        self.event_at = asyncio.get_running_loop().time()

    def fail(self, error: VramError) -> web.StreamResponse:
        """Say the error, as far as the answer can still say one: else cut the connection."""
        if not self.streams and not self.passes:
            return failure(error)
        if self.passes:
            self.transport.abort()
        else:
            self.transport.write(f"event: error\ndata: {json.dumps(_body(error))}\n\n".encode())
        return Sent(lasts=False)

    def _comment(self) -> None:
        if self.request.transport is None:  # the client is just leaving
            return
        self.transport.write(b": waiting\n\n" if self.streams else _STREAM + b": waiting\n\n")
        self.streams = True
        self.wait()


def failure(error: VramError) -> web.Response:
    """Return the answer that says an error."""
    status = next((code for kind, code in STATUS.items() if isinstance(error, kind)), 500)
    headers = {}
    if status == RETRIED:
        headers["Retry-After"] = str(RETRY_AFTER_S)
    elif status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    response = web.json_response(_body(error), status=status, headers=headers)
    if status in (401, 413):  # of a body nothing more is read
        response.force_close()
    return response


def _body(error: VramError) -> dict[str, object]:
    """Return an error as OpenAI's clients read it; Anthropic's read `type` as well."""
    said = {
        "message": str(error),
        "type": error.code,
        "code": error.code,
        "param": None,
        **error.details,
    }
    return {"type": "error", "error": said}
