"""Event log writer: the engine's events and digests of its decisions, in files within a bound.

`record` costs the decision path an append; the disk writer's thread encodes and writes, in small
pieces so that the loop never waits long for the interpreter. A crash loses the tail at most.
A disk that fails stops the recording with a note, never the daemon; it begins again, with the state
of that moment, when the disk works. Must not know what events mean.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

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
from vram_arbiter.arbiter.host.disk_writer import DiskFailed, DiskWriter
from vram_arbiter.schemas.plain import JsonMap

log = logging.getLogger(__name__)

BUFFER_MAX = 25_000
"""Events with the writer, and again as many waiting for it, while a disk does not answer.

Beyond this they are dropped, and the log begins anew later.
"""
RETRY_S = 30.0
"""After a failed write."""
PIECE = 16
"""Events encoded before the thread lets others run."""
PAUSE_S = 0.0002

type Told = Callable[[str, JsonMap], object]
"""Where notes go: kind and facts, as `History.append`."""


@dataclass(frozen=True, slots=True)
class _Begin:
    """A new file from here on: its first line, with the state of that moment (None: empty)."""

    segment: int
    cause: str
    now: float
    at_wall_s: float
    state: JsonMap | None


type _Item = _Begin | tuple[float, Event, Sequence[Effect] | None]


class Recorder:
    """Writes the event log.

    `start` inside the loop, `record` after every event, `close` at the end (writes what is left).
    """

    def __init__(
        self,
        state_dir: Path,
        settings: Settings,
        version: str,
        *,
        max_bytes: int,
        file_bytes: int,
        state: Callable[[], JsonMap],
        told: Told,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._state = state
        self._told = told
        self._clock = clock
        self._wall = wall
        self._segment = 0
        self._retry_at: float | None = None  # recording has stopped until then
        self._troubled = False  # and a note said so
        self._files = _Files(state_dir / FOLDER, wall(), settings, version, max_bytes, file_bytes)
        self._disk: DiskWriter[_Item] = DiskWriter(
            "recorder", self._files, self._disk_told, items_max=BUFFER_MAX
        )

    @property
    def behind(self) -> int:
        """Events that were handed to the thread and are not on the disk yet."""
        return self._disk.behind

    def start(self, loop: asyncio.AbstractEventLoop, made_at: float) -> None:
        """Begin the first file; the engine was made at this (monotonic) time and is still empty."""
        self._disk.start(loop)
        self._begin("start", None, made_at)

    def record(self, now: float, event: Event, effects: Sequence[Effect] | None) -> None:
        """Keep an event that was just handled; `effects` None: the engine raised.

        Called on the loop's thread, with the engine between two events.
        """
        if self._retry_at is not None:
            if effects is not None and now >= self._retry_at:
                self._retry_at = None
                self._begin_anew("resumed", now)
                self._disk.confirm()
            return
        kept = self._put((now, event, effects))
        if kept and effects is not None and self._files.full_segment == self._segment - 1:
            self._begin_anew("size", now)

    def flush(self) -> None:
        """Hand what was recorded so far to the disk."""
        self._disk.flush()

    def close(self) -> None:
        self._disk.close()

    def _begin_anew(self, cause: str, now: float) -> None:
        try:
            state = self._state()
        except Exception as error:  # noqa: BLE001 - it ends the recording, never the daemon
            self._stopped(f"the engine's state cannot be copied: {type(error).__name__}: {error}")
        else:
            self._begin(cause, state, now)

    def _begin(self, cause: str, state: JsonMap | None, now: float) -> None:
        self._segment += 1
        self._put(_Begin(self._segment - 1, cause, now, self._wall(), state))

    def _put(self, item: _Item) -> bool:
        """Keep an item, or stop: a log must not lack one in its middle."""
        if self._disk.put(item):
            return True
        self._stopped(f"more than {BUFFER_MAX} events wait for the disk")
        return False

    def _disk_told(self, failure: DiskFailed | None) -> None:
        if failure is not None:
            self._stopped(str(failure))
        elif self._troubled and self._retry_at is None:
            self._troubled = False
            self._told("record_resumed", {"reason": "the event log goes on, with a gap"})

    def _stopped(self, reason: str) -> None:
        """Stop recording until RETRY_S have passed; one note for each trouble."""
        self._disk.clear()
        self._retry_at = self._clock() + RETRY_S
        if not self._troubled:
            self._troubled = True
            log.error("event log: %s; recording stops until that ends", reason)
            self._told("record_stopped", {"reason": reason, "folder": str(self._files.folder)})


class _Files:
    """Folder of the log. Used by the disk writer's thread alone, but for `full_segment`."""

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
        self.full_segment: int | None = None  # set by the thread; the loop begins the next file
        self._started_wall_s = started_wall_s
        self._settings = settings
        self._version = version
        self._max_bytes = max_bytes
        self._file_bytes = min(file_bytes, max_bytes // 2)
        self._file: int | None = None
        self._full_bytes = self._file_bytes  # size at which the present file is full
        self._size = 0
        self._segment = 0
        self._failure: Exception | None = None  # until the next beginning

    def write(self, items: Sequence[_Item]) -> None:
        """Write a batch. After a failure only a batch with a beginning is taken.

        Raises OSError for a disk that does not take it.
        """
        if self._failure is not None and not any(isinstance(item, _Begin) for item in items):
            raise self._failure  # the loop has not heard of it yet
        try:
            self._write(items)
        except Exception as error:
            self.close()
            self._failure = error
            raise
        self._failure = None

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _write(self, items: Sequence[_Item]) -> None:
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

    def _next(self, begin: _Begin) -> str:
        """Begin the next file. Returns its first line."""
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
            state=begin.state,
        )
        line = header_line(header)
        path = self.folder / file_name(self._started_wall_s, self._settings.epoch, begin.segment)
        half_bytes = self._max_bytes // 2
        if len(line) > half_bytes:
            raise ValueError(
                f"the engine's state alone takes {len(line)} bytes, "
                f"more than half of record.max_bytes ({self._max_bytes})"
            )
        # Copying the state holds up the loop: write as much as it takes before the next copy.
        self._full_bytes = max(self._file_bytes, min(2 * len(line), half_bytes))
        self._make_room(self._full_bytes)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        self._size, self._segment = 0, begin.segment
        return line

    def _make_room(self, file_bytes: int) -> None:
        """Remove the oldest files until a whole new one fits the bound."""
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
            os.ftruncate(self._file, self._size)  # earlier lines stay whole
            raise
        self._size += len(data)
        if self._size >= self._full_bytes:
            self.full_segment = self._segment
