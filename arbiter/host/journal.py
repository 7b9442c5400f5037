"""What must survive the daemon: one record per lease and residue, in SQLite.

Records are written before a grant is sent. WAL with `synchronous=NORMAL` does not fsync each commit: a commit survives the death of the
daemon (it is in the kernel's page cache) but perhaps not a power cut, and that is enough, since a power cut empties the GPU too: a new
boot id voids every record. Only the epoch must never go back, so it also lies in a file of its own, fsynced once per start. A corrupt
database is put aside and reported, never repaired by guessing. Must not know what the records mean.
"""

import errno
import json
import logging
import os
import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self

from schemas.errors import ConfigError, JournalUnavailable

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1
_SCHEMA = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS records (key TEXT PRIMARY KEY, json TEXT NOT NULL) WITHOUT ROWID;
"""


AT_ONCE_MAX = 8
"""Changes of one kind that are written by one statement."""
_PUT = [
    "",
    *(
        f"INSERT OR REPLACE INTO records VALUES {', '.join(['(?, ?)'] * n)}"
        for n in range(1, AT_ONCE_MAX + 1)
    ),
]
_DELETE = [
    "",
    *(f"DELETE FROM records WHERE key IN ({', '.join('?' * n)})" for n in range(1, AT_ONCE_MAX + 1)),
]
_text = json.JSONEncoder(separators=(",", ":")).encode


@dataclass(frozen=True, slots=True)
class Opened:
    """What a start found. `put_aside` names the corrupt file that was moved away; `voided` counts records of an earlier boot.
    `learnt` is what `keep` wrote last under that name, whatever the boot, and so are `footprints`."""

    epoch: int
    records: Mapping[str, Mapping[str, Any]]
    put_aside: Path | None = None
    problem: str = ""
    voided: int = 0
    learnt: Mapping[str, dict[str, float]] = field(default_factory=dict)
    footprints: Mapping[str, dict[str, list[int]]] = field(default_factory=dict)


class Journal:
    """One connection, used by one thread. `open` makes it; the database stays locked against a second daemon's writes by the
    daemon's own lock file, not here."""

    def __init__(self, path: Path, boot_id: str, connection: sqlite3.Connection, opened: Opened) -> None:
        self._path = path
        self._boot_id = boot_id
        self._connection = connection
        self._kept: dict[str, str] = {}  # what `keep` wrote last
        self.problem = ""
        self.opened = opened

    @classmethod
    def open(cls, folder: Path, boot_id: str, *, wall_s: float | None = None) -> Self:
        """Open or make the journal in `folder`, and count a new epoch. Raises ConfigError if the folder cannot be written,
        JournalUnavailable if its disk is full or failing: without a durable epoch tokens could be given out twice.

        1. Read; corrupt: put aside, start empty. 2. Another boot id: drop the records. 3. Epoch = 1 + the greatest known.
        """
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            path = folder / "journal.sqlite"
            put_aside, problem = None, ""
            try:
                connection = _connect(path)
                meta, records = _read(connection)  # 1
            except (sqlite3.DatabaseError, ValueError) as error:
                if isinstance(error, sqlite3.OperationalError) and not _is_corruption(error):
                    raise
                problem = str(error)
                put_aside = _put_aside(path)
                log.error("journal corrupt (%s): put aside as %s", problem, put_aside)
                connection = _connect(path)
                meta, records = _read(connection)
            voided = 0
            if meta.get("boot_id") not in (None, boot_id):  # 2
                voided, records = len(records), {}
            wall_s = time.time() if wall_s is None else wall_s
            epoch = _next_epoch(folder, meta, put_aside is not None, wall_s)  # 3
            _write_meta(connection, boot_id, epoch, drop_records=voided > 0)
        except (OSError, sqlite3.OperationalError) as error:
            if _is_disk(error):
                raise JournalUnavailable(
                    f"the disk of the state folder {folder} is full or failing: {error}",
                    hint="make room on it, or choose another --state-dir",
                ) from error
            raise ConfigError(
                f"the state folder {folder} cannot be used: {error}",
                hint="make it writable, or choose another --state-dir",
            ) from error
        return cls(
            path,
            boot_id,
            connection,
            Opened(epoch, records, put_aside, problem, voided, _learnt(meta), _footprints(meta)),
        )

    def put_aside(self, problem: str) -> None:
        """The database is sound but nobody understands its records: start with an empty one, in the same epoch."""
        self._connection.close()
        aside = _put_aside(self._path)
        log.error("journal not understood (%s): put aside as %s", problem, aside)
        self._connection = _connect(self._path)
        _write_meta(self._connection, self._boot_id, self.opened.epoch, drop_records=False)
        self.opened = replace(self.opened, records={}, put_aside=aside, problem=problem)

    def apply(self, changes: Sequence[tuple[str, Mapping[str, Any] | None]]) -> None:
        """Write all changes in one transaction; None deletes. Raises JournalUnavailable (nothing is written then)."""
        written = self._connection.total_changes
        try:
            if len(changes) <= AT_ONCE_MAX and len({record is None for _, record in changes}) == 1:
                self._change_at_once(changes)
            else:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    for change in changes:
                        self._change_at_once([change])
        except sqlite3.Error as error:
            self.problem = (
                f"the journal cannot be written ({error}): what is held stays, nothing new is granted"
            )
            raise JournalUnavailable(
                f"the journal cannot be written: {error}", hint="see the disk of the daemon's state folder"
            ) from error
        if self._connection.total_changes > written:  # else nothing was written, which a full disk allows
            self.problem = ""

    def settle(self) -> None:
        """After a failure: can it be written again? Asked now and then, so that room on the disk is noticed without a request."""
        if self.problem:
            try:
                self._connection.execute("INSERT OR REPLACE INTO meta VALUES ('settled', hex(randomblob(8)))")
            except sqlite3.Error as error:
                log.debug("journal: %s", error)
            else:
                self.problem = ""

    def _change_at_once(self, changes: Sequence[tuple[str, Mapping[str, Any] | None]]) -> None:
        """All puts or all deletions, in one statement: a statement alone is a transaction, and half the price of one around it."""
        values: list[str] = []
        for key, record in changes:
            values.append(key)
            if record is not None:
                values.append(_text(record))
        what = _PUT if len(values) > len(changes) else _DELETE
        self._connection.execute(what[len(changes)], values)

    def keep(self, name: Literal["learnt", "footprints"], learnt: Mapping[str, Mapping[str, Any]]) -> None:
        """Keep what was learnt for the next start. Losing it costs estimates only: a failure is logged."""
        text = json.dumps(learnt, separators=(",", ":"))
        if text == self._kept.get(name):
            return
        self._kept[name] = text
        try:
            self._connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (name, text))
        except sqlite3.Error as error:
            log.warning("what was learnt cannot be kept: %s", error)

    def close(self) -> None:
        self._connection.close()


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, timeout=0.1)
    try:
        path.chmod(0o600)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")
        connection.executescript(_SCHEMA)
    except BaseException:
        connection.close()
        raise
    return connection


