"""Who asks, and what it may use: API keys in files that no other user can read."""

import hashlib
import hmac
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vram_arbiter.schemas.config.gateway import GatewayConfig, load_keys
from vram_arbiter.schemas.defaults import PRIORITY
from vram_arbiter.schemas.errors import ConfigError, KeyRefused

FILE_MAX_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Asker:
    """Who asks. `servers`: those it may use; None: all. `reserve`: of each server's `parallel`."""

    name: str = ""
    servers: frozenset[str] | None = None
    priority: int = PRIORITY
    reserve: int = 0

    def may_use(self, server: str) -> bool:
        return self.servers is None or server in self.servers


ANYONE: Final = Asker()


class Keys:
    """The keys by their digests. Empty: no key is asked for."""

    def __init__(self, askers: Mapping[bytes, Asker]) -> None:
        self._askers = askers

    def __bool__(self) -> bool:
        return bool(self._askers)

    def asker(self, authorization: str, api_key: str) -> Asker:
        """Return who shows this key in `Authorization: Bearer` or `x-api-key`. Raises KeyRefused.

        Each key is compared, in constant time.
        """
        if not self._askers:
            return ANYONE
        kind, _, token = authorization.partition(" ")
        shown = _digest(token.strip() if kind.lower() == "bearer" else api_key)
        found = [one for digest, one in self._askers.items() if hmac.compare_digest(digest, shown)]
        if not found:
            raise KeyRefused(
                "an API key is needed, and none or another one was shown",
                hint="Authorization: Bearer KEY, or x-api-key: KEY",
            )
        return found[0]

    def reserved(self, server: str) -> Mapping[str, int]:
        """Return how many requests of a server are kept for each key."""
        return {
            one.name: one.reserve
            for one in self._askers.values()
            if one.reserve and one.may_use(server)
        }


def read_keys(config: GatewayConfig) -> Keys:
    """Return the keys of a configuration. Raises ConfigError."""
    if config.keys_file is None:
        return Keys({})
    path = Path(config.keys_file)
    loaded = load_keys(private_text(path, "keys_file"), str(path))
    askers: dict[bytes, Asker] = {}
    for key in loaded.keys:
        unknown = sorted(set(key.servers or ()) - set(config.servers))
        if unknown:
            raise ConfigError(f"{path}: {key.name}: unknown server {', '.join(unknown)}")
        servers = None if key.servers is None else frozenset(key.servers)
        asker = Asker(key.name, servers, key.priority, key.reserve)
        askers[_digest(key.key.get_secret_value())] = asker
    keys = Keys(askers)
    for name, server in config.servers.items():
        reserved = sum(keys.reserved(name).values())
        if reserved >= server.parallel:
            raise ConfigError(
                f"{path}: {reserved} requests of {name} are reserved, and it serves "
                f"{server.parallel} at a time",
                hint="reserve less, or raise `parallel`",
            )
    return keys


def private_text(path: Path, what: str) -> str:
    """Return the text of a file that only its owner, this user or root, can read. Raises
    ConfigError."""
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno())
            text = file.read(FILE_MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{what}: {path} cannot be read: {error}") from error
    if stat.S_IMODE(found.st_mode) & 0o077 or found.st_uid not in (0, os.getuid()):
        raise ConfigError(
            f"{what}: other users may read {path}", hint=f"chmod 600 {path}, as the gateway's user"
        )
    return text


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode(errors="replace")).digest()
