"""The page's own files, and the headers of every answer. Pure: no sockets."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

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
"""No source but this server, nothing inline, and never in a frame."""

TEXT, HTML, JSON = "text/plain; charset=utf-8", "text/html; charset=utf-8", "application/json"
EVENTS = "text/event-stream; charset=utf-8"
_FILES = {
    "/": ("index.html", HTML),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    **{
        f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8")
        for name in (
            "page",
            *("gpus", "queue", "evictions", "leases", "history"),
            *("feed", "chart", "story", "terms", "format"),
        )
    },
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
# the cookie of SameSite=Strict is not sent with a redirect of another site's link, but with this
_ACCEPTED = (
    b'<!doctype html><html lang="en"><meta charset="utf-8"><title>VRAM arbiter</title>'
    b'<meta http-equiv="refresh" content="0;url=/"><p><a href="/">status page</a></p></html>\n'
)


@dataclass(frozen=True, slots=True)
class Answer:
    """A whole response. `close`: the connection ends with it."""

    status: int
    body: bytes
    kind: str = TEXT
    more: tuple[tuple[str, str], ...] = ()
    close: bool = False


def files() -> Mapping[str, Answer]:
    """Read the page's files, by path."""
    return {
        path: Answer(200, (_STATIC / name).read_bytes(), kind)
        for path, (name, kind) in _FILES.items()
    }


def problem(status: int, text: str, *, close: bool = False) -> Answer:
    """An answer in words."""
    more: dict[int, tuple[tuple[str, str], ...]] = {
        401: (("WWW-Authenticate", "Bearer"),),
        405: (("Allow", "GET, HEAD"),),
        503: (("Retry-After", "5"),),
    }
    return Answer(status, f"{text}\n".encode(), TEXT, more.get(status, ()), close)


def token_accepted(cookie: str) -> Answer:
    """Keep the token as a cookie and lead to the page, without the token in its address."""
    return Answer(200, _ACCEPTED, HTML, (("Set-Cookie", cookie),))
