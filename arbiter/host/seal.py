"""Two small files beside the journal that say what its last commit was, so that a lost or changed
one is noticed at the next start.

`journal.seal` is rewritten around each commit, without fsync: it names the digest of all records.
Like the commit itself it survives the death of the daemon, and after a power cut nothing of it
matters. Before a commit it names the old and the new digest, after it the new one alone: a kill at
any instant leaves a journal that its seal accepts, a lost commit leaves one that it does not.
`epoch` is replaced once per start, with fsync: it names the epoch and the boot of the last start. A
copy of it in the socket's lock file (the witness) knows of a start that the state folder as a whole
has forgotten. Must not know what records are.
"""

import os
import secrets
import struct
import time
from dataclasses import dataclass
from hashlib import sha256
from io import FileIO
from pathlib import Path
from typing import Self

EPOCH_MAX = 1 << 62
"""Greater numbers are damage: tokens are 63-bit integers on the wire."""
_BEGINNING_S = 1_767_225_600  # 2026-01-01
_MAGIC = b"vaseal1\0"
_BODY = struct.Struct("<8sQ16s16s16s")
_EPOCH_FILE_MAX = 256


def digest(key: str, text: str) -> bytes:
    """Digest of one record. All records together have the exclusive or of theirs, so that one
    change costs one digest."""
    return sha256(f"{key}\0{text}".encode()).digest()[:16]


def fresh_epoch() -> int:
    """An epoch for a start that knows of no earlier one: seconds since 2026 and 16 random bits.

    The seconds let it grow, so that what was granted before a lost state folder counts as earlier.
    The random bits keep two starts apart that read the same second, as after a step of the clock. A
    clock that was never set counts from the boot.
    """
    seconds = max(time.time() - _BEGINNING_S, time.clock_gettime(time.CLOCK_BOOTTIME))
    return (int(seconds) << 16) | secrets.randbits(16)


def _of_boot(boot_id: str) -> bytes:
    return sha256(boot_id.encode()).digest()[:16]


@dataclass(frozen=True, slots=True)
class Sealed:
    """What a seal says. `accepts` holds one digest, or two where a commit was under way."""

    epoch: int
    boot: bytes
    accepts: frozenset[int]

    def is_of(self, boot_id: str) -> bool:
        return self.boot == _of_boot(boot_id)


class Seal:
    """The open file. `write` raises OSError; its caller says what that stops."""

    def __init__(self, file: FileIO, head: bytes) -> None:
        self._file = file
        self._fd = file.fileno()
        self._head = head

    @classmethod
    def open(cls, folder: Path, epoch: int, boot_id: str) -> Self:
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        file = FileIO(os.open(folder / "journal.seal", flags, 0o600), "r+")
        if os.fstat(file.fileno()).st_size > _BODY.size:
            file.truncate(_BODY.size)
        return cls(file, struct.pack("<8sQ16s", _MAGIC, epoch, _of_boot(boot_id)))

    @staticmethod
    def read(folder: Path) -> Sealed | None:
        """What the last daemon wrote; None where there is no file. Raises ValueError for one that
        says nothing."""
        try:
            with (folder / "journal.seal").open("rb") as file:
                content = file.read(_BODY.size + 1)
        except FileNotFoundError:
            return None
        if len(content) != _BODY.size:
            raise ValueError(f"its seal has {len(content)} bytes instead of {_BODY.size}")
        magic, epoch, boot, now, soon = _BODY.unpack(content)
        if magic != _MAGIC or epoch > EPOCH_MAX:
            raise ValueError("its seal is damaged or not of this version")
        return Sealed(epoch, boot, frozenset((int.from_bytes(now), int.from_bytes(soon))))

    def write(self, now: int, soon: int) -> None:
        """Accept a journal with either digest from now on."""
        if os.pwrite(self._fd, self._head + (now << 128 | soon).to_bytes(32), 0) != _BODY.size:
            raise OSError("the seal was written in part")

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True, slots=True)
class LastStart:
    """The epoch file. `boot` is "" in a file of an earlier version."""

    epoch: int
    boot: str

    def text(self) -> str:
        return f"{self.epoch}\n{self.boot}\n"


def last_start(text: str) -> LastStart:
    """The inverse of `LastStart.text`. Raises ValueError for what cannot be true."""
    number, _, rest = text.partition("\n")
    if len(text) > _EPOCH_FILE_MAX or not number.isdecimal() or len(number) > 19:
        raise ValueError(f"the epoch file does not hold an epoch but {number[:40]!r}")
    if int(number) > EPOCH_MAX:
        raise ValueError(f"the epoch file says {number}, more than {EPOCH_MAX}")
    return LastStart(int(number), rest.strip())


def read_last_start(folder: Path) -> LastStart | None:
    """What the last start wrote; None where there is no file. Raises ValueError for one that cannot
    be true."""
    try:
        with (folder / "epoch").open("rb") as file:
            content = file.read(_EPOCH_FILE_MAX + 1)
    except FileNotFoundError:
        return None
    return last_start(content.decode("ascii", "replace"))


def write_last_start(folder: Path, start: LastStart) -> None:
    """Replace the epoch file, durably."""
    temporary = folder / "epoch.tmp"
    with temporary.open("w") as file:
        file.write(start.text())
        file.flush()
        os.fsync(file.fileno())
    temporary.rename(folder / "epoch")
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
