"""Freeing and restoring through HTTP: one request each.

`http.client` of the standard library: a few short requests to loopback need no HTTP package in the
base install, and unlike `urllib.request` it follows neither redirects nor proxies of the
environment, so that a request goes to the named host and nowhere else.
"""

import http.client
import ipaddress
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final
from urllib.parse import urlsplit

from vram_arbiter.clients.foreign.actions import Deadline
from vram_arbiter.schemas.errors import ActionFailed
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.urls import request_url

OTHER_API: Final = "is this the program's address, and a version of it that is supported?"
ANSWER_MAX_BYTES: Final = 4 << 20
SHOWN_MAX_CHARS: Final = 200
"""Of an answer that is quoted in an error."""


@dataclass(frozen=True, slots=True)
class Request:
    """One request. `body`: JSON as text; "" for none. `headers`: beside those of the body."""

    url: str
    method: str = "POST"
    body: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.method} {self.url}"


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer. `headers`: names in lower case."""

    status: int
    headers: Mapping[str, str]
    body: bytes


def checked_url(url: str, *, remote: bool) -> str:
    """Return a URL that may be called, without a slash at its end. Raises ValueError.

    `remote`: hosts other than this one are allowed.
    """
    host = urlsplit(request_url(url, "a URL such as http://127.0.0.1:8000")).hostname or ""
    if not remote and not _is_here(host):
        raise ValueError(
            f"{host} is not a loopback host: the program runs on this machine; --allow-remote "
            "calls it anyway"
        )
    return url.rstrip("/")


def _is_here(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def answer(request: Request, deadline: Deadline) -> Reply:
    """Return the answer. Raises ActionFailed where there is none in time."""
    parts = urlsplit(request.url)
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    headers = {"Content-Type": "application/json"} if request.body else {}
    headers |= request.headers
    assert parts.hostname is not None, f"{request.url} was not checked"
    connection = kind(parts.hostname, parts.port, timeout=deadline.left_s(str(request)))
    try:
        connection.request(request.method, target, request.body or None, headers)
        reply = connection.getresponse()
        body = b""
        while chunk := reply.read1(1 << 16):
            body += chunk
            deadline.left_s(str(request))
            if len(body) > ANSWER_MAX_BYTES:
                raise ActionFailed(
                    f"{request}: an answer of more than {ANSWER_MAX_BYTES} bytes", hint=OTHER_API
                )
    except TimeoutError as error:
        raise ActionFailed(
            f"{request}: no answer within {deadline.limit_s:g} s", hint="allow more with --timeout"
        ) from error
    except (OSError, http.client.HTTPException) as error:
        raise ActionFailed(
            f"{request}: {str(error) or type(error).__name__}",
            hint="is this the program's address?",
        ) from error
    finally:
        connection.close()
    return Reply(reply.status, {key.lower(): value for key, value in reply.getheaders()}, body)


def call(request: Request, deadline: Deadline, *, besides: int = 200) -> bytes:
    """Return the body of a success: 2xx, or the status `besides`. Raises ActionFailed."""
    reply = answer(request, deadline)
    if not 200 <= reply.status < 300 and reply.status != besides:
        told = printable(reply.body.decode(errors="replace"))[:SHOWN_MAX_CHARS]
        raise ActionFailed(
            f"{request}: answered {reply.status}" + (f": {told}" if told else ""),
            hint="see the program's log",
            details={"status": reply.status, "url": request.url},
        )
    return reply.body


def call_json(request: Request, deadline: Deadline) -> object:
    """Return the JSON of a success. Raises ActionFailed."""
    body = call(request, deadline)
    try:
        return json.loads(body)
    except ValueError as error:
        raise ActionFailed(
            f"{request}: expected JSON, got {body[:40]!r}", hint=OTHER_API
        ) from error


@dataclass(frozen=True, slots=True)
class HttpAction:
    """A request that frees, and one that restores, if any."""

    freeing: Request
    restoring: Request | None
    timeout_s: float
    name: ClassVar = "http"
    keeps_context: ClassVar = True
    parks: ClassVar = False
    suspends: ClassVar = False

    def check(self) -> None:
        """It needs nothing of this machine."""

    def busy(self) -> int | None:
        return None

    def free(self, pids: Sequence[int]) -> None:
        call(self.freeing, Deadline(self.timeout_s))

    def restore(self, pids: Sequence[int]) -> None:
        if self.restoring is not None:
            call(self.restoring, Deadline(self.timeout_s))
