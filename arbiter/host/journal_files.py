"""What lies in the state folder when the daemon starts: the journal's database, its seal and the
epoch file, read and judged.

Damage is put aside under a name of its own and reported; `doubt` says why leases of this boot may
be missing among what is left. Decides nothing that outlives the start, and must not know what
records mean.
"""

import contextlib
import json
import logging
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vram_arbiter.arbiter.host.seal import (
    EPOCH_MAX,
    LastStart,
    Seal,
    Sealed,
    digest,
    last_start,
    read_last_start,
)
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.plain import JsonMap, JsonObject

log = logging.getLogger(__name__)

SCHEMA_VERSION = 2
"""1, of version 0.1: rows without a digest. It is put aside: its clients could not reattach."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS records
    (key TEXT PRIMARY KEY, json TEXT NOT NULL, digest BLOB) WITHOUT ROWID;
"""
RECORD_MAX_CHARS = 1 << 25
"""A lease with every use that a configuration may allow has 13 MB."""

Check = Callable[[str, JsonMap], object]
"""(key, record) → ValueError that says why it cannot be read."""


@dataclass(slots=True)
class Found:
    """What lies in the state folder, before anything is decided. `epoch` is the greatest one that
    any file names."""

    connection: sqlite3.Connection
    meta: dict[str, str] = field(default_factory=dict)
    records: dict[str, JsonObject] = field(default_factory=dict)
    digests: dict[str, int] = field(default_factory=dict)
    total: int = 0  # of the rows as they are, damaged ones too
    # key of a row that cannot be used → why
    damaged: dict[bytes, str] = field(default_factory=dict)
    seal: Sealed | None = None
    seal_problem: str = ""
    last: LastStart | None = None
    forgotten: LastStart | None = None  # a later start than the folder knows of
    unread: str = ""  # why the database as a whole was put aside
    put_aside: Path | None = None
    problems: list[str] = field(default_factory=list)
    epoch: int = 0

    def void(self, boot_id: str) -> int | None:
        """Drop the records if they are of another boot. Returns how many there were; None: they are
        of this boot."""
        if self.meta.get("boot_id") in (None, boot_id):
            return None
        count = len(self.records) + len(self.damaged)
        self.records, self.digests, self.damaged, self.total = {}, {}, {}, 0
        return count


def look(folder: Path, check: Check | None, witness: str) -> Found:
    """Read all files, and `witness`: a text of `LastStart` from outside of the folder, or anything
    else. A database, an epoch file or rows that cannot be read are put aside."""
    path = folder / "journal.sqlite"
    try:
        found = _read(Found(connect(path)), check)
    except (sqlite3.DatabaseError, ValueError) as error:
        if isinstance(error, sqlite3.OperationalError) and not is_corruption(error):
            raise
        aside = put_aside(path)
        log.error("journal corrupt (%s): put aside as %s", error, aside)
        found = _read(Found(connect(path)), check)
        found.unread, found.put_aside = str(error), aside
        found.problems.append(f"the journal was not readable and was put aside as {aside}")
    try:
        found.seal = Seal.read(folder)
    except ValueError as error:
        found.seal_problem = str(error)
    try:
        found.last = read_last_start(folder)
    except ValueError as error:
        aside = put_aside(folder / "epoch")
        found.problems.append(f"{error}: it was put aside as {aside}")
        log.error("%s: put aside as %s", error, aside)
    number = found.meta.get("epoch", "")
    known = [int(number)] if number.isdecimal() and len(number) <= 19 else []
    known += [] if found.seal is None else [found.seal.epoch]
    known += [] if found.last is None else [found.last.epoch]
    found.epoch = max((epoch for epoch in known if epoch <= EPOCH_MAX), default=0)
    with contextlib.suppress(ValueError):
        if (told := last_start(witness)).epoch > found.epoch:
            found.forgotten = told
            found.epoch = told.epoch
    return found


def doubt_of(found: Found, boot_id: str) -> str:
    """Why leases of this boot may be missing among the records; "" if what is there is what was
    written last."""
    if found.forgotten is not None and found.forgotten.boot == boot_id:
        return "the state folder is older than the last start at this socket"
    seal, last, meta_boot = found.seal, found.last, found.meta.get("boot_id")
    sealed_here = seal is not None and seal.is_of(boot_id)
    if not sealed_here and meta_boot != boot_id and (last is None or last.boot != boot_id):
        # No file is of this boot. One that names another boot shows that nothing was granted since,
        # whatever a power cut left in the others: the epoch file is fsynced, the seal is not. A
        # folder without any file is new.
        sound = not found.seal_problem and not found.unread
        new = sound and last is None and meta_boot is None and not found.total
        if (last is not None and last.boot) or seal is not None or (sound and meta_boot) or new:
            return ""
    if found.unread:
        return f"it could not be read: {found.unread}"
    if seal is None:
        return found.seal_problem or "its seal is missing"
    if not sealed_here:
        return "its seal is of an earlier boot"
    if last is not None and last.epoch > seal.epoch:
        return "its seal is older than the last start"
    if found.total not in seal.accepts:
        return "its records are not the ones that were written last"
    if found.damaged:
        return f"{len(found.damaged)} of its records cannot be used"
    return ""


