"""History: every fact of the engine as an event with a number and a wall time.

The newest events are in memory, all of them in SQLite. `append` costs the loop one dict; a thread
writes them and answers questions about events that memory no longer holds. A crash loses the last
moment, which loses explanations, never leases. A broken database is put aside and reported; without
a writable one the history lives in memory only. Must not know what the events mean.
"""

import asyncio
import contextlib
import json
import logging
import secrets
import sqlite3
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from pydantic_core import PydanticSerializationError, to_json

from vram_arbiter.arbiter.host.disk_writer import DiskBehind, DiskFailed, DiskWriter
from vram_arbiter.arbiter.host.journal_files import is_corruption, put_aside
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.replies import HistoryReply

log = logging.getLogger(__name__)

RING_EVENTS = 2000
SKIPPED_AFTER_CRASH = 2000
"""Numbers left out after a crash: subscribers may know those of the last, unwritten events."""
BUFFER_MAX = 20_000
"""Events with the writer, and again as many waiting for it, while a disk does not answer.

Beyond this the oldest are dropped. The gap in their numbers shows it.
"""
QUESTIONS_MAX = 256
"""Questions about older events that wait for the disk; the next one is answered with a problem."""
PRUNE_EVERY_EVENTS = 2000
SEQ_MAX = 1 << 52
NAME_BYTES = 8
"""Of the random name that a numbering gets when it begins."""
EVENT_MAX_CHARS = 1 << 25
AT_ONCE = frozenset({"operator"})
"""Kinds that do not wait for the next batch: an order must survive a crash that follows at once."""
CLEAN_END = "stopped"
"""Kind of the last event of an orderly stop."""

Done = Callable[[HistoryReply], None]
Event = JsonMap

_SCHEMA = """
CREATE TABLE IF NOT EXISTS events
    (seq INTEGER PRIMARY KEY, at_wall_s REAL NOT NULL, kind TEXT NOT NULL, json TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS events_by_time ON events (at_wall_s);
CREATE TABLE IF NOT EXISTS numbering (name TEXT NOT NULL);
"""
_QUESTION = """
SELECT seq, at_wall_s, json FROM events
    WHERE seq > ? AND (? = '[]' OR kind IN (SELECT value FROM json_each(?)))
    ORDER BY seq LIMIT ?
"""
_NEWEST = """
SELECT seq, at_wall_s, json FROM events
    WHERE seq > ? AND seq < ? AND (? = '[]' OR kind IN (SELECT value FROM json_each(?)))
    ORDER BY seq DESC LIMIT ?
"""


