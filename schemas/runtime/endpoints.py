"""Where the sockets are, and what may be an endpoint. Callers pass their environment in; nothing is
made here."""

import os
import re
import stat
from collections.abc import Mapping

from vram_arbiter.schemas.errors import ConfigError

ENDPOINT_VARIABLE = "VRAM_ARBITER_ENDPOINT"
RUNTIME_VARIABLE = "VRAM_ARBITER_RUNTIME"
SYSTEM_RUNTIME = "/run/vram-arbiter"  # of the units in configs/systemd/system
IPC = "ipc://"
PATH_MAX_BYTES = 107  # sockaddr_un, less the final NUL
EXAMPLE = f"{IPC}{SYSTEM_RUNTIME}/arbiter.sock"


def runtime_dir(environ: Mapping[str, str], uid: int, sessions: str = "/run/user") -> str:
    """Folder of all sockets: explicit, under systemd, of the login session, or for root the
    system's.

    Never a folder below /tmp: any user could make one of a name that can be foreseen, and serve
    there. Raises ConfigError where none of them exists.
    """
    if explicit := environ.get(RUNTIME_VARIABLE):
        return explicit
    if under_systemd := environ.get("RUNTIME_DIRECTORY"):
        return under_systemd.split(":")[0]  # systemd joins several directories with colons
    if session := environ.get("XDG_RUNTIME_DIR"):
        return f"{session}/vram-arbiter"
    if _is_folder_of(f"{sessions}/{uid}", uid):
        return f"{sessions}/{uid}/vram-arbiter"
    if uid == 0:
        return SYSTEM_RUNTIME
    raise ConfigError(
        f"no folder for sockets: XDG_RUNTIME_DIR is not set and there is no {sessions}/{uid}",
        hint=f"log in with a session, or set {RUNTIME_VARIABLE} to a folder of your own, such as "
        "~/.vram-arbiter",
    )


def _is_folder_of(path: str, uid: int) -> bool:
    try:
        found = os.lstat(path)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == uid


def arbiter_endpoint(environ: Mapping[str, str], uid: int) -> str:
    """Endpoint of the arbiter: `VRAM_ARBITER_ENDPOINT`, else `arbiter.sock` in the runtime folder.
    Raises ConfigError."""
    return environ.get(ENDPOINT_VARIABLE) or program_endpoint("arbiter", environ, uid)


def sidecar_name(rskill_id: str) -> str:
    """Name of a skill's sidecar where none is given: `OWNER/so101-grab` → `grab`."""
    repository = rskill_id.rpartition("/")[2]
    _, dash, rest = repository.partition("-")
    return rest if dash else repository


def program_endpoint(name: str, environ: Mapping[str, str], uid: int) -> str:
    """Endpoint of a sidecar or of the runner, by its name: `ipc://<runtime>/<name>.sock`. Raises
    ConfigError."""
    return f"{IPC}{runtime_dir(environ, uid)}/{name}.sock"


def check_endpoint(endpoint: str) -> str:
    """The endpoint itself if it may be served and connected to. Raises ValueError that says what to
    write instead."""
    scheme, separator, path = endpoint.partition("://")
    if not separator or scheme not in ("ipc", "tcp"):
        raise ValueError(f"{endpoint!r} is not an endpoint; write {EXAMPLE}")
    if scheme == "tcp":
        raise ValueError(
            "tcp:// is refused: without CURVE keys any user of the machine could connect, take "
            "leases, drive a robot and stop it; "
            "write ipc://PATH"
        )
    if path.startswith("@"):
        raise ValueError(
            f"{endpoint} is refused: abstract sockets have no permissions, any user could connect "
            "or serve there; "
            "write ipc://PATH"
        )
    if not path.startswith("/"):
        raise ValueError(
            f"an ipc:// endpoint needs an absolute path, not {path!r}; write {EXAMPLE}"
        )
    if "\0" in path:
        raise ValueError(f"a socket path cannot contain NUL: {path!r}; write {EXAMPLE}")
    size = len(os.fsencode(path))
    if size > PATH_MAX_BYTES:
        raise ValueError(
            f"the socket path has {size} bytes, Linux allows {PATH_MAX_BYTES}; choose a shorter "
            "folder"
        )
    return endpoint


def loopback_port(endpoint: str) -> int | None:
    """The port of `tcp://127.0.0.1:PORT`, where only a server of the field is asked; None for any
    other endpoint."""
    found = re.fullmatch(r"tcp://(?:127\.0\.0\.1|localhost):([0-9]{1,5})", endpoint)
    port = int(found[1]) if found else 0
    return port if 0 < port < 65536 else None


def socket_path(endpoint: str) -> str:
    """The path of an endpoint. Raises ConfigError for one that may neither be served nor connected
    to."""
    try:
        return check_endpoint(endpoint).removeprefix(IPC)
    except ValueError as error:
        message, _, hint = str(error).rpartition("; ")
        raise ConfigError(message, hint=hint, details={"endpoint": endpoint}) from error
