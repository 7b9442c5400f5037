"""One daemon per socket and per state folder: a lock file, held as long as the process lives.

The socket needs it because libzmq silently takes over an existing socket path at bind. The file stays: removing it would let two
daemons lock two files of one name. A dead daemon's lock is gone with it. Must not know what is being protected.
"""

import contextlib
import fcntl
import os
from pathlib import Path

from schemas.errors import AlreadyRunning, ConfigError


class LockFile:
    """`acquire` once, `release` at the end (or by dying)."""

    def __init__(self, path: Path, protects: str) -> None:
        self._path = path
        self._protects = protects
        self._fd: int | None = None

    def acquire(self) -> None:
        """Raises AlreadyRunning with the pid of the holder, ConfigError where the file cannot be made."""
        try:
            fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o640)
        except OSError as error:
            raise ConfigError(
                f"{self._path}: {error.strerror}", hint="choose a folder that the daemon may write"
            ) from error
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = os.read(fd, 32).decode("ascii", "replace").strip()
            os.close(fd)
            raise AlreadyRunning(
                f"an arbiter (pid {text or 'unknown'}) already uses {self._protects}",
                hint="stop it first, or give this one another --endpoint and --state-dir",
                details={"pid": int(text) if text.isdecimal() else None, "lock": str(self._path)},
            ) from error
        self._fd = fd
        # a full disk: the lock holds, only the pid for the other's message is missing
        with contextlib.suppress(OSError):
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
