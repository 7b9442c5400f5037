"""An event log as the history would have told it: events with wall times, leases at its beginning,
and readings of the GPUs. For programs that draw it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect, Note
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.arbiter.eventlog import text
from vram_arbiter.arbiter.eventlog.logfile import Entry, LogFile
from vram_arbiter.arbiter.eventlog.replay import engine_of, replay
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.wire.views import LeaseView


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Leases at the beginning of a file that does not follow the one before it."""

    at_wall_s: float
    leases: tuple[LeaseView, ...]


@dataclass(frozen=True, slots=True)
class LogStory:
    """`readings`: (wall seconds, GPU, bytes in use) where they changed."""

    begin_wall_s: float
    end_wall_s: float
    gpus: tuple[GpuInfo, ...]
    events: tuple[JsonObject, ...]
    snapshots: tuple[Snapshot, ...]
    readings: tuple[tuple[float, str, int], ...]
    notices: tuple[str, ...]


def story(files: Sequence[LogFile]) -> LogStory:
    """Read a log through the engine once more. Raises LogError.

    A log of another engine is told as this engine decides on its events; a notice says so.
    """
    first = files[0].header
    offset_s = first.at_wall_s - first.now
    events: list[JsonObject] = []
    readings: list[tuple[float, str, int]] = []
    used: dict[str, int] = {}

    def see(arbiter: Arbiter, entry: Entry, effects: Sequence[Effect]) -> None:
        at_s, event = entry.now + offset_s, entry.event
        if isinstance(event, MemorySampled) and used.get(event.gpu) != event.used_bytes:
            used[event.gpu] = event.used_bytes
            readings.append((at_s, event.gpu, event.used_bytes))
        notes = (effect for effect in effects if isinstance(effect, Note))
        events.extend({"at_wall_s": at_s, "kind": note.kind, **words.event(note)} for note in notes)

    found = replay(files, see, to_the_end=True)
    notices = text.notices(found)
    if found.divergence is not None:
        notices.append(f"note: from event {found.divergence.number} on this version decides anew")
    return LogStory(
        begin_wall_s=first.at_wall_s,
        end_wall_s=found.ended_at + offset_s,
        gpus=tuple(first.settings.gpus),
        events=tuple(events),
        snapshots=tuple(_beginnings(files, offset_s)),
        readings=tuple(readings),
        notices=tuple(notices),
    )


def _beginnings(files: Sequence[LogFile], offset_s: float) -> list[Snapshot]:
    """Return the leases of each file that begins with a state of its own."""
    found: list[Any] = []
    for at, file in enumerate(files):
        header = file.header
        if header.state is not None and (at == 0 or header.cause == "resumed"):
            leases = engine_of(header).status(header.now).leases
            found.append(Snapshot(header.now + offset_s, leases))
    return found
