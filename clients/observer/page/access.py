"""Access of clients to the page: names it is asked for by, foreign origins, and the token.

Loopback needs no token, but any page in a browser of this machine can send requests there. So a
request has to name the server by an address or a known name (a rebound DNS name is neither), and
must not come from another origin. Must not know what is served.
"""

import hashlib
import hmac
import ipaddress
import os
import stat
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qs

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.urls import HttpAddress

TOKEN_MIN_CHARS, TOKEN_MAX_CHARS = 16, 512
HOW_TO_MAKE = "(umask 077; openssl rand -hex 32 > FILE)"


@dataclass(frozen=True, slots=True)
class AccessDenied:
    """The answer to a request that may not be served."""

    status: int
    text: str


def read_token(path: Path) -> str:
    """Return the token in a file. Raises ConfigError for one that others may read, or that is too
    short."""
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno())
            text = file.read(TOKEN_MAX_CHARS + 2)
    except OSError as error:
        raise ConfigError(
            f"http.token_file: {path} cannot be read: {error.strerror}",
            hint=f"make one: {HOW_TO_MAKE}",
        ) from error
    mode = stat.S_IMODE(found.st_mode)
    # of a credential the group's bits are the mask of systemd's access list
    given = os.environ.get("CREDENTIALS_DIRECTORY")
    others = 0o037 if given and path.parent == Path(given) else 0o077
    if mode & others or found.st_uid not in (0, os.getuid()):
        raise ConfigError(
            f"http.token_file: {path} has mode {mode:04o} and owner {found.st_uid}: other users "
            "may read it",
            hint=f"chmod 600 {path}, as the observer's user or root",
        )
    token = text.strip().decode("ascii", errors="replace")
    if not TOKEN_MIN_CHARS <= len(token) <= TOKEN_MAX_CHARS or not token.isalnum():
        raise ConfigError(
            f"http.token_file: expected {TOKEN_MIN_CHARS} to {TOKEN_MAX_CHARS} letters and digits "
            f"in {path}",
            hint=f"make one: {HOW_TO_MAKE}",
        )
    return token


class Access:
    """Decides over requests by their headers."""

    def __init__(self, address: HttpAddress, hosts: Collection[str], token: str | None) -> None:
        self._loopback = address.loopback
        self._hosts = frozenset(name.lower() for name in hosts)
        self._token = token
        # the cookie proves the token and does not tell it; each observer of a host has its own
        self._cookie_name = f"vram_arbiter_{address.port}"
        self._cookie = "" if token is None else _mac(token, b"cookie of the status page").hex()

    def check(self, headers: dict[bytes, bytes]) -> AccessDenied | None:
        """Return why a request is refused; None: it may be served."""
        host = headers.get(b"host", b"").decode("ascii", errors="replace")
        if not self._known(host):
            return AccessDenied(
                421,
                f"this page is not served as {host!r}; ask by address or localhost, or list the "
                "name in http.hosts",
            )
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("ascii", errors="replace").lower() not in (
            f"http://{host}".lower(),
            f"https://{host}".lower(),
        ):
            return AccessDenied(403, "requests of other origins are refused")
        site, mode = headers.get(b"sec-fetch-site"), headers.get(b"sec-fetch-mode")
        if site in (b"cross-site", b"same-site") and mode != b"navigate":
            return AccessDenied(403, "requests of other sites are refused")
        if self._token is None or self._proved(headers):
            return None
        return AccessDenied(
            401, "a token is needed: `Authorization: Bearer TOKEN`, or open /?token=TOKEN once"
        )

    def cookie_for(self, query: str) -> str | None:
        """Return the Set-Cookie value that the token in a query earns; None: there is none, or
        not the right one."""
        given = parse_qs(query).get("token", [])
        if self._token is None or len(given) != 1 or not _same(given[0], self._token):
            return None
        return f"{self._cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"

    def _known(self, host: str) -> bool:
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        name = name.lower().removesuffix(".")
        if name == "localhost" or name in self._hosts:
            return True
        try:
            address = ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
        except ValueError:
            return False
        return address.is_loopback or not self._loopback

    def _proved(self, headers: dict[bytes, bytes]) -> bool:
        assert self._token is not None
        scheme, _, given = headers.get(b"authorization", b"").partition(b" ")
        if scheme.lower() == b"bearer":
            return _same(given.strip().decode("latin-1"), self._token)
        for part in headers.get(b"cookie", b"").split(b";"):
            name, _, value = part.strip().partition(b"=")
            if name == self._cookie_name.encode():
                return _same(value.decode("latin-1"), self._cookie)
        return False


def _same(given: str, known: str) -> bool:
    """Compare in a time that tells neither content nor length."""
    return hmac.compare_digest(_mac(given, b"compare"), _mac(known, b"compare"))


def _mac(key: str, text: bytes) -> bytes:
    return hmac.new(key.encode(), text, hashlib.sha256).digest()
