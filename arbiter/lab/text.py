"""Lines that the laboratory prints."""

from collections.abc import Mapping, Sequence
from typing import Any

from vram_arbiter.arbiter.eventlog.text import cut
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.runtime.printable import makes_printable, printable

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
    """Return the first decisions of a run, each with its reason."""
    decided = [(at, kind, data) for at, kind, data in timeline if kind in DECISIONS]
    lines = [f"decisions under {policy} (the first {min(limit, len(decided))} of {len(decided)})"]
    for at, kind, data in decided[:limit]:
        why = words.event(kind, data).get("reason") or data.get("verdict") or ""
        lines.append(
            cut(f"{at:9.3f} s  {kind:<12}  {data.get('consumer', ''):<12}  {why}".rstrip())
        )
    return lines


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], left: int = 1) -> list[str]:
    """Return rows in columns as wide as their longest cell, all but the first `left` to
    the right."""
    cells = [[printable(cell) for cell in row] for row in [columns, *rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    return [
        "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
