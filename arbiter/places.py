"""Where the daemon's socket and files are, and the folders and locks that make them its own.

Flags come first, then the configuration, then the environment. Must not know what the files hold.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.arbiter.host.journal import may_pass, unavailable
from vram_arbiter.schemas.config.arbiter import ArbiterConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint, runtime_dir, socket_path
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder, socket_folder


@dataclass(frozen=True, slots=True)
class Places:
    """Absolute paths of the daemon."""

    endpoint: str
    socket: Path
    runtime: Path
    state: Path


def find_places(config: ArbiterConfig, environ: Mapping[str, str], uid: int) -> Places:
    """Raises ConfigError for an endpoint that the daemon does not serve."""
    endpoint = config.wire.endpoint or arbiter_endpoint(environ, uid)
    socket = Path(socket_path(endpoint))
    try:
        runtime = Path(runtime_dir(environ, uid))
    except ConfigError:  # without a login session; then the endpoint was given
        runtime = socket.parent
    if config.state.dir is not None:
        state = Path(config.state.dir)
    elif under_systemd := environ.get("STATE_DIRECTORY"):
        state = Path(under_systemd.split(":")[0])
    elif config.gpu.source.startswith("fake:"):
        state = runtime / "state"  # a simulated GPU is as short-lived as the runtime folder
    else:
        home = environ.get("XDG_STATE_HOME") or str(
            Path(environ.get("HOME", "/")) / ".local" / "state"
        )
        state = Path(home) / "vram-arbiter"
    return Places(endpoint, socket, runtime.absolute(), state.absolute())


def take_folders(
    places: Places,
    config: ArbiterConfig,
    environ: Mapping[str, str],
    group: int | None,
    undo: contextlib.AsyncExitStack,
) -> tuple[LockFile, LockFile]:
    """Make or check the folders and lock them until `undo`. Return the locks of the socket and of
    the state folder.

    Raises ConfigError, AlreadyRunning, and JournalUnavailable where a later try may succeed.
    """
    if config.gpu.source.startswith("fake:") or places.state.parent == places.runtime:
        private_folder(places.runtime, group)
    socket_folder(places.socket.parent, environ, group)
    name = places.socket.name
    socket_lock = LockFile(places.socket.with_name(f"{name}.lock"), str(places.socket))
    socket_lock.acquire()
    undo.callback(socket_lock.release)
    try:
        if config.state.dir is None:  # such as ~/.local/state
            places.state.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        private_folder(places.state)
        lock = LockFile(places.state / "lock", str(places.state))
        lock.acquire()
        undo.callback(lock.release)
    except (ConfigError, OSError) as error:
        cause = error.__cause__ if isinstance(error, ConfigError) else error
        if cause is not None and may_pass(cause):  # a person need not start the daemon again
            raise unavailable(places.state, cause) from error
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"the state folder {places.state} cannot be made: {error}") from error
    return socket_lock, lock
