"""What `replay` and `simulate` say to people, as lines. Pure."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

from vram_arbiter.arbiter.eventlog.codec import digest, summary, to_json
from vram_arbiter.arbiter.eventlog.logfile import Entry, engine_id
from vram_arbiter.arbiter.eventlog.replay import Divergence, Replayed
from vram_arbiter.schemas.runtime.printable import makes_printable, printable

WIDTH = 200
"""Longer lines of data are cut."""


@makes_printable
def replay_lines(found: Replayed) -> list[str]:
    """One line if all is the same, else the first divergence with what stood around it."""
    seconds = found.ended_at - found.began_at
    since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found.header.at_wall_s))
    lines = notices(found)
    if found.divergence is not None:
        return [*lines, *_divergence_lines(found, found.divergence)]
    what = f"{found.events} events, identical"
    if found.raised:
        what += f" up to the defect that ended the daemon: {found.raised}"
    policy = found.header.settings.policy
    return [
        *lines,
        f"{what} ({_files(len(found.files))}, {seconds:.1f} s from {since}, policy {policy})",
    ]


def notices(found: Replayed) -> list[str]:
    """What is missing in the log itself."""
    lines = [
        f"note: the last line of {path.name} is torn (a crash or a full disk); replayed up to it"
        for path in found.torn
    ]
    if not found.events:
        lines.append("note: there is no event in it, so nothing was compared")
    if found.gaps:
        lines.append(
            f"note: the recording was interrupted; {found.gaps} new beginning(s), each with the whole state"
        )
    return lines


def _files(count: int) -> str:
    return f"{count} file{'' if count == 1 else 's'}"


def _divergence_lines(found: Replayed, odd: Divergence) -> list[str]:
    lines = [f"event {odd.number} is decided otherwise ({odd.file.name}:{odd.entry.line})"]
    if not found.same_engine:
        lines.append(
            f"the log was recorded by version {found.header.version} (engine {found.header.engine}), this is engine {engine_id()}"
        )
    lines += [f"  before  {_entry(entry)}" for entry in odd.before]
    lines.append(f"  event   {_entry(odd.entry)}")
    logged = odd.entry.effects or "nothing" if odd.entry.digest is not None else "the engine raised"
    lines.append(f"  logged  {logged} [{odd.entry.digest or '-'}]")
    if odd.error:
        return [*lines, f"  now     the engine raises {odd.error}"]
    lines.append(f"  now     {summary(odd.effects) or 'nothing'} [{digest(odd.effects)}]")
    return lines + [
        f"          {_cut(f'{type(effect).__name__} {to_json(effect)}')}" for effect in odd.effects
    ]


def _entry(entry: Entry) -> str:
    return _cut(f"{entry.now:.6f} {type(entry.event).__name__} {to_json(entry.event)}")


def _cut(text: str) -> str:
    return text if len(text) <= WIDTH else text[: WIDTH - 1] + "…"


DECISIONS = frozenset(
    {
        "queued",
        "granted",
        "ready",
        "revoke_asked",
        "deadline_passed",
        "verified",
        "denied",
        "pressure",
        "standby",
        "parked",
    }
)
"""Kinds of notes that a timeline shows."""


@makes_printable
def timeline_lines(
    policy: str, timeline: Sequence[tuple[float, str, Mapping[str, Any]]], limit: int
) -> list[str]:
    """The first decisions of a run, each with its reason."""
    decided = [(at, kind, data) for at, kind, data in timeline if kind in DECISIONS]
    lines = [f"decisions under {policy} (the first {min(limit, len(decided))} of {len(decided)})"]
    for at, kind, data in decided[:limit]:
        why = data.get("reason") or data.get("verdict") or ""
        lines.append(
            _cut(f"{at:9.3f} s  {kind:<12}  {data.get('consumer', ''):<12}  {why}".rstrip())
        )
    return lines


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], left: int = 1) -> list[str]:
    """Columns as wide as their longest cell; all but the first `left` to the right."""
    cells = [[printable(cell) for cell in row] for row in [columns, *rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    return [
        "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
