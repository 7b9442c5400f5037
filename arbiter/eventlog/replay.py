"""A log through the engine once more: the same decisions, or the first one that is another.

Feeds every event with its own time to an engine made as the log says, and compares digests of
effects. Reads logs, writes nothing.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.model.lease import IllegalTransition
from vram_arbiter.arbiter.eventlog.codec import digest, summary
from vram_arbiter.arbiter.eventlog.logfile import (
    Entry,
    Header,
    LogError,
    LogFile,
    engine_id,
    find_files,
    read_file,
)
from vram_arbiter.arbiter.eventlog.snapshot import from_plain
from vram_arbiter.schemas.plain import JsonObject

CONTEXT = 5
"""Events shown before a divergence."""

type Seen = Callable[[Arbiter, Entry, Sequence[Effect]], None]
"""Told of every event that was replayed, after it, whether decisions agree or not."""


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first event that was decided otherwise than in the log."""

    number: int
    file: Path
    entry: Entry
    effects: tuple[Effect, ...]
    error: str  # not empty: the engine raised now
    before: tuple[Entry, ...]


@dataclass(slots=True)
class Replayed:
    """What a replay found."""

    header: Header
    files: list[Path]
    events: int = 0
    began_at: float = 0.0
    ended_at: float = 0.0
    gaps: int = 0
    torn: list[Path] = field(default_factory=list)
    divergence: Divergence | None = None
    raised: str = ""  # the log ends with a defect of the engine, and so does the replay

    @property
    def identical(self) -> bool:
        return self.divergence is None

    @property
    def same_engine(self) -> bool:
        return self.header.engine == engine_id()


def load(place: Path) -> list[LogFile]:
    """The files of one start, oldest first, each whole or with a torn last line. Raises
    LogError."""
    files: list[LogFile] = []
    for path in find_files(place):
        file = read_file(path)
        if (
            files
            and file.header.segment != files[-1].header.segment + 1
            and file.header.state is None
        ):
            raise LogError(f"{path}: a file before it is missing", hint="give the whole folder")
        files.append(file)
    return files


def engine_of(header: Header) -> Arbiter:
    """The engine as it was at the beginning of a file. Raises LogError if this version cannot hold
    that state."""
    if header.state is None:
        return Arbiter(header.settings, header.now)
    try:
        return from_plain(header.state)
    except ValueError as error:
        raise LogError(
            f"{error} (recorded by version {header.version})", hint="replay it with that version"
        ) from error


def replay(
    files: Sequence[LogFile], seen: Seen | None = None, *, to_the_end: bool = False
) -> Replayed:
    """Run the log again. Stops at the first divergence, or goes on with this version's decisions
    (`to_the_end`). Raises LogError."""
    found = Replayed(files[0].header, [file.path for file in files])
    found.torn = [file.path for file in files if file.torn]
    found.began_at = found.ended_at = found.header.now
    before: deque[Entry] = deque(maxlen=CONTEXT)
    for file, arbiter in _engines(files, found):
        for entry in file.entries:
            found.events += 1
            found.ended_at = entry.now
            effects, error = _handle(arbiter, entry)
            if (
                found.divergence is None
                and (digest(effects) if not error else None) != entry.digest
            ):
                found.divergence = Divergence(
                    found.events, file.path, entry, tuple(effects), error, tuple(before)
                )
                if not to_the_end:
                    return found
            if error:
                found.raised = error
                return found
            before.append(entry)
            if seen is not None:
                seen(arbiter, entry, effects)
    return found


def _engines(files: Sequence[LogFile], found: Replayed) -> Iterator[tuple[LogFile, Arbiter]]:
    """Each file with the engine for it: one for all, but a new beginning where the recording was
    interrupted."""
    arbiter: Arbiter | None = None
    for index, file in enumerate(files):
        follows = index > 0 and file.header.segment == files[index - 1].header.segment + 1
        if arbiter is None or file.header.cause == "resumed" or not follows:
            found.gaps += index > 0
            arbiter = engine_of(file.header)
        yield file, arbiter


def _handle(arbiter: Arbiter, entry: Entry) -> tuple[Sequence[Effect], str]:
    try:
        return arbiter.handle(entry.event, entry.now), ""
    except (
        InvariantViolation,
        IllegalTransition,
        AssertionError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        return (), f"{type(error).__name__}: {error}"


# -- for programs
def report(found: Replayed) -> JsonObject:
    """What `--json` prints."""
    shown: JsonObject = {
        "events": found.events,
        "identical": found.identical,
        "seconds": found.ended_at - found.began_at,
        "files": [str(path) for path in found.files],
        "torn": [str(path) for path in found.torn],
        "gaps": found.gaps,
        "raised": found.raised,
        "recorded_by": {"version": found.header.version, "engine": found.header.engine},
        "same_engine": found.same_engine,
        "divergence": None,
    }
    if (odd := found.divergence) is not None:
        shown["divergence"] = {
            "number": odd.number,
            "file": str(odd.file),
            "line": odd.entry.line,
            "at": odd.entry.now,
            "event": odd.entry.event,
            "logged": {"effects": odd.entry.effects, "digest": odd.entry.digest},
            "replayed": {
                "effects": summary(odd.effects),
                "digest": None if odd.error else digest(odd.effects),
                "error": odd.error,
                "full": [
                    {"effect": type(effect).__name__, "data": effect} for effect in odd.effects
                ],
            },
            "before": [{"at": e.now, "event": e.event, "effects": e.effects} for e in odd.before],
        }
    return shown