class History:
    """Numbers and keeps events.

    `open` before the loop runs, `start` inside it, `close` at the end (writes what is left).
    """

    def __init__(
        self,
        store: "_Store | None",
        last_seq: int,
        wall: Callable[[], float] = time.time,
        numbering: str | None = None,
    ) -> None:
        self._store = store
        self._wall = wall
        self._last_seq = last_seq
        self._numbering = numbering or secrets.token_hex(NAME_BYTES)
        self._ring: deque[Event] = deque(maxlen=RING_EVENTS)
        self._disk: DiskWriter[Event] | None = None
        self.problem = "history is kept in memory only: its file cannot be used"
        if store is not None:
            self.problem = ""
            self._disk = DiskWriter(
                "history",
                store,
                self._told,
                items_max=BUFFER_MAX,
                questions_max=QUESTIONS_MAX,
            )

    @classmethod
    def open(
        cls, folder: Path, max_events: int, days: float, wall: Callable[[], float] = time.time
    ) -> Self:
        """Open or make `history.sqlite`; numbering continues. Without a disk: memory only."""
        path = folder / "history.sqlite"
        for attempt in (1, 2):
            try:
                store = _Store(path, max_events, days, wall)
                return cls(store, store.last_seq(), wall, store.numbering())
            except (sqlite3.DatabaseError, OSError) as error:
                log.error("history %s: %s", path, error)
                if attempt == 2 or not path.is_file() or not _is_damage(error):
                    break
                with contextlib.suppress(OSError):
                    log.error("history put aside as %s", put_aside(path))
        log.error("history is kept in memory only")
        return cls(None, 0, wall)

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        if self._disk is not None:
            self._disk.start(loop)

    def keep(self, max_events: int, days: float) -> None:
        """Keep this many events for this long from the next pruning on."""
        if self._store is not None:
            self._store.max_events, self._store.days = max_events, days

    @property
    def last_seq(self) -> int:
        return self._last_seq

    def append(self, kind: str, data: JsonMap) -> Event:
        """Give a fact its number and wall time, keep it, and return the event."""
        self._last_seq += 1
        event = {"seq": self._last_seq, "at_wall_s": self._wall(), "kind": kind, **data}
        self._ring.append(event)
        if self._disk is not None:
            self._disk.put(event)
            if kind in AT_ONCE:
                self._disk.flush()
        return event

    def read(
        self,
        after: int,
        limit: int,
        kinds: tuple[str, ...],
        done: Done,
        before: int | None = None,
    ) -> None:
        """Find the events after a number, oldest first; with `before`, the newest ones below it.

        Calls `done({"events", "last_seq"})` at once, or later on the loop's thread.
        """
        first = self._ring[0]["seq"] if self._ring else self._last_seq + 1
        wanted = frozenset(kinds)
        held = [
            e
            for e in self._ring
            if after < e["seq"]
            and (before is None or e["seq"] < before)
            and (not wanted or e["kind"] in wanted)
        ]
        held = held[:limit] if before is None else held[-limit:]
        store, disk = self._store, self._disk
        enough = after + 1 >= first or (before is not None and len(held) == limit)
        if store is None or disk is None or not disk.running or enough:
            done(self._reply(held))
            return

        held, end = ([], None) if before is None else (held, min(before, first))

        def answer(found: list[Event] | DiskFailed) -> None:
            if isinstance(found, DiskFailed):
                done(self._reply((), str(found)))
            else:
                done(self._reply([*found, *held]))

        try:
            disk.ask(lambda: store.find(after, limit - len(held), kinds, end), answer)
        except DiskBehind:
            done(self._reply((), "the disk of the history does not answer"))

    def _reply(self, events: Sequence[Event], problem: str = "") -> HistoryReply:
        return HistoryReply(tuple(events), self._last_seq, problem, self._numbering)

    def close(self) -> None:
        """Write what is left and end the writer."""
        if self._disk is not None:
            self._disk.close()

    def _told(self, failure: DiskFailed | None) -> None:
        if failure is None:
            self.problem = ""
        elif isinstance(failure, DiskBehind):
            lost = "events that do not fit in memory are lost"
            self.problem = self.problem or f"the disk of the history does not answer: {lost}"
        else:
            if not self.problem:  # a full disk is worth one line, not five a second
                log.error("history: %s; events are in memory only until that ends", failure)
            self.problem = f"history cannot be written ({failure}): events are in memory only"


def _text(event: Event) -> str:
    try:
        return to_json(event, fallback=str).decode()
    except PydanticSerializationError:  # half a surrogate pair, which only escapes can hold
        return json.dumps(event, separators=(",", ":"), default=str)


def _event(seq: int, at_wall_s: object, text: str) -> Event:
    """Return the event of one row; a damaged one keeps its number, so that paging goes on."""
    with contextlib.suppress(ValueError, TypeError):
        event = strictjson.loads(text, max_chars=EVENT_MAX_CHARS)
        if (
            isinstance(event, dict)
            and event.get("seq") == seq
            and {"kind", "at_wall_s"} <= event.keys()
        ):
            return event
    return {
        "seq": seq,
        "at_wall_s": at_wall_s if isinstance(at_wall_s, float) else 0.0,
        "kind": "unreadable",
    }


def _is_damage(error: sqlite3.DatabaseError | OSError) -> bool:
    """Whether the file is damaged, as opposed to a disk that is full, locked or read-only."""
    if isinstance(error, sqlite3.OperationalError):
        return is_corruption(error)
    return isinstance(error, sqlite3.DatabaseError)


