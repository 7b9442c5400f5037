"""What must survive the daemon: one record per lease and residue, in SQLite.

Records are written before a grant is sent. WAL with `synchronous=NORMAL` does not fsync each
commit: a commit survives the death of the daemon (it is in the kernel's page cache) but perhaps not
a power cut, and that is enough, since a power cut empties the GPU too: a new boot id voids every
record. SQLite does not tell a lost or damaged log from one that was never written, so each row
carries a digest and `host.seal` names the digest of all of them. What they do not confirm is
doubted: a record of the doubt itself says so, until the core deletes it, and nothing is granted
before. Damage is put aside and reported, never repaired by guessing. Must not know what the other
records mean: `check` tells whether one can be read.
"""

import contextlib
import errno
import json
import logging
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NoReturn, Self

from pydantic import TypeAdapter
from pydantic_core import to_json

from vram_arbiter.arbiter.core.events import DOUBT_KEY
from vram_arbiter.arbiter.host.journal_files import (
    SCHEMA_VERSION,
    Check,
    connect,
    doubt_of,
    look,
    put_aside,
    put_rows_aside,
    total_of,
)
from vram_arbiter.arbiter.host.seal import LastStart, Seal, digest, fresh_epoch, write_last_start
from vram_arbiter.schemas.errors import ConfigError, JournalUnavailable
from vram_arbiter.schemas.plain import JsonMap

log = logging.getLogger(__name__)

AT_ONCE_MAX = 8
"""Changes of one kind that are written by one statement."""
_PUT = [
    "",
    *(
        f"INSERT OR REPLACE INTO records VALUES {', '.join(['(?, ?, ?)'] * n)}"
        for n in range(1, AT_ONCE_MAX + 1)
    ),
]
_DELETE = [
    "",
    *(
        f"DELETE FROM records WHERE key IN ({', '.join('?' * n)})"
        for n in range(1, AT_ONCE_MAX + 1)
    ),
]
_LEARNT = TypeAdapter(dict[str, dict[str, float]])
_FOOTPRINTS = TypeAdapter(dict[str, dict[str, list[int]]])
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PASSING = frozenset((*_FULL, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM))


Change = tuple[str, JsonMap | None]


@dataclass(frozen=True, slots=True)
class Opened:
    """What a start found. `put_aside` names the file that damage was moved to; `voided` counts
    records of an earlier boot. `witness` is for the next start. `doubt` says why the records may
    not be all; its own record is among them then. `problems` is for people, a line for each file
    and for the records put aside. `learnt` is what `keep` wrote last under that name, whatever the
    boot, and so are `footprints`.
    """

    epoch: int
    records: Mapping[str, JsonMap]
    witness: str = ""
    put_aside: Path | None = None
    problem: str = ""
    doubt: str = ""
    problems: tuple[str, ...] = ()
    voided: int = 0
    learnt: Mapping[str, dict[str, float]] = field(default_factory=dict)
    footprints: Mapping[str, dict[str, list[int]]] = field(default_factory=dict)


