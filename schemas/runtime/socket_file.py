"""File of a server's unix socket: made with its mode, made again where it was deleted, removed.

The caller holds the lock file, so a socket that is in the way is a leftover.
"""

import errno
import logging
import os
import socket
import stat
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError

log = logging.getLogger(__name__)

LISTEN_BACKLOG = 512


class SocketFile:
    """The file at `path`, of `group` if one is given."""

    def __init__(self, path: Path, group: int | None) -> None:
        self._path = path
        self._group = group
        self._inode: tuple[int, int] | None = None

    def bind(self) -> socket.socket:
        """Return a listener whose file has mode 0660 from the first instant. Raises ConfigError."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.setblocking(False)
            # the socket's own mode is what its file gets, less the umask: no moment with a wider
            # one
            os.fchmod(listener.fileno(), 0o660)
            self._remove_stale()
            listener.bind(str(self._path))
            os.chmod(self._path, 0o660)
            if self._group is not None:
                os.chown(self._path, -1, self._group)
            listener.listen(LISTEN_BACKLOG)
            found = os.lstat(self._path)
        except OSError as error:
            listener.close()
            reason = error.strerror or str(error)
            raise ConfigError(
                f"cannot bind ipc://{self._path}: {reason}", hint="choose another endpoint"
            ) from error
        self._inode = found.st_dev, found.st_ino
        return listener

    def bind_again(self) -> socket.socket | None:
        """Return a new listener where the file was deleted; None if it exists or cannot be made."""
        if self._is_ours():
            return None
        if os.path.lexists(self._path):
            log.error("another file is at %s: clients cannot reach this server", self._path)
            return None
        try:
            listener = self.bind()
        except ConfigError as error:
            log.error("the socket's file was deleted and cannot be created again: %s", error)
            return None
        log.warning("the socket's file %s was deleted; bound again", self._path)
        return listener

    def remove(self) -> None:
        """Remove the file, unless another one is in its place."""
        if self._is_ours():
            self._path.unlink(missing_ok=True)

    def _remove_stale(self) -> None:
        try:
            mode = os.lstat(self._path).st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISSOCK(mode):
            raise OSError(errno.EEXIST, "a file that is not a socket is in the way")
        self._path.unlink()

    def _is_ours(self) -> bool:
        try:
            found = os.lstat(self._path)
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._inode