class _Store:
    """The table. Made by the main thread, then used by the writer's thread alone. Events of a
    failed write are written with the next."""

    def __init__(self, path: Path, max_events: int, days: float, wall: Callable[[], float]) -> None:
        self._wall = wall
        self._opened_at = time.monotonic()
        self.max_events = max_events
        self.days = days
        self._since_prune = 0
        self._owed: deque[Event] = deque(maxlen=BUFFER_MAX)
        self._earlier = 0  # the last number of earlier runs
        self._db = sqlite3.connect(path, isolation_level=None, timeout=1.0, check_same_thread=False)
        try:
            path.chmod(0o600)
            # damage need not be UTF-8
            self._db.text_factory = lambda text: text.decode(errors="replace")
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_SCHEMA)
        except BaseException:
            self._db.close()
            raise

    def last_seq(self) -> int:
        """Return the number after which numbering continues: none is given out twice.

        Raises sqlite3.DatabaseError.
        """
        try:
            row = self._db.execute(
                "SELECT seq, kind FROM events ORDER BY seq DESC LIMIT 1"
            ).fetchone()
            if row is not None and row[0] > SEQ_MAX:
                raise sqlite3.DatabaseError(
                    f"an event has the number {row[0]}, more than {SEQ_MAX}"
                )
            used = self._name() is not None
        except BaseException:
            self._db.close()
            raise
        if row is not None:
            self._earlier = int(row[0]) + (0 if row[1] == CLEAN_END else SKIPPED_AFTER_CRASH)
        elif used:  # the run that made the file was killed before it wrote an event
            self._earlier = SKIPPED_AFTER_CRASH
        return self._earlier

    def numbering(self) -> str:
        """Return the name of this file's numbering, made with the file. Raises
        sqlite3.DatabaseError."""
        try:
            name = self._name()
            if name is None:
                name = secrets.token_hex(NAME_BYTES)
                self._db.execute("INSERT INTO numbering VALUES (?)", (name,))
        except BaseException:
            self._db.close()
            raise
        return name

    def _name(self) -> str | None:
        row = self._db.execute("SELECT name FROM numbering").fetchone()
        return None if row is None else str(row[0])

    def write(self, items: Sequence[Event]) -> None:
        self._owed.extend(items)
        rows = [(e["seq"], e["at_wall_s"], e["kind"], _text(e)) for e in self._owed]
        with self._db:
            self._db.execute("BEGIN IMMEDIATE")
            self._db.executemany("INSERT OR REPLACE INTO events VALUES (?, ?, ?, ?)", rows)
            self._since_prune += len(rows)
            if self._since_prune >= PRUNE_EVERY_EVENTS:
                self.prune(self._wall())
        self._owed.clear()

    def prune(self, wall_s: float) -> None:
        """Drop events beyond the number or the age.

        The wall clock may jump by decades on a machine without a battery: an event of this run is
        old only when the run itself is.
        """
        self._since_prune = 0
        self._db.execute(
            "DELETE FROM events WHERE seq <= (SELECT MAX(seq) FROM events) - ?", (self.max_events,)
        )
        age_s = self.days * 86_400
        up_to = self._earlier if time.monotonic() - self._opened_at < age_s else sys.maxsize
        self._db.execute(
            "DELETE FROM events WHERE at_wall_s < ? AND seq <= ?", (wall_s - age_s, up_to)
        )

    def find(
        self, after: int, limit: int, kinds: tuple[str, ...], before: int | None = None
    ) -> list[Event]:
        wanted = json.dumps(list(kinds))
        if before is None:
            rows = self._db.execute(_QUESTION, (after, wanted, wanted, limit)).fetchall()
        else:
            rows = self._db.execute(_NEWEST, (after, before, wanted, wanted, limit)).fetchall()
            rows.reverse()
        return [_event(*row) for row in rows]

    def close(self) -> None:
        self._db.close()
