"""The files of an event log: names, first line, lines, and how they are read again.

    record/20261121T144512-000003-0000.jsonl      start of the daemon, epoch, number of the file
    within this start
    {"log": 2, "version": …, "engine": …, "epoch": …, "segment": …, "cause": …, "at_wall_s": …,
    "now": …, "settings": …, "state": …}
    {"t": 812.25, "event": "Asked", "data": {…}, "effects": "Reply Note:use_began", "digest":
    "77c0…"}

`state` is null in the first file of a start: the engine begins empty. Every later file begins with
the whole state, so the oldest files may go. `digest` is null where the engine raised. Reads files
and nothing else.
"""

import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from vram_arbiter.arbiter import core
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import Event
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.eventlog.codec import decode_event, digest, summary, to_json
from vram_arbiter.schemas import defaults, ids
from vram_arbiter.schemas.codec import CodecError, from_map, to_map
from vram_arbiter.schemas.errors import OperatorError
from vram_arbiter.schemas.plain import JsonMap

FORMAT = 2
SUFFIX = ".jsonl"
FOLDER = "record"
"""Inside the daemon's state folder."""


class LogError(OperatorError):
    """A log that cannot be read; the message says which file and line."""

    code = "bad_log"


@dataclass(frozen=True, slots=True)
class Header:
    """The first line of a file."""

    version: str
    engine: str
    epoch: int
    segment: int
    cause: str  # start | size | resumed
    at_wall_s: float
    now: float
    settings: Settings
    state: JsonMap | None


@dataclass(frozen=True, slots=True)
class Entry:
    """One event as it was handled. `digest` None: the engine raised."""

    now: float
    event: Event
    effects: str
    digest: str | None
    line: int


@dataclass(frozen=True, slots=True)
class LogFile:
    """One file, read as far as it can be. `torn`: its last line was cut off by a crash or a full
    disk."""

    path: Path
    header: Header
    entries: tuple[Entry, ...]
    torn: bool


@cache
def engine_id() -> str:
    """Names the engine's source: two logs with the same id were made by the same
    decisions' code."""
    seen = blake2b(digest_size=6)
    modules = [Path(str(ids.__file__)), Path(str(defaults.__file__))]
    for path in [*sorted(Path(core.__path__[0]).rglob("*.py")), *modules]:
        seen.update(path.read_bytes())
    return seen.hexdigest()


def file_name(started_wall_s: float, epoch: int, segment: int) -> str:
    """Sorted by name is sorted by time."""
    started = time.strftime("%Y%m%dT%H%M%S", time.gmtime(started_wall_s))
    return f"{started}-{epoch:06d}-{segment:04d}{SUFFIX}"


def header_line(header: Header) -> str:
    return to_json({"log": FORMAT, **to_map(header)}) + "\n"


def entry_line(now: float, event: Event, effects: Sequence[Effect] | None) -> str:
    """One event and what came of it; None: the engine raised."""
    facts = {
        "t": now,
        "event": type(event).__name__,
        "data": to_map(event),
        "effects": "" if effects is None else summary(effects),
        "digest": None if effects is None else digest(effects),
    }
    return to_json(facts) + "\n"


# -- reading
def find_files(place: Path) -> list[Path]:
    """The files of a log: the one file, or those of the newest start in a folder (the state folder
    or its `record`). Raises LogError."""
    try:
        if place.is_file():
            return [place]
        folder = place / FOLDER if (place / FOLDER).is_dir() else place
        names = os.listdir(folder) if folder.is_dir() else []
    except OSError as error:
        raise LogError(
            f"{error.filename or place} cannot be read: {error.strerror}",
            hint="the daemon's state folder is its own user's: use that user, or root",
        ) from error
    found = sorted(folder / name for name in names if name.endswith(SUFFIX))
    if not found:
        raise LogError(
            f"{place}: no event log here", hint="give a .jsonl file, or the daemon's state folder"
        )
    newest = found[-1].name.rpartition("-")[0]
    return [path for path in found if path.name.rpartition("-")[0] == newest]


def read_file(path: Path) -> LogFile:
    """Raises LogError for a file that is not a log, is of another format, or is broken before its
    last line."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}", hint="name a readable file") from error
    lines = text.split("\n")
    torn = lines.pop() != ""  # a whole line ends with a newline
    if not lines:
        raise LogError(
            f"{path}: not even the first line is whole", hint="nothing can be replayed from it"
        )
    header = _header(path, lines[0])
    entries = tuple(_entries(path, lines[1:]))
    return LogFile(path, header, entries, torn)


def _header(path: Path, line: str) -> Header:
    try:
        data = json.loads(line)
        number = data.pop("log")
    except (ValueError, AttributeError, TypeError, KeyError, RecursionError) as error:
        raise LogError(
            f"{path}: no event log of an arbiter", hint="its first line says so"
        ) from error
    if number != FORMAT:
        raise LogError(
            f"{path}: a log of format {number}, this version reads {FORMAT}",
            hint="replay it with its own",
        )
    try:
        return from_map(Header, data, strict=True)
    except CodecError as error:
        raise _foreign(path, 1, error, str(data.get("version"))) from error


def _entries(path: Path, lines: Sequence[str]) -> Iterator[Entry]:
    for number, line in enumerate(lines, 2):
        try:
            yield _entry(json.loads(line), number)
        except CodecError as error:
            raise _foreign(path, number, error, "") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            whole = (
                f"it is damaged; its first {number - 1} lines can be replayed: `head -n "
                f"{number - 1}`"
            )
            raise LogError(
                f"{path}:{number}: not a line of an event log: {error}", hint=whole
            ) from error


def _entry(data: Any, number: int) -> Entry:
    """Raises CodecError for an event of another version, and what `_entries` expects of a line that
    is none."""
    event = decode_event(data["event"], data["data"])
    now, effects, made = data["t"], data["effects"], data["digest"]
    if (
        type(now) not in (int, float)
        or type(effects) is not str
        or not (made is None or type(made) is str)
    ):
        raise ValueError("`t` is a number, `effects` text, `digest` text or null")
    return Entry(now, event, effects, made, number)


def _foreign(path: Path, line: int, error: CodecError, version: str) -> LogError:
    recorded = f" (recorded by version {version})" if version else ""
    return LogError(
        f"{path}:{line}: {error}{recorded}",
        hint="the log is of another version: replay it with that one",
    )
