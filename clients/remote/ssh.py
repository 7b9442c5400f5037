"""The robot's end of a tunnel: its folder, its sockets and ssh's command line.

A server is written as `[USER@]NAME[:PORT]`; NAME may be a Host of `~/.ssh/config`, which then says
address, user and key. What makes a tunnel safe and fast is not left to that file: ssh takes the
first value that it meets, and meets the command line first. The module must not start anything.
"""

import re
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.remote import dial
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable
from vram_arbiter.schemas.runtime.endpoints import IPC, SYSTEM_RUNTIME, runtime_dir, socket_path

ARBITER: Final = "arbiter"
"""The name of its socket, beside those of the sidecars."""
FORWARDED: Final = "forwarded"
"""What ssh says when it is connected and listens (LocalCommand)."""
SCHEME: Final = "ssh://"
_NAME: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]*"
_HOST: Final = re.compile(rf"(?:{_NAME}@)?{_NAME}(?::([0-9]{{1,5}}))?")
_PATH: Final = re.compile(r"[\w/.,@+-]+", re.ASCII)
"""Without the characters that ssh reads in a forwarding: a colon, %, $, \\, a blank."""
_OPTIONS: Final[Mapping[str, object]] = {
    "BatchMode": "yes",  # it has no terminal to ask on
    "StrictHostKeyChecking": "yes",
    "GlobalKnownHostsFile": "/dev/null",
    "UpdateHostKeys": "no",
    "ExitOnForwardFailure": "yes",
    "StreamLocalBindUnlink": "yes",
    "StreamLocalBindMask": "0117",  # sockets of mode 0660, as those of the server
    "ServerAliveInterval": 1,
    "ServerAliveCountMax": 3,
    "ConnectTimeout": 10,
    "ControlPath": "none",  # another ssh's connection would be neither fast nor ours to end
    "Compression": "no",
    "LogLevel": "INFO",  # names the channels that the server refuses
    "PermitLocalCommand": "yes",
    "LocalCommand": f"echo {FORWARDED} >&2",
}


@dataclass(frozen=True, slots=True)
class Tunnel:
    """What is forwarded from a server: sockets by name, of its arbiter and of sidecars, and
    loopback ports of doors, here and there."""

    host: str
    folder: Path
    known_hosts: Path
    names: tuple[str, ...] = (ARBITER,)
    doors: tuple[tuple[int, int], ...] = ()
    server_runtime: str = SYSTEM_RUNTIME
    identity: Path | None = None

    def socket(self, name: str) -> Path:
        """Return the path of a forwarded socket on the robot."""
        return self.folder / f"{name}.sock"

    def command(self) -> list[str]:
        """Return ssh's command line. Raises ConfigError: a path that it would read otherwise, or
        one that is too long for a socket."""
        check_host(self.host)
        fast = shlex.join([sys.executable, "-IS", dial.__file__]).replace("%", "%%")
        own = {"ProxyCommand": f"{fast} %h %p", "UserKnownHostsFile": _plain(self.known_hosts)}
        words = ["ssh", "-Nax"]  # no command, no agent, no X11
        for option, value in {**_OPTIONS, **own}.items():
            words += ["-o", f"{option}={value}"]
        for name in self.names:
            ends = (self.socket(name), f"{self.server_runtime}/{name}.sock")
            words += ["-L", ":".join(_plain(socket_path(f"{IPC}{end}")) for end in ends)]
        for here, there in self.doors:
            words += ["-L", f"127.0.0.1:{here}:127.0.0.1:{there}"]
        if self.identity is not None:
            words += ["-o", "IdentitiesOnly=yes", "-i", str(self.identity)]
        return [*words, "--", f"{SCHEME}{self.host}"]


def check_host(host: str) -> None:
    """Raises ConfigError for what does not name a server."""
    found = _HOST.fullmatch(host)
    if found is None or not 0 < int(found[1] or 22) < 65536:
        raise ConfigError(
            f"expected a server as [USER@]NAME[:PORT], got {host!r}",
            hint="for anything else write a Host in ~/.ssh/config and name that",
        )


def tunnels_folder(environ: Mapping[str, str], uid: int) -> Path:
    """Return the folder that has one folder for each server. Raises ConfigError."""
    return Path(runtime_dir(environ, uid)) / "remote"


def folder_of(host: str, environ: Mapping[str, str], uid: int) -> Path:
    """Return the folder of a server's forwarded sockets. Raises ConfigError."""
    check_host(host)
    return tunnels_folder(environ, uid) / host.replace(":", ",")


def host_of(folder: Path) -> str:
    """Return the server whose folder this is."""
    return folder.name.replace(",", ":")


def forwarded(address: str, environ: Mapping[str, str], uid: int) -> tuple[str, str]:
    """Return the endpoints of a sidecar `ssh://HOST/NAME` and of the arbiter that has its lease.

    Raises ConfigError for another text, SidecarUnavailable where no tunnel forwards it now.
    """
    host, slash, name = address.removeprefix(SCHEME).partition("/")
    if not (address.startswith(SCHEME) and slash and re.fullmatch(_NAME, name)):
        raise ConfigError(f"expected ssh://HOST/NAME of a sidecar, got {address!r}")
    folder = folder_of(host, environ, uid)
    found = [f"{IPC}{folder}/{one}.sock" for one in (name, ARBITER)]
    if not all(map(is_listening, found)):
        raise SidecarUnavailable(
            f"no tunnel to {host} forwards {name}",
            hint=f"`vramctl remote up {host} {name}`; `vramctl remote status` shows the tunnels",
            details={"endpoint": found[0]},
        )
    return found[0], found[1]


def _plain(path: Path | str) -> str:
    if not _PATH.fullmatch(str(path)):
        raise ConfigError(f"ssh cannot be given the path {str(path)!r}", hint="choose a plain one")
    return str(path)