class Journal:
    """One connection, used by one thread. `open` makes it; the database stays locked against a
    second daemon's writes by the daemon's own lock file, not here."""

    def __init__(
        self,
        path: Path,
        boot_id: str,
        connection: sqlite3.Connection,
        seal: Seal,
        digests: dict[str, int],
        opened: Opened,
    ) -> None:
        self._path = path
        self._boot_id = boot_id
        self._connection = connection
        self._seal = seal
        self._digests = digests
        self._total = total_of(digests)
        self._kept: dict[str, str] = {}  # what `keep` wrote last
        self.problem = ""
        self.opened = opened

    @classmethod
    def open(
        cls,
        folder: Path,
        boot_id: str,
        *,
        check: Check | None = None,
        at_least: int | None = None,
        witness: str = "",
        seals: type[Seal] = Seal,
    ) -> Self:
        """Open or make the journal in `folder`, and count a new epoch, `at_least` that (else
        `fresh_epoch`). Raises ConfigError if the folder cannot be used, JournalUnavailable if its
        disk is full, failing or read-only: without a durable epoch tokens could be given out twice.

        1. Read everything; damage is put aside. 2. Records of another boot are dropped. 3. What no
           seal confirms is doubted.
        4. Epoch: more than every known one. 5. Seal before the database, so that a kill between
           them causes no doubt; in doubt the
        other way round, so that it stays one. 6. The epoch file.

        `witness` is what `Opened.witness` said at the last start, kept outside of the folder.
        """
        connection: sqlite3.Connection | None = None
        seal: Seal | None = None
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = look(folder, check, witness)  # 1
            connection = found.connection
            voided = found.void(boot_id)  # 2
            doubt = doubt_of(found, boot_id)  # 3
            if found.damaged:
                put_rows_aside(folder, found)
            records, digests = found.records, found.digests
            if doubt:
                log.error("journal doubted: %s", doubt)
                records[DOUBT_KEY] = {"why": doubt}
                digests = _digests_of(records)
            epoch = max(found.epoch + 1, fresh_epoch() if at_least is None else at_least)  # 4
            seal = seals.open(folder, epoch, boot_id)  # 5
            total = total_of(digests)
            if not doubt:
                seal.write(total, total)
            _begin(connection, boot_id, epoch, records if doubt or voided is not None else None)
            if doubt:
                seal.write(total, total)
            last = LastStart(epoch, boot_id)  # 6
            write_last_start(folder, last)
        except (OSError, sqlite3.OperationalError) as error:
            if connection is not None:
                connection.close()
            if seal is not None:
                seal.close()
            _raise(folder, error)
        opened = Opened(
            epoch,
            records,
            last.text(),
            found.put_aside,
            "; ".join(found.problems),
            doubt,
            tuple(found.problems),
            voided or 0,
            _kept(found.meta, "learnt", _LEARNT),
            _kept(found.meta, "footprints", _FOOTPRINTS),
        )
        return cls(folder / "journal.sqlite", boot_id, connection, seal, digests, opened)

    @property
    def doubted(self) -> bool:
        """Whether the records may not name every lease."""
        return DOUBT_KEY in self._digests and DOUBT_KEY in self.opened.records

    @property
    def problems(self) -> list[str]:
        """What an operator should know, a line each. A doubt, of this start or of one before it,
        counts until the core deletes it."""
        doubt = ""
        if self.doubted:
            why = self.opened.records[DOUBT_KEY].get("why")
            doubt = (
                f"the journal may not name every lease ({why}): grants wait until each holder had "
                "time to reattach"
            )
        return [problem for problem in (*self.opened.problems, doubt, self.problem) if problem]

    def put_aside(self, problem: str) -> None:
        """The database is sound but its records cannot be used: start with an empty one, in the
        same epoch and in doubt."""
        self._connection.close()
        aside = put_aside(self._path)
        log.error("journal not understood (%s): put aside as %s", problem, aside)
        doubt = f"its records were not understood: {problem}"
        records = {DOUBT_KEY: {"why": doubt}}
        self._connection = connect(self._path)
        _begin(self._connection, self._boot_id, self.opened.epoch, records)
        self._digests = _digests_of(records)
        self._total = total_of(self._digests)
        self._seal.write(self._total, self._total)
        said = f"the journal was not readable and was put aside as {aside}"
        self.opened = replace(
            self.opened,
            records=records,
            put_aside=aside,
            problem=problem,
            doubt=doubt,
            problems=(said,),
        )

    def apply(self, changes: Sequence[Change]) -> None:
        """Write all changes in one transaction; None deletes. Raises JournalUnavailable (nothing is
        written then)."""
        rows: list[tuple[str, str | None, bytes]] = []
        known, soon = self._digests, self._total
        fresh: dict[str, int] = {}
        for key, record in changes:
            if record is None:
                rows.append((key, None, b""))
                own = 0
            else:
                text = to_json(record).decode()
                raw = digest(key, text)
                rows.append((key, text, raw))
                own = int.from_bytes(raw)
            soon ^= own ^ (fresh[key] if key in fresh else known.get(key, 0))
            fresh[key] = own
        written = self._connection.total_changes
        try:
            self._seal.write(self._total, soon)
            if len(rows) == 1 or (
                len(rows) <= AT_ONCE_MAX and len({text is None for _, text, _ in rows}) == 1
            ):
                self._change_at_once(rows)
            else:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    for row in rows:
                        self._change_at_once([row])
        except (sqlite3.Error, OSError) as error:
            self._failed(error)
            raise JournalUnavailable(
                f"the journal cannot be written: {error}",
                hint="see the disk of the daemon's state folder",
            ) from error
        self._total = soon
        for key, own in fresh.items():
            if own:
                known[key] = own
            else:
                known.pop(key, None)
        try:
            self._seal.write(soon, soon)
        # it is written, and accepted: the next change finds the seal unwritable before it is made
        except OSError as error:
            self._failed(error)
        else:
            # a full disk lets an empty commit through
            if self._connection.total_changes > written:
                self.problem = ""

    def _failed(self, error: Exception) -> None:
        self.problem = (
            f"the journal cannot be written ({error}): what is held stays, nothing new is granted"
        )

    def settle(self) -> None:
        """After a failure: can it be written again? Asked now and then, so that room on the disk is
        noticed without a request."""
        if self.problem:
            try:
                self._connection.execute(
                    "INSERT OR REPLACE INTO meta VALUES ('settled', hex(randomblob(8)))"
                )
                self._seal.write(self._total, self._total)
            except (sqlite3.Error, OSError) as error:
                log.debug("journal: %s", error)
            else:
                self.problem = ""

    def _change_at_once(self, rows: Sequence[tuple[str, str | None, bytes]]) -> None:
        """All puts or all deletions, in one statement: a statement alone is a transaction, and half
        the price of one around it."""
        if rows[0][1] is None:
            self._connection.execute(_DELETE[len(rows)], [key for key, _, _ in rows])
        else:
            self._connection.execute(_PUT[len(rows)], [value for row in rows for value in row])

    def keep(self, name: Literal["learnt", "footprints"], learnt: Mapping[str, JsonMap]) -> None:
        """Keep what was learnt for the next start. Losing it costs estimates only: a failure is
        logged."""
        text = json.dumps(learnt, separators=(",", ":"))
        if text == self._kept.get(name):
            return
        self._kept[name] = text
        try:
            sealed = f"{digest(name, text).hex()} {text}"
            self._connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (name, sealed))
        except sqlite3.Error as error:
            log.warning("what was learnt cannot be kept: %s", error)

    def close(self) -> None:
        self._connection.close()
        self._seal.close()


