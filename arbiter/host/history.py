"""What happened: every fact of the core as an event with number and wall time, the newest in memory, all of them in SQLite.

`append` costs the loop one dict; a thread writes them every 0.2 s and answers questions about events that memory no longer
holds. Losing the last moment in a crash loses explanations, never leases. A broken database is put aside and reported; without a
writable one the history lives in memory only. Must not know what the events mean.
"""

import asyncio
import contextlib
import json
import logging
import queue
import sqlite3
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from vram_arbiter.arbiter.host.journal_files import is_corruption, put_aside
from vram_arbiter.schemas import strictjson

log = logging.getLogger(__name__)

RING_EVENTS = 2000
FLUSH_S = 0.2
SKIPPED_AFTER_CRASH = 2000
"""Numbers left out after a start that no stop preceded: those of the last, unwritten events may be known to subscribers."""
BUFFER_MAX = 20_000
"""Events with the thread, and again as many waiting for it, while a disk does not answer; beyond this the oldest are dropped. The gap in
their numbers shows it."""
QUESTIONS_MAX = 256
"""Questions about older events that wait for the thread; who asks beyond this hears at once that the disk does not answer."""
PRUNE_EVERY_EVENTS = 2000
SEQ_MAX = 1 << 52
EVENT_MAX_CHARS = 1 << 25
CLOSE_S = 5.0
AT_ONCE = frozenset({"operator"})
"""Kinds that do not wait for the next batch: who did what by hand is to survive a crash that follows at once."""
CLEAN_END = "stopped"
"""Kind of the last event of an orderly stop."""

Done = Callable[[Mapping[str, Any]], None]
Event = Mapping[str, Any]

_SCHEMA = """
CREATE TABLE IF NOT EXISTS events (seq INTEGER PRIMARY KEY, at_wall_s REAL NOT NULL, kind TEXT NOT NULL, json TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS events_by_time ON events (at_wall_s);
"""
_QUESTION = """
SELECT seq, at_wall_s, json FROM events WHERE seq > ? AND (? = '[]' OR kind IN (SELECT value FROM json_each(?))) ORDER BY seq LIMIT ?
"""


@dataclass(frozen=True, slots=True)
class _Question:
    after: int
    limit: int
    kinds: tuple[str, ...]
    done: Done


class History:
    """Numbers and keeps events. `open` before the loop runs, `start` inside it, `close` at the end (writes what is left)."""

    def __init__(
        self, store: "_Store | None", last_seq: int, wall: Callable[[], float] = time.time
    ) -> None:
        self._store = store
        self._wall = wall
        self._last_seq = last_seq
        self._ring: deque[Event] = deque(maxlen=RING_EVENTS)
        self._buffer: deque[Event] = deque(maxlen=BUFFER_MAX)
        self._work: queue.SimpleQueue[Sequence[Event] | _Question | None] = queue.SimpleQueue()
        self._handed = 0  # events given to the thread; the loop alone counts
        self._taken = 0  # of those, by the thread; it alone counts
        self._asked = self._answered = 0  # questions, counted in the same way
        self._thread: threading.Thread | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self.problem = (
            "" if store is not None else "history is kept in memory only: its file cannot be used"
        )

    @classmethod
    def open(
        cls, folder: Path, max_events: int, days: float, wall: Callable[[], float] = time.time
    ) -> Self:
        """Open or make `history.sqlite`; numbering goes on where it ended. Never fails: without a disk it is memory only."""
        path = folder / "history.sqlite"
        for attempt in (1, 2):
            try:
                store = _Store(path, max_events, days, wall)
                return cls(store, store.last_seq(), wall)
            except (sqlite3.DatabaseError, OSError) as error:
                log.error("history %s: %s", path, error)
                if attempt == 2 or not path.is_file() or not _is_damage(error):
                    break
                with contextlib.suppress(OSError):
                    log.error("history put aside as %s", put_aside(path))
        log.error("history is kept in memory only")
        return cls(None, 0, wall)

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        if self._store is not None:
            self._thread = threading.Thread(
                target=self._run, args=(self._store,), name="history", daemon=True
            )
            self._thread.start()

    @property
    def last_seq(self) -> int:
        return self._last_seq

    def append(self, kind: str, data: Mapping[str, Any]) -> Event:
        """Give a fact its number and wall time, keep it, and return the event."""
        self._last_seq += 1
        event = {"seq": self._last_seq, "at_wall_s": self._wall(), "kind": kind, **data}
        self._ring.append(event)
        if self._store is not None:
            self._buffer.append(event)
            if kind in AT_ONCE:
                self._flush()
            elif self._timer is None and self._loop is not None:
                self._timer = self._loop.call_later(FLUSH_S, self._flush)
        return event

    def read(self, after: int, limit: int, kinds: tuple[str, ...], done: Done) -> None:
        """Events after a number, oldest first: `done({"events", "last_seq"})`, at once or later on the loop's thread."""
        first = self._ring[0]["seq"] if self._ring else self._last_seq + 1
        if self._thread is None or after + 1 >= first:
            wanted = frozenset(kinds)
            found = [
                e for e in self._ring if e["seq"] > after and (not wanted or e["kind"] in wanted)
            ]
            done({"events": found[:limit], "last_seq": self._last_seq})
            return
        self._flush()
        if self._asked - self._answered >= QUESTIONS_MAX:
            done(
                {
                    "events": [],
                    "last_seq": self._last_seq,
                    "problem": "the disk of the history does not answer",
                }
            )
            return
        self._asked += 1
        self._work.put(_Question(after, limit, kinds, done))

    def close(self) -> None:
        """Write what is left and end the thread."""
        self._flush(last=True)
        if self._timer is not None:
            self._timer.cancel()
        if self._thread is not None:
            self._work.put(None)
            self._thread.join(CLOSE_S)
            self._thread = None
        self._loop = None

    def _flush(self, *, last: bool = False) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if not self._buffer or self._thread is None:
            return
        if last or self._handed - self._taken + len(self._buffer) <= BUFFER_MAX:
            self._handed += len(self._buffer)
            self._work.put(tuple(self._buffer))
            self._buffer.clear()
        elif self._loop is not None:  # the thread hangs in a write
            self.problem = (
                self.problem
                or "the disk of the history does not answer: what does not fit in memory is lost"
            )
            self._timer = self._loop.call_later(FLUSH_S, self._flush)

    # -- the thread ----------------------------------------------------------------------------------------------
    def _run(self, store: "_Store") -> None:
        owed: deque[Event] = deque(maxlen=BUFFER_MAX)  # what the disk did not take
        while (work := self._work.get()) is not None:
            try:
                if isinstance(work, _Question):
                    self._answered += 1
                    body = {
                        "events": store.find(work.after, work.limit, work.kinds),
                        "last_seq": self._last_seq,
                    }
                    self._answer(work.done, body)
                else:
                    self._taken += len(work)
                    owed.extend(work)
                    store.add(tuple(owed))
                    owed.clear()
                    self.problem = ""
            except sqlite3.Error as error:
                if not self.problem:  # a full disk is worth one line, not five a second
                    log.error("history: %s; events are kept in memory only until that ends", error)
                self.problem = (
                    f"history cannot be written ({error}): events are kept in memory only"
                )
                if isinstance(work, _Question):
                    self._answer(
                        work.done, {"events": [], "last_seq": self._last_seq, "problem": str(error)}
                    )
        store.close()

    def _answer(self, done: Done, body: Mapping[str, Any]) -> None:
        if (loop := self._loop) is not None:
            try:
                loop.call_soon_threadsafe(done, body)
            except RuntimeError:
                pass  # the loop closed meanwhile: nobody waits for the answer


