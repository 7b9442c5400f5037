"""One workload under several policies, and the tables that compare them.

The policies are the engine's own and the ports of other programs' rules.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.core.settings import SCHEDULING, Settings
from vram_arbiter.arbiter.eventlog.text import cut
from vram_arbiter.arbiter.lab.actors import START_S
from vram_arbiter.arbiter.lab.outcome import Outcome, Tally
from vram_arbiter.arbiter.lab.rules import RULES
from vram_arbiter.arbiter.lab.simulator import simulate
from vram_arbiter.arbiter.lab.workload import Workload
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.errors import CallerError
from vram_arbiter.schemas.runtime.printable import makes_printable, printable
from vram_arbiter.schemas.sizes import format_bytes

POLICIES = (*SCHEDULING, *RULES)
"""Every name that `--policy` takes: first the engine's, then the ports."""
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
STARVED_S = 60.0
"""A job that waits longer than this counts as starved."""


class UnknownPolicy(CallerError):
    code = "bad_request"


def under(workload: Workload, settings: Settings, policy: str) -> Outcome:
    """Simulate a workload under one policy. Raises UnknownPolicy."""
    if policy in SCHEDULING:
        return simulate(workload, Arbiter(replace(settings, policy=policy), START_S), policy)
    if policy in RULES:
        return simulate(workload, RULES[policy](workload.cards), policy, holders_exit=True)
    raise UnknownPolicy(f"unknown policy {policy!r}", hint=f"known: {', '.join(POLICIES)}")


def starved(tally: Tally) -> int:
    return sum(1 for wait in tally.waits_s if wait > STARVED_S)


_COLUMNS = ("jobs", "unserved", "p50", "p99", "max", "loads", "evicted", "denied", "moved", "OOM")


def total_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per run with the figures for a choice."""
    rows = []
    for outcome in outcomes:
        total = outcome.total
        rows.append(
            (
                outcome.policy,
                total.jobs,
                total.unserved,
                f"{total.wait_s(0.5):.1f} s",
                f"{total.wait_s(0.99):.1f} s",
                f"{total.wait_s(1.0):.1f} s",
                starved(total),
                outcome.switches,
                total.loads,
                total.denied,
                total.ooms,
                format_bytes(total.loaded_bytes),
                format_bytes(outcome.peak_bytes),
            )
        )
    head = (
        "policy",
        "jobs",
        "unserved",
        "p50 wait",
        "p99",
        "max",
        f">{STARVED_S:.0f} s",
        "switches",
        "loads",
    )
    return table((*head, "denied", "OOM", "moved", "peak"), rows)


def consumer_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return every consumer under every policy, side by side."""
    names = sorted({name for outcome in outcomes for name in outcome.consumers})
    rows = []
    for name in names:
        for outcome in outcomes:
            tally = outcome.of(name)
            rows.append((name, outcome.policy, *_cells(tally)))
    return table(("consumer", "policy", *_COLUMNS), rows, left=2)


def check_lines(logged: Outcome, again: Outcome) -> list[str]:
    """Return the simulator's own error.

    The logged policy is simulated on the log's workload and compared with the log's outcome.
    """
    then, now = logged.total, again.total
    return [
        "this is a simulation: arrivals, uses and loads are the log's, everything that depends on "
        "a decision is simulated",
        f"its own error, by simulating the logged policy ({logged.policy}): switches "
        f"{again.switches} (logged {logged.switches}), "
        f"loads {now.loads} ({then.loads}), p50 wait {now.wait_s(0.5):.2f} s "
        f"({then.wait_s(0.5):.2f} s), "
        f"p99 {now.wait_s(0.99):.2f} s ({then.wait_s(0.99):.2f} s), max {now.wait_s(1.0):.2f} s "
        f"({then.wait_s(1.0):.2f} s)",
    ]


def _cells(tally: Tally) -> tuple[Any, ...]:
    waits = (f"{tally.wait_s(share):.1f} s" for share in (0.5, 0.99, 1.0))
    counts = (
        tally.loads,
        tally.evicted,
        tally.denied,
        format_bytes(tally.loaded_bytes),
        tally.ooms,
    )
    return (tally.jobs, tally.unserved, *waits, *counts)


# -- lines ----------------------------------------------------------------------------------------
@makes_printable
def timeline_lines(policy: str, timeline: Sequence[tuple[float, Note]], limit: int) -> list[str]:
    """Return the first decisions of a run, each with its reason."""
    decided = [(at, note) for at, note in timeline if note.kind in DECISIONS]
    lines = [f"decisions under {policy} (the first {min(limit, len(decided))} of {len(decided)})"]
    for at, note in decided[:limit]:
        event = words.event(note)
        why = event.get("reason") or event.get("verdict") or ""
        lines.append(
            cut(f"{at:9.3f} s  {note.kind:<12}  {event.get('consumer', ''):<12}  {why}".rstrip())
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