def _text(record: JsonMap) -> str:
    return to_json(record).decode()


def _digests_of(records: Mapping[str, JsonMap]) -> dict[str, int]:
    return {key: int.from_bytes(digest(key, _text(record))) for key, record in records.items()}


def _begin(
    connection: sqlite3.Connection,
    boot_id: str,
    epoch: int,
    records: Mapping[str, JsonMap] | None,
) -> None:
    """Write what names this start. `records` replace those that are there; None leaves them."""
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        if records is not None:
            connection.execute("DELETE FROM records")
        for key, record in (records or {}).items():
            text = _text(record)
            connection.execute(_PUT[1], (key, text, digest(key, text)))
        values = {"schema": str(SCHEMA_VERSION), "boot_id": boot_id, "epoch": str(epoch)}
        connection.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())


def _kept[T](
    meta: Mapping[str, str], name: str, adapter: TypeAdapter[dict[str, T]]
) -> dict[str, T]:
    """What `keep` wrote; damage counts as nothing learnt."""
    told, _, text = meta.get(name, "").partition(" ")
    if text and told == digest(name, text).hex():
        with contextlib.suppress(ValueError):
            return adapter.validate_json(text)
    return {}


def may_pass(error: BaseException) -> bool:
    """Is it the disk's trouble, or its permissions', which may be over at the next try, unlike a
    wrong folder?"""
    if isinstance(error, OSError):
        return error.errno in _PASSING
    codes = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_READONLY)
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in codes


def unavailable(folder: Path, error: BaseException) -> JournalUnavailable:
    return JournalUnavailable(
        f"the state folder {folder} is on a disk that is full, failing or read-only: {error}",
        hint="make room on it, mount it writable, or choose another --state-dir",
    )


def _raise(folder: Path, error: OSError | sqlite3.OperationalError) -> NoReturn:
    if may_pass(error):
        raise unavailable(folder, error) from error
    raise ConfigError(
        f"the state folder {folder} cannot be used: {error}",
        hint="make it writable, or choose another --state-dir",
    ) from error
