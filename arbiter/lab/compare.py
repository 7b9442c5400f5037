"""One workload under several policies of the engine, and the tables that compare them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.eventlog.text import cut
from vram_arbiter.arbiter.lab.gpu import START_S
from vram_arbiter.arbiter.lab.outcome import SHARES, Outcome
from vram_arbiter.arbiter.lab.simulator import simulate
from vram_arbiter.arbiter.lab.workload import Workload
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.printable import makes_printable, printable
from vram_arbiter.schemas.sizes import format_bytes

DECISIONS = frozenset(
    ("queued", "granted", "ready", "revoke_asked", "deadline_passed", "verified", "denied")
) | {"pressure", "standby", "parked"}
"""Kinds of notes that a timeline shows."""
STARVED_S = 60.0
"""A job that waits longer than this counts as starved."""


def under(workload: Workload, settings: Settings, policy: str) -> Outcome:
    """Simulate a workload under one policy of the engine."""
    return simulate(workload, Arbiter(replace(settings, policy=policy), START_S), policy)


def tables(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the figures of each run, then of each consumer under each policy."""
    return [*total_lines(outcomes), "", *consumer_lines(outcomes)]


def total_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per run with the figures for a choice."""
    rows = []
    for outcome in outcomes:
        total = outcome.total
        starved = sum(wait > STARVED_S for wait in total.waits_s)
        waits = (f"{total.wait_s(share):.1f} s" for share in SHARES.values())
        counts = (outcome.switches, total.loads, total.denied, total.ooms)
        sizes = (format_bytes(total.loaded_bytes), format_bytes(outcome.peak_bytes))
        rows.append((outcome.policy, total.jobs, total.unserved, *waits, starved, *counts, *sizes))
    head = ("policy", "jobs", "unserved", "p50 wait", "p99", "max", f">{STARVED_S:.0f} s")
    return table((*head, "switches", "loads", "denied", "OOM", "moved", "peak"), rows)


def consumer_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return every consumer under every policy, side by side."""
    rows = []
    for name in sorted({name for outcome in outcomes for name in outcome.consumers}):
        for outcome in outcomes:
            tally = outcome.of(name)
            waits = (f"{tally.wait_s(share):.1f} s" for share in SHARES.values())
            counts = (tally.loads, tally.evicted, tally.denied, format_bytes(tally.loaded_bytes))
            whose = (name, outcome.policy, tally.jobs, tally.unserved)
            rows.append((*whose, *waits, *counts, tally.ooms))
    head = ("consumer", "policy", "jobs", "unserved", "p50", "p99", "max")
    return table((*head, "loads", "evicted", "denied", "moved", "OOM"), rows, left=2)


def check_lines(logged: Outcome, again: Outcome) -> list[str]:
    """Return the simulator's own error: the logged policy, simulated on the log's workload, beside
    the log's outcome."""
    then, now = logged.total, again.total
    waits = (
        f"{name} wait {now.wait_s(share):.2f} s ({then.wait_s(share):.2f} s)"
        for name, share in SHARES.items()
    )
    return [
        "this is a simulation: arrivals, uses and loads are the log's, everything that depends on "
        "a decision is simulated",
        f"its own error, by simulating the logged policy ({logged.policy}): switches "
        f"{again.switches} (logged {logged.switches}), loads {now.loads} ({then.loads}), "
        + ", ".join(waits),
    ]


# -- decisions
def timeline(outcome: Outcome, limit: int) -> JsonObject:
    """Return the first decisions of a run for `--json`."""
    shown = [{"at_s": at, **words.event(note)} for at, note in _decided(outcome)[:limit]]
    return {"timeline": shown} if limit else {}


@makes_printable
def timeline_lines(outcome: Outcome, limit: int) -> list[str]:
    """Return the first decisions of a run, each with its reason."""
    decided = _decided(outcome)
    first = f"(the first {min(limit, len(decided))} of {len(decided)})"
    lines = [f"decisions under {outcome.policy} {first}"]
    for at, note in decided[:limit]:
        event = words.event(note)
        why = event.get("reason") or event.get("verdict") or ""
        lines.append(
            cut(f"{at:9.3f} s  {note.kind:<12}  {event.get('consumer', ''):<12}  {why}".rstrip())
        )
    return lines


def _decided(outcome: Outcome) -> list[tuple[float, Note]]:
    return [(at, note) for at, note in outcome.timeline if note.kind in DECISIONS]


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
