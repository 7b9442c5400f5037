"""Doors of a sidecar: protocols of other projects, at a port of 127.0.0.1.

A door is a client of sidecars, as any other program: a request at it is a request at their sockets,
and a use of their leases there. It serves a unix socket beside the sidecar's, with `sidecars.port`
in front of it, which bounds connections and knows users. What a door's protocol needs is imported
when it is opened.
"""

import contextlib
import gc
import re
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from vram_arbiter.clients.net.server import path_of
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.heap import give_back_freed_memory
from vram_arbiter.sidecars.port import Conduct, on_port

type Protocol = Literal["lerobot", "openpi"]
PACKAGES: Final = {"lerobot": ("grpc", "google.protobuf", "lerobot"), "openpi": ("aiohttp",)}
CONNECTIONS_MAX: Final = 16
"""Of a door: each may hold a few observations of 16 MiB."""
_LOOPBACK: Final = re.compile(r"(?:127\.0\.0\.1|localhost):([0-9]{1,5})")


@dataclass(frozen=True, slots=True)
class Door:
    """One door. `offered`: endpoints of other sidecars that its clients may choose; `keys`: one of
    them has to be sent, if there are any."""

    protocol: Protocol
    port: int
    offered: tuple[str, ...] = ()
    keys: tuple[bytes, ...] = ()

    def check(self, manifest: RSkillManifest) -> None:
        """Raise ConfigError for a model that the protocol has no words for."""
        if manifest.kind is not Kind.VLA:
            raise ConfigError(
                f"{manifest.name} is a {manifest.kind}, --door {self.protocol} serves policies",
                hint="leave out --door",
            )


def door_of(
    protocol: Protocol, listen: str | None, offered: tuple[str, ...], keys: Path | None
) -> Door:
    """Return the door that the flags describe. Raises ConfigError."""
    found = _LOOPBACK.fullmatch(listen or "")
    if found is None or not 0 < int(found[1]) < 65_536:
        raise ConfigError(
            f"--door needs --listen 127.0.0.1:PORT, not {listen}",
            hint="a robot of another machine comes through ssh -L PORT:127.0.0.1:PORT",
        )
    if (offered and protocol != "lerobot") or (keys is not None and protocol != "openpi"):
        raise ConfigError(
            f"--door {protocol} has no {'choice of policies' if offered else 'API keys'}",
            hint="--offer is for lerobot, --door-keys is for openpi",
        )
    need(f"--door {protocol}", *PACKAGES[protocol], extra="doors")
    return Door(protocol, int(found[1]), offered, _keys_of(keys) if keys is not None else ())


def _keys_of(file: Path) -> tuple[bytes, ...]:
    """Return the API keys of a file, one a line. Raises ConfigError."""
    try:
        keys = tuple(line.strip() for line in file.read_bytes().splitlines() if line.strip())
    except OSError as error:
        raise ConfigError(
            f"the keys of {file} cannot be read: {error.strerror}", hint="see --door-keys"
        ) from error
    if not keys:
        raise ConfigError(f"{file} has no key", hint="write one a line, or leave out --door-keys")
    return keys


@contextlib.asynccontextmanager
async def opened(
    door: Door, manifest: RSkillManifest, endpoint: str, timeout_s: float
) -> AsyncIterator[None]:
    """Open a door to the sidecar at `endpoint` within the block. `timeout_s`: of one answer.

    Raises ConfigError for a port that cannot be had.
    """
    from vram_arbiter.sidecars.doors.offers import Offers

    give_back_freed_memory()
    path = path_of(endpoint).with_suffix(f".{door.protocol}")
    path.unlink(missing_ok=True)  # of a process that was killed: the endpoint is ours alone
    offers, conduct = Offers((endpoint, *door.offered), timeout_s), Conduct()
    async with contextlib.AsyncExitStack() as stack:
        stack.callback(path.unlink, missing_ok=True)
        stack.push_async_callback(offers.close)
        if door.protocol == "lerobot":
            from vram_arbiter.sidecars.doors import lerobot_async

            await stack.enter_async_context(lerobot_async.served(path, offers, conduct))
        else:
            from vram_arbiter.sidecars.doors import openpi

            served = openpi.OpenpiDoor(offers.clients[0], manifest, door.keys, conduct)
            await stack.enter_async_context(openpi.served(path, served))
        path.chmod(0o660)
        await stack.enter_async_context(on_port(door.port, path, CONNECTIONS_MAX, conduct))
        gc.freeze()  # modules stay: no collection, which delays all robots, looks at them again
        yield