def _event(seq: int, at_wall_s: object, text: str) -> Event:
    """One row. A damaged one keeps its number, so that a reader goes on behind it."""
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
    """The file's fault, not the machine's."""
    if isinstance(error, sqlite3.OperationalError):
        return is_corruption(error)
    return isinstance(error, sqlite3.DatabaseError)


class _Store:
    """The table. Made by the main thread, used by the history thread alone."""

    def __init__(self, path: Path, max_events: int, days: float, wall: Callable[[], float]) -> None:
        self._wall = wall
        self._opened_at = time.monotonic()
        self._max_events = max_events
        self._days = days
        self._since_prune = 0
        self._earlier = 0  # the last number of earlier runs
        self._db = sqlite3.connect(path, isolation_level=None, timeout=1.0, check_same_thread=False)
        try:
            path.chmod(0o600)
            self._db.text_factory = lambda text: text.decode(
                errors="replace"
            )  # damage need not be UTF-8
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_SCHEMA)
        except BaseException:
            self._db.close()
            raise

    def last_seq(self) -> int:
        """The number after which numbering goes on: never one that was given out before. Raises sqlite3.DatabaseError."""
        try:
            row = self._db.execute(
                "SELECT seq, kind FROM events ORDER BY seq DESC LIMIT 1"
            ).fetchone()
            if row is not None and row[0] > SEQ_MAX:
                raise sqlite3.DatabaseError(
                    f"an event has the number {row[0]}, more than {SEQ_MAX}"
                )
        except BaseException:
            self._db.close()
            raise
        if row is not None:
            self._earlier = int(row[0]) + (0 if row[1] == CLEAN_END else SKIPPED_AFTER_CRASH)
        return self._earlier

    def add(self, events: Sequence[Event]) -> None:
        rows = [
            (e["seq"], e["at_wall_s"], e["kind"], json.dumps(e, separators=(",", ":"), default=str))
            for e in events
        ]
        with self._db:
            self._db.execute("BEGIN IMMEDIATE")
            self._db.executemany("INSERT OR REPLACE INTO events VALUES (?, ?, ?, ?)", rows)
            self._since_prune += len(rows)
            if self._since_prune >= PRUNE_EVERY_EVENTS:
                self.prune(self._wall())

    def prune(self, wall_s: float) -> None:
        """Drop what is beyond the number or the age. The wall clock may be set meanwhile, by decades on a machine without a battery: an
        event of this run is old only when the run itself is."""
        self._since_prune = 0
        self._db.execute(
            "DELETE FROM events WHERE seq <= (SELECT MAX(seq) FROM events) - ?", (self._max_events,)
        )
        age_s = self._days * 86_400
        up_to = self._earlier if time.monotonic() - self._opened_at < age_s else sys.maxsize
        self._db.execute(
            "DELETE FROM events WHERE at_wall_s < ? AND seq <= ?", (wall_s - age_s, up_to)
        )

    def find(self, after: int, limit: int, kinds: tuple[str, ...]) -> list[Event]:
        wanted = json.dumps(list(kinds))
        return [_event(*row) for row in self._db.execute(_QUESTION, (after, wanted, wanted, limit))]

    def close(self) -> None:
        self._db.close()
