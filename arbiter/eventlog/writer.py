"""The event log's writer: what the engine was told and a digest of what it decided, in files that rotate and never exceed a bound.

`record` costs the decision path an append; a thread encodes and writes every 0.2 s, in small pieces so that it never keeps the loop
waiting for the interpreter. A crash loses that tail at most. A disk that fails stops the recording with a note, never the daemon; it
begins again, with the state of that moment, when the disk does. Must not know what events mean.
"""

import asyncio
import logging
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import Event
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.eventlog.logfile import (
    FOLDER,
    SUFFIX,
    Header,
    engine_id,
    entry_line,
    file_name,
    header_line,
)
from vram_arbiter.arbiter.eventlog.snapshot import freeze, thaw, to_plain

log = logging.getLogger(__name__)

FLUSH_S = 0.2
BUFFER_MAX = 50_000
"""Events waiting for a disk that does not answer; beyond this they are dropped, and the log goes on with a new beginning."""
RETRY_S = 30.0
"""After a failed write."""
PIECE = 16
"""Events encoded before the thread lets others run."""
PAUSE_S = 0.0002
CLOSE_S = 5.0

type Told = Callable[[str, Mapping[str, Any]], object]
"""Where notes go: kind and facts, as `History.append`."""


@dataclass(frozen=True, slots=True)
class _Begin:
    """From here on a new file: its first line, with the state as `freeze` left it (None: the engine is empty)."""

    segment: int
    cause: str
    now: float
    at_wall_s: float
    frozen: bytes | None


type _Item = _Begin | tuple[float, Event, Sequence[Effect] | None]


