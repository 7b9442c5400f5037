"""What is served at which path, and to whom: the page's files, its live events, the history as
JSON, and metrics for Prometheus.

No source but this server, nothing inline, and never in a frame.
"""

import json
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vram_arbiter.clients.observer.page.access import Access
from vram_arbiter.clients.observer.page.feed import PageFeed
from vram_arbiter.clients.observer.page.server import Connections
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import ArbiterUnreachable, VramError
from vram_arbiter.schemas.wire.replies import HistoryReply

_STATIC = Path(__file__).parent / "static"
_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": _CSP,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_RAW_HEADERS = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
# the cookie of SameSite=Strict is not sent with a redirect of another site's link, but with this
_ACCEPTED = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>VRAM arbiter</title>'
    '<meta http-equiv="refresh" content="0;url=/"><p><a href="/">status page</a></p></html>\n'
)
HISTORY_MAX = 200
"""Events of one answer."""
SEQ_MAX = 1 << 53


type Metrics = Callable[[str], Awaitable[tuple[bytes, str]]]
"""Given what a reader accepts, metrics as of now and their content type."""
type History = Callable[[int, int, tuple[str, ...]], Awaitable[HistoryReply]]


class StatusSite:
    """Answers requests; `app` is the ASGI application."""

    def __init__(
        self,
        access: Access,
        feed: PageFeed,
        history: History,
        metrics: Metrics,
        connections: Connections,
        reached: Callable[[], Awaitable[bool]],
    ) -> None:
        """`reached`: whether the arbiter answers."""
        self._feed = feed
        self._history = history
        self._metrics = metrics
        self._connections = connections
        self._reached = reached
        routes = [
            Route("/events", self._events),
            Route("/history", self._past),
            Route("/metrics", self._numbers),
            *(Route(path, answer) for path, answer in _files().items()),
        ]
        guard = Middleware(Guard, access=access)
        self.app: ASGIApp = Starlette(routes=routes, middleware=[guard])

    async def _events(self, request: Request) -> Response:
        if not await self._reached():
            return problem(502, "the arbiter is not reached")
        end = ("", 0) if request.client is None else (request.client.host, request.client.port)
        if not self._connections.may_stream(end):
            return problem(503, "too many pages are open; close some", {"Retry-After": "5"})
        kind = "text/event-stream; charset=utf-8"
        if request.method == "HEAD":
            return Response(media_type=kind)
        reader = self._feed.join(lambda: self._connections.abort(end))
        self._connections.streams(end)
        return StreamingResponse(reader.chunks(), media_type=kind)

    async def _past(self, request: Request) -> Response:
        """`?after=SEQ&limit=N&kind=K`: as the wire's `history`, as JSON."""
        query = request.query_params
        try:
            after = int(query.get("after", "0")[:16])
            limit = int(query.get("limit", str(HISTORY_MAX))[:16])
        except ValueError:
            return problem(400, "expected /history?after=NUMBER&limit=NUMBER&kind=KIND")
        after, limit = max(0, min(after, SEQ_MAX)), max(1, min(limit, HISTORY_MAX))
        try:
            found = await self._history(after, limit, tuple(query.getlist("kind")))
        except ArbiterUnreachable:
            return problem(502, "the arbiter is not reached")
        except VramError as error:
            return problem(400, error.message)
        body = json.dumps(to_map(found), separators=(",", ":"), default=str)
        return Response(body, media_type="application/json")

    async def _numbers(self, request: Request) -> Response:
        body, kind = await self._metrics(request.headers.get("accept", ""))
        return Response(body, headers={"Content-Type": kind})


class Guard:
    """Refuses what may not be served, and adds the headers of every answer."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *_RAW_HEADERS]
            await send(message)

        answer = self._refused(scope) or self._app
        await answer(scope, receive, with_headers)

    def _refused(self, scope: Scope) -> Response | None:
        if scope["method"] not in ("GET", "HEAD"):
            closing = {"Allow": "GET, HEAD", "Connection": "close"}
            return problem(405, "this page is read-only", closing)
        headers = dict(scope["headers"])
        if b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0":
            return problem(413, "a request to this page has no body", {"Connection": "close"})
        denied = self._access.check(headers)
        if denied is None:
            return None
        if denied.status == 401:
            if scope["path"] == "/":
                cookie = self._access.cookie_for(scope["query_string"].decode("latin-1"))
                if cookie is not None:
                    kept = {"Set-Cookie": cookie}
                    return Response(_ACCEPTED, media_type="text/html", headers=kept)
            return problem(401, denied.text, {"WWW-Authenticate": "Bearer"})
        return problem(denied.status, denied.text)


def problem(status: int, text: str, headers: Mapping[str, str] | None = None) -> Response:
    """An answer in words."""
    return PlainTextResponse(f"{text}\n", status, headers)


def _files() -> Mapping[str, Callable[[Request], Awaitable[Response]]]:
    """Read the page's files, by path."""
    found = {}
    for file in _STATIC.iterdir():
        path = "/" if file.name == "index.html" else f"/{file.name}"
        found[path] = _file(file.read_bytes(), _KINDS[file.suffix])
    return found


def _file(body: bytes, kind: str) -> Callable[[Request], Awaitable[Response]]:
    async def answer(_: Request) -> Response:
        return Response(body, headers={"Content-Type": kind})

    return answer
