"""Private folders and lock files of the servers: made or checked through descriptors, without
following links.

A server binds and writes only in a folder that no other user can exchange under it; a lock file is
never a link to another file. Clients make no folders. It must not know what the folders hold.
"""

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from vram_arbiter.schemas.errors import AlreadyRunning, ConfigError
from vram_arbiter.schemas.runtime.endpoints import runtime_dir
from vram_arbiter.schemas.runtime.trust import ROOT, trusts

CHOOSE: Final = "choose a folder that this program may write"
LEFT_MAX_BYTES: Final = 256
_FOLDER: Final = os.O_DIRECTORY | os.O_CLOEXEC


def socket_folder(
    folder: Path, environ: Mapping[str, str], group: int | None = None, *, shared: bool = False
) -> None:
    """Make or check the folder of a socket, as `private_folder` does. Only the runtime folder is
    made: a mistyped endpoint leaves no trace."""
    try:
        default = Path(runtime_dir(environ, os.getuid()))
    except ConfigError:
        default = None
    private_folder(
        folder, group, make=default is not None and folder == default.absolute(), shared=shared
    )


def private_folder(
    folder: Path, group: int | None = None, *, make: bool = True, shared: bool = False
) -> None:
    """Make the last component of `folder`, 0700, or 0750 with `group`; check a folder that exists.

    A folder that exists must belong to this user or root, if it is `shared` also to the arbiter's
    service user, and must not be writable by others (by a group only with the sticky bit, as the
    shared folder of the units). Raises ConfigError.
    """
    try:
        parent = os.open(folder.parent, _FOLDER | os.O_PATH)
    except OSError as error:
        raise ConfigError(f"{folder.parent}: {error.strerror}", hint=CHOOSE) from error
    try:
        made = make and _made(folder, parent)
        opened = _open_folder(folder, parent, shared=shared)
        try:
            if made and group is not None:
                os.fchown(opened, -1, group)
                os.fchmod(opened, 0o750)
        finally:
            os.close(opened)
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}", hint=CHOOSE) from error
    finally:
        os.close(parent)


def _made(folder: Path, parent: int) -> bool:
    try:
        os.mkdir(folder.name or ".", 0o700, dir_fd=parent)
    except FileExistsError:
        return False
    return True


def _open_folder(folder: Path, parent: int | None = None, *, shared: bool = True) -> int:
    """A descriptor of a folder that passed the checks of `private_folder`. Raises ConfigError,
    OSError."""
    path = folder if parent is None else Path(folder.name or ".")
    try:
        opened = os.open(path, _FOLDER | os.O_NOFOLLOW, dir_fd=parent)
    except OSError as error:
        if error.errno in (errno.ENOTDIR, errno.ELOOP):
            what = "is a link" if folder.is_symlink() else "is not a directory"
            raise ConfigError(f"{folder} {what}", hint="name the folder itself") from error
        raise
    try:
        if problem := _problem(os.fstat(opened), shared):
            raise ConfigError(f"{folder} {problem}", hint="use a folder of your own with mode 0700")
    except BaseException:
        os.close(opened)
        raise
    return opened


def _problem(found: os.stat_result, shared: bool) -> str:
    """Why other users could exchange the files of a folder; empty: they cannot."""
    own = found.st_uid in (os.geteuid(), ROOT)
    if not (own or (shared and trusts(found.st_uid, "arbiter"))):
        return f"belongs to uid {found.st_uid}"
    if found.st_mode & stat.S_IWOTH:
        return "may be written by every user"
    if found.st_mode & stat.S_IWGRP and not found.st_mode & stat.S_ISVTX:
        return f"may be written by every member of group {found.st_gid}"
    return ""


def _remove_foreign(name: str, folder: int) -> None:
    """Remove another user's file of this name from a folder of this user's own, where members of
    its group may add files: one of them must not keep the server from starting."""
    try:
        found = os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return
    if found.st_uid not in (os.geteuid(), ROOT) and os.fstat(folder).st_uid == os.geteuid():
        os.unlink(name, dir_fd=folder)