class Recorder:
    """`start` inside the loop, `record` after every event, `close` at the end (writes what is left)."""

    def __init__(
        self,
        state_dir: Path,
        settings: Settings,
        version: str,
        *,
        max_bytes: int,
        file_bytes: int,
        freeze_engine: Callable[[], bytes],
        told: Told,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._freeze = freeze_engine
        self._told = told
        self._clock = clock
        self._wall = wall
        self._buffer: deque[_Item] = deque()
        self._work: queue.SimpleQueue[Sequence[_Item] | None] = queue.SimpleQueue()
        self._handed = 0  # events given to the thread; the loop alone counts
        self._written = 0  # of those, done with; the thread alone counts
        self._segment = 0
        self._retry_at: float | None = None  # recording has stopped until then
        self._troubled = False  # and that was said
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._thread: threading.Thread | None = None
        self._files = _Files(state_dir / FOLDER, wall(), settings, version, max_bytes, file_bytes)

    @property
    def behind(self) -> int:
        """Events that were handed to the thread and are not on the disk yet."""
        return self._handed - self._written

    def start(self, loop: asyncio.AbstractEventLoop, made_at: float) -> None:
        """The engine was made at this (monotonic) moment and has handled nothing yet."""
        self._loop = loop
        self._begin("start", None, made_at)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record(self, now: float, event: Event, effects: Sequence[Effect] | None) -> None:
        """What was just handled; None: the engine raised. Called on the loop's thread, with the engine between two events."""
        if self._retry_at is not None:
            if effects is not None and now >= self._retry_at:
                self._retry_at = None
                self._begin_anew("resumed", now)
            return
        if len(self._buffer) + self.behind >= BUFFER_MAX:
            self._buffer.clear()
            self._stopped(f"more than {BUFFER_MAX} events wait for the disk")
            return
        self._buffer.append((now, event, effects))
        if self._files.full_segment == self._segment - 1 and effects is not None:
            self._begin_anew("size", now)
        if self._timer is None and self._loop is not None:
            self._timer = self._loop.call_later(FLUSH_S, self._flush)

    def close(self) -> None:
        self._flush()
        if self._timer is not None:
            self._timer.cancel()
        if self._thread is not None:
            self._work.put(None)
            self._thread.join(CLOSE_S)
            self._thread = None
        self._loop = None

    def _begin_anew(self, cause: str, now: float) -> None:
        try:
            frozen = self._freeze()
        except Exception as error:  # noqa: BLE001 - a state that cannot be copied ends the recording, never the daemon
            self._stopped(f"the engine's state cannot be copied: {type(error).__name__}: {error}")
        else:
            self._begin(cause, frozen, now)

    def _begin(self, cause: str, frozen: bytes | None, now: float) -> None:
        self._buffer.append(_Begin(self._segment, cause, now, self._wall(), frozen))
        self._segment += 1

    def _flush(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._buffer:
            items = tuple(self._buffer)
            self._buffer.clear()
            self._handed += len(items)
            self._work.put(items)

    def _stopped(self, reason: str) -> None:
        """On the loop. Said once per trouble, tried again in a while."""
        self._retry_at = self._clock() + RETRY_S
        if not self._troubled:
            self._troubled = True
            log.error("event log: %s; recording stops until that ends", reason)
            self._told("record_stopped", {"reason": reason, "folder": str(self._files.folder)})

    def _resumed(self) -> None:
        self._troubled = False
        self._told("record_resumed", {"reason": "the event log goes on, with a gap"})

    # -- the thread --------------------------------------------------------------------------------------------------
    def _run(self) -> None:
        failed = False
        while (items := self._work.get()) is not None:
            begins = [item for item in items if isinstance(item, _Begin)]
            try:
                if failed and not begins:
                    continue  # the loop has not heard of the failure yet
                self._files.write(items)
                failed = False
                if any(begin.cause == "resumed" for begin in begins):
                    self._on_loop(self._resumed)
            except Exception as error:  # noqa: BLE001 - the thread's outermost loop: whatever it is, it is told
                failed = True
                self._files.close()
                self._on_loop(partial(self._stopped, f"{type(error).__name__}: {error}"))
            finally:
                self._written += len(items)
        self._files.close()

    def _on_loop(self, call: Callable[[], None]) -> None:
        if (loop := self._loop) is not None:
            try:
                loop.call_soon_threadsafe(call)
            except RuntimeError:
                pass  # the loop closed meanwhile: nobody is left to tell


class _Files:
    """The folder. Made by the main thread, used by the recorder's thread alone, but for `full_segment`."""

    def __init__(
        self,
        folder: Path,
        started_wall_s: float,
        settings: Settings,
        version: str,
        max_bytes: int,
        file_bytes: int,
    ) -> None:
        self.folder = folder
        self.full_segment: int | None = None  # the thread says so, the loop begins the next file
        self._started_wall_s = started_wall_s
        self._settings = settings
        self._version = version
        self._max_bytes = max_bytes
        self._file_bytes = min(file_bytes, max_bytes // 2)
        self._file: int | None = None
        self._full_bytes = self._file_bytes  # the file that is written is full then
        self._size = 0
        self._segment = 0

    def write(self, items: Sequence[_Item]) -> None:
        """Raises OSError for a disk that does not take it."""
        lines: list[str] = []
        for count, item in enumerate(items):
            if isinstance(item, _Begin):
                self._put(lines)
                lines = [self._next(item)]
            else:
                lines.append(entry_line(*item))
            if count % PIECE == PIECE - 1:
                time.sleep(PAUSE_S)
        self._put(lines)

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _next(self, begin: _Begin) -> str:
        self.close()
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        header = Header(
            version=self._version,
            engine=engine_id(),
            epoch=self._settings.epoch,
            segment=begin.segment,
            cause=begin.cause,
            at_wall_s=begin.at_wall_s,
            now=begin.now,
            settings=self._settings,
            state=None if begin.frozen is None else to_plain(thaw(begin.frozen)),
        )
        line = header_line(header)
        path = self.folder / file_name(self._started_wall_s, self._settings.epoch, begin.segment)
        half_bytes = self._max_bytes // 2
        if len(line) > half_bytes:
            raise ValueError(
                f"the engine's state alone takes {len(line)} bytes, more than half of record.max_bytes ({self._max_bytes})"
            )
        # A state is copied while everybody waits: as much as it takes must be written before it is copied again.
        self._full_bytes = max(self._file_bytes, min(2 * len(line), half_bytes))
        self._make_room(self._full_bytes)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        self._size, self._segment = 0, begin.segment
        return line

    def _make_room(self, file_bytes: int) -> None:
        """Oldest files go until a whole new one fits the bound."""
        files = [(path, path.stat().st_size) for path in sorted(self.folder.glob(f"*{SUFFIX}"))]
        total = sum(size for _, size in files)
        for path, size in files:
            if total + file_bytes <= self._max_bytes:
                return
            path.unlink()
            total -= size

    def _put(self, lines: Sequence[str]) -> None:
        if not lines or self._file is None:
            return
        data = "".join(lines).encode()
        written = 0
        try:
            while written < len(data):
                written += os.write(self._file, memoryview(data)[written:])
        except OSError:
            os.ftruncate(self._file, self._size)  # what is there stays whole
            raise
        self._size += len(data)
        if self._size >= self._full_bytes:
            self.full_segment = self._segment


def freezer(engine: Arbiter) -> Callable[[], bytes]:
    """What a recorder copies the engine with."""
    return lambda: freeze(engine)