def _write_meta(connection: sqlite3.Connection, boot_id: str, epoch: int, *, drop_records: bool) -> None:
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        if drop_records:
            connection.execute("DELETE FROM records")
        values = {"schema": str(SCHEMA_VERSION), "boot_id": boot_id, "epoch": str(epoch)}
        connection.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())


def _read(connection: sqlite3.Connection) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    """(meta, records). Raises sqlite3.DatabaseError or ValueError for what cannot be trusted."""
    try:
        check = connection.execute("PRAGMA quick_check").fetchone()[0]
        if check != "ok":
            raise sqlite3.DatabaseError(f"quick_check says {check}")
        meta = dict(connection.execute("SELECT name, value FROM meta"))
        if meta.get("schema") not in (None, str(SCHEMA_VERSION)):
            raise sqlite3.DatabaseError(f"schema {meta['schema']}, this daemon knows {SCHEMA_VERSION}")
        records = {}
        for key, text in connection.execute("SELECT key, json FROM records ORDER BY key"):
            record = json.loads(text)
            if not isinstance(record, dict):
                raise ValueError(f"record {key} is no map")
            records[key] = record
    except BaseException:
        connection.close()
        raise
    return meta, records


def _learnt(meta: Mapping[str, str]) -> dict[str, dict[str, float]]:
    """Durations that `keep` wrote; anything else counts as nothing learnt."""
    try:
        found = json.loads(meta.get("learnt", "{}"))
        return {str(who): {str(what): float(s) for what, s in each.items()} for who, each in found.items()}
    except (ValueError, TypeError, AttributeError):
        return {}


def _footprints(meta: Mapping[str, str]) -> dict[str, dict[str, list[int]]]:
    """Byte counts that `keep` wrote; anything else counts as nothing learnt."""
    try:
        found = json.loads(meta.get("footprints", "{}"))
        return {
            str(model): {str(part): [int(count) for count in counts] for part, counts in parts.items()}
            for model, parts in found.items()
        }
    except (ValueError, TypeError, AttributeError):
        return {}


def _is_corruption(error: sqlite3.OperationalError) -> bool:
    """Read-only, locked or full is the machine's trouble; a wrong or half schema is the file's."""
    return error.sqlite_errorcode & 0xFF in (
        sqlite3.SQLITE_ERROR,
        sqlite3.SQLITE_CORRUPT,
        sqlite3.SQLITE_NOTADB,
    )


def _is_disk(error: OSError | sqlite3.OperationalError) -> bool:
    """Trouble that may be over soon, unlike a wrong folder."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
    return error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR)


def _put_aside(path: Path) -> Path:
    """Move the database and its WAL away under the first free name, so that nothing is lost for whoever wants to look."""
    number = 1
    while (aside := path.with_name(f"{path.name}.corrupt-{number}")).exists():
        number += 1
    path.rename(aside)
    for suffix in ("-wal", "-shm"):
        beside = path.with_name(path.name + suffix)
        if beside.exists():
            beside.rename(aside.with_name(aside.name + suffix))
    return aside


def _next_epoch(folder: Path, meta: Mapping[str, str], corrupt: bool, wall_s: float) -> int:
    """Greater than every epoch before, also if one of its two places was lost, and if both were (minutes since 1970)."""
    path = folder / "epoch"
    known = [int(meta["epoch"])] if meta.get("epoch", "").isdecimal() else []
    try:
        text = path.read_text(errors="replace").strip()
        known += [int(text)] if text.isdecimal() else []
    except FileNotFoundError:
        pass
    if not known and corrupt:
        known = [int(wall_s // 60)]
    epoch = max(known, default=0) + 1
    temporary = folder / "epoch.tmp"
    with temporary.open("w") as file:
        file.write(f"{epoch}\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.rename(path)
    return epoch
