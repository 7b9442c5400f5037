"""Lines that `vramctl replay` prints."""

import time

from vram_arbiter.arbiter.eventlog.codec import digest, summary, to_json
from vram_arbiter.arbiter.eventlog.logfile import Entry, engine_id
from vram_arbiter.arbiter.eventlog.replay import Divergence, Replayed
from vram_arbiter.schemas.runtime.printable import makes_printable

WIDTH = 200
"""Longer lines of data are cut."""


@makes_printable
def replay_lines(found: Replayed) -> list[str]:
    """Return one line if every decision is the same, else the first divergence in its context."""
    seconds = found.ended_at - found.began_at
    since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found.header.at_wall_s))
    lines = notices(found)
    if found.divergence is not None:
        return [*lines, *_divergence_lines(found, found.divergence)]
    what = f"{found.events} events, identical"
    if found.raised:
        what += f" up to the defect that ended the daemon: {found.raised}"
    return [
        *lines,
        f"{what} ({_files(len(found.files))}, {seconds:.1f} s from {since})",
    ]


def notices(found: Replayed) -> list[str]:
    """Return what is missing in the log itself."""
    lines = [
        f"note: the last line of {path.name} is torn (a crash or a full disk); replayed up to it"
        for path in found.torn
    ]
    if not found.events:
        lines.append("note: the log has no events, so nothing was compared")
    if found.gaps:
        lines.append(
            f"note: the recording was interrupted; "
            f"{found.gaps} new beginning(s), each with the whole state"
        )
    return lines


def _files(count: int) -> str:
    return f"{count} file{'' if count == 1 else 's'}"


def _divergence_lines(found: Replayed, odd: Divergence) -> list[str]:
    lines = [f"event {odd.number} is decided otherwise ({odd.file.name}:{odd.entry.line})"]
    if not found.same_engine:
        lines.append(
            f"the log was recorded by version {found.header.version} "
            f"(engine {found.header.engine}), this is engine {engine_id()}"
        )
    lines += [f"  before  {_entry(entry)}" for entry in odd.before]
    lines.append(f"  event   {_entry(odd.entry)}")
    logged = odd.entry.effects or "nothing" if odd.entry.digest is not None else "the engine raised"
    lines.append(f"  logged  {logged} [{odd.entry.digest or '-'}]")
    if odd.error:
        return [*lines, f"  now     the engine raises {odd.error}"]
    lines.append(f"  now     {summary(odd.effects) or 'nothing'} [{digest(odd.effects)}]")
    return lines + [
        f"          {cut(f'{type(effect).__name__} {to_json(effect)}')}" for effect in odd.effects
    ]


def _entry(entry: Entry) -> str:
    return cut(f"{entry.now:.6f} {type(entry.event).__name__} {to_json(entry.event)}")


def cut(text: str) -> str:
    """Shorten a line of data to WIDTH."""
    return text if len(text) <= WIDTH else text[: WIDTH - 1] + "…"
