"""URLs and addresses in configuration files and in the environment."""

import ipaddress
from dataclasses import dataclass
from urllib.parse import urlsplit


def http_url(text: str, expected: str) -> str:
    """Return `text`. Raises ValueError, which says what was `expected`, unless it is http://HOST...
    or https://HOST...."""
    try:
        parts = urlsplit(text)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        good = False
    if not good:
        raise ValueError(f"expected {expected}, got {_shown(text)!r}")
    return text


def collector_url(text: str) -> str:
    """Return `text`. Raises ValueError unless it is the URL of a collector."""
    return http_url(text, "the URL of a collector such as http://localhost:4318")


def request_url(text: str, expected: str) -> str:
    """Return `text`. Raises ValueError unless it is a URL that requests go to as it stands."""
    parts = urlsplit(http_url(text, expected))
    if parts.username is not None or parts.fragment:
        raise ValueError(f"expected a URL without user and fragment, got {_shown(text)!r}")
    if not text.isascii() or not text.isprintable() or " " in text:
        raise ValueError(
            f"expected a URL without spaces and special characters, got {_shown(text)!r}"
        )
    return text


def _shown(url: str) -> str:
    """Return a URL without password and token."""
    return url.rpartition("@")[2].partition("?")[0]


@dataclass(frozen=True, slots=True)
class HttpAddress:
    """Where an HTTP server listens: a literal address and a port; 0: any free one."""

    host: str
    port: int

    @property
    def loopback(self) -> bool:
        return ipaddress.ip_address(self.host).is_loopback

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def http_address(text: str) -> HttpAddress:
    """Return the address that `127.0.0.1:9870`, `[::1]:9870`, `localhost:9870` or `9870` stands
    for. Raises ValueError."""
    host, colon, port = text.rpartition(":")
    if not colon or host == "localhost":
        host = "127.0.0.1"
    elif host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        host = ""  # an IPv6 address without brackets
    try:
        number = int(port) if port.isascii() and port.isdigit() else -1
        found = HttpAddress(str(ipaddress.ip_address(host)), number)
    except ValueError:
        number = -1
    if not 0 <= number <= 65_535:
        raise ValueError(f"expected ADDRESS:PORT such as 127.0.0.1:9870, got {text!r}")
    return found