class LockFile:
    """One server per socket and per state folder: a lock file, held as long as the process lives.

    `acquire` once, `release` at the end (or by dying). The socket needs it because a bind would
    take an existing path over. The file stays: removing it would let two servers lock two files of
    one name. A dead server's lock is gone with it.
    """

    def __init__(self, path: Path, protects: str, holder: str = "an arbiter") -> None:
        self.path = path
        self._protects = protects
        self._holder = holder
        self._fd: int | None = None
        self.left = ""
        """What the last holder left for the next one (`leave`)."""

    def acquire(self) -> None:
        """Raises AlreadyRunning with the pid of the holder, ConfigError where the file cannot be
        made or must not be used."""
        fd = self._open(os.O_CREAT)
        assert fd is not None
        self._lock(fd)
        self._fd = fd
        content = os.pread(fd, LEFT_MAX_BYTES, 0).decode("ascii", "replace")
        self.leave(content.partition("\n")[2])

    def leave(self, text: str) -> None:
        """Keep a short text for the next holder, behind this one's pid."""
        assert self._fd is not None, "leave before acquire"
        self.left = text
        content = f"{os.getpid()}\n{text}".encode("ascii", "replace")[:LEFT_MAX_BYTES]
        # a full disk: the lock holds, only the pid for the other's message is missing
        with contextlib.suppress(OSError):
            os.pwrite(self._fd, content, 0)
            os.ftruncate(self._fd, len(content))

    def check_free(self) -> None:
        """Raise what `acquire` would raise because of another holder, without making the file or
        keeping the lock."""
        fd = self._open(0)
        if fd is not None:
            self._lock(fd)
            os.close(fd)

    def keep(self) -> bool:
        """Lock the file again where it was deleted or replaced, because a second server could lock
        the new one. Return whether it was. Raises as `acquire`: AlreadyRunning where one has."""
        assert self._fd is not None, "keep before acquire"
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(self._fd), self.path.lstat()):
                return False
        lost, left = self._fd, self.left
        self.acquire()
        self.leave(left)
        os.close(lost)
        return True

    def release(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _open(self, create: int) -> int | None:
        """None: the file, or its folder, is not there and must not be made."""
        flags = os.O_RDWR | create | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NOCTTY
        folder: int | None = None
        try:
            folder = _open_folder(self.path.parent)
            if create:
                _remove_foreign(self.path.name, folder)
            fd = os.open(self.path.name, flags, 0o640, dir_fd=folder)
        except FileNotFoundError as error:
            if not create:
                return None
            raise ConfigError(f"{self.path}: {error.strerror}", hint=CHOOSE) from error
        except OSError as error:
            what = "is a link" if error.errno == errno.ELOOP else error.strerror
            raise ConfigError(f"{self.path}: {what}", hint=CHOOSE) from error
        finally:
            if folder is not None:
                os.close(folder)
        found = os.fstat(fd)
        if (
            stat.S_ISREG(found.st_mode)
            and found.st_nlink == 1
            and found.st_uid in (os.geteuid(), ROOT)
        ):
            return fd
        os.close(fd)
        raise ConfigError(
            f"{self.path}: not a file of this user's own (uid {found.st_uid}, {found.st_nlink} "
            "names)",
            hint="remove it if its program does not run",
        )

    def _lock(self, fd: int) -> None:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = os.pread(fd, 32, 0).decode("ascii", "replace").partition("\n")[0].strip()
            os.close(fd)
            raise AlreadyRunning(
                f"{self._holder} (pid {text or 'unknown'}) already uses {self._protects}",
                hint="stop it first, or choose another endpoint and folder",
                details={"pid": int(text) if text.isdecimal() else None, "lock": str(self.path)},
            ) from error