def _read(found: Found, check: Check | None) -> Found:
    """Fill in meta, records and damaged rows. Raises sqlite3.DatabaseError or ValueError for a file
    that cannot be trusted."""
    connection = found.connection
    try:
        state = connection.execute("PRAGMA quick_check").fetchone()[0]
        if state != b"ok":
            raise sqlite3.DatabaseError(f"quick_check says {_decoded(state)}")
        rows = connection.execute("SELECT name, value FROM meta")
        found.meta = {_decoded(name): _decoded(value) for name, value in rows}
        schema = found.meta.get("schema")
        if schema not in (None, str(SCHEMA_VERSION)):
            raise sqlite3.DatabaseError(f"schema {schema}, this daemon knows {SCHEMA_VERSION}")
        rows = connection.execute(
            "SELECT CAST(key AS BLOB), CASE WHEN length(json) <= ? THEN json END, digest FROM "
            "records ORDER BY key",
            (RECORD_MAX_CHARS,),
        )
        for key, content, told in rows:
            try:
                _take(found, key.decode(), content, told, check)
            except ValueError as error:
                found.damaged[key] = str(error)
    except BaseException:
        connection.close()
        raise
    return found


def _take(found: Found, key: str, content: object, told: object, check: Check | None) -> None:
    """One row. Raises ValueError for a damaged one."""
    if not isinstance(content, bytes):
        raise ValueError(f"longer than {RECORD_MAX_CHARS} characters, or not a text")
    text = content.decode()
    own = digest(key, text)
    found.total ^= int.from_bytes(own)
    if told != own:
        raise ValueError("its digest is not that of its text")
    record = strictjson.loads(text, max_chars=RECORD_MAX_CHARS)
    if not isinstance(record, dict):
        raise ValueError("not a map")
    if check is not None:
        check(key, record)
    found.records[key] = record
    found.digests[key] = int.from_bytes(own)


def total_of(digests: Mapping[str, int]) -> int:
    total = 0
    for own in digests.values():
        total ^= own
    return total


def _decoded(value: object) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, timeout=0.1)
    connection.text_factory = bytes  # damage need not be UTF-8
    try:
        path.chmod(0o600)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")
        connection.executescript(_SCHEMA)
    except BaseException:
        connection.close()
        raise
    return connection


def is_corruption(error: sqlite3.OperationalError) -> bool:
    """Read-only, locked or full is the machine's trouble; a wrong or half schema is the file's."""
    return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF in (
        sqlite3.SQLITE_ERROR,
        sqlite3.SQLITE_CORRUPT,
        sqlite3.SQLITE_NOTADB,
    )


def _free_name(path: Path, kind: str = "") -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}{kind}.corrupt-{number}")).exists():
        number += 1
    return aside


def put_aside(path: Path) -> Path:
    """Move a file, and the WAL of a database, away under the first free name, so that it can be
    looked at."""
    aside = _free_name(path)
    path.rename(aside)
    for suffix in ("-wal", "-shm"):
        beside = path.with_name(path.name + suffix)
        if beside.exists():
            beside.rename(aside.with_name(aside.name + suffix))
    return aside


def put_rows_aside(folder: Path, found: Found) -> None:
    """Write damaged rows to a file of their own, a line each. They leave the database with the
    doubt that they raise."""
    aside = _free_name(folder / "journal", ".records")
    lines = []
    for key, problem in found.damaged.items():
        row = found.connection.execute(
            "SELECT substr(CAST(json AS BLOB), 1, 65536) FROM records WHERE CAST(key AS BLOB) = ?",
            (key,),
        ).fetchone()
        text = _decoded(row[0] if row else b"")
        lines.append(json.dumps({"key": _decoded(key), "problem": problem, "text": text}))
    aside.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    first = next(iter(found.damaged.items()))
    count = len(found.damaged)
    what = f"{count} records of the journal" if count > 1 else "a record of the journal"
    found.problems.append(
        f"{what} could not be used: see {aside} ({_decoded(first[0])}: {first[1]})"
    )
    found.put_aside = found.put_aside or aside
    log.error("%s", found.problems[-1])
