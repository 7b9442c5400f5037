"""Outcome of a simulated run: waits, switches, evictions and bytes per consumer, and their table.

It counts and decides nothing.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Final

from vram_arbiter.arbiter.core.effects import Effect, Note
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.notes import DeniedNote, GrantedNote, RevokeAskedNote, SwitchNote

SHARES: Final = (0.5, 0.99, 1.0)
"""Waits that are shown: the one that this share of the jobs does not exceed."""
STARVED_S = 60.0
"""A job that waits longer than this counts as starved."""
HEAD: Final = (
    "policy", "consumer", "jobs", "unserved", "p50 wait", "p99", "max", f">{STARVED_S:.0f} s",
    "switches", "loads", "evicted", "denied", "OOM", "moved", "peak",
)  # fmt: skip


@dataclass(slots=True)
class Tally:
    """Outcome of one consumer. `waits_s`: from the arrival of a job until its model is there."""

    jobs: int = 0
    unserved: int = 0  # still waiting at the end; their wait so far is in waits_s
    loads: int = 0
    evicted: int = 0
    denied: int = 0
    loaded_bytes: int = 0
    ooms: int = 0
    waits_s: list[float] = field(default_factory=list)

    def wait_s(self, share: float) -> float:
        """Return the wait that this share of the jobs does not exceed."""
        ordered = sorted(self.waits_s)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0


@dataclass(slots=True)
class Outcome:
    """Outcome of one run under one policy."""

    policy: str
    seconds: float
    consumers: dict[str, Tally] = field(default_factory=dict)
    switches: int = 0
    peak_bytes: int = 0
    timeline: list[tuple[float, Note]] = field(default_factory=list)

    def of(self, consumer: str) -> Tally:
        """Return the tally of a consumer."""
        return self.consumers.setdefault(consumer, Tally())

    def watch(self, at_s: float, effects: Sequence[Effect]) -> None:
        """Count notes of the scheduler."""
        for effect in effects:
            if not isinstance(effect, Note):
                continue
            self.timeline.append((at_s, effect))
            consumer = "" if effect.about is None else effect.about.consumer
            match effect.body:
                case GrantedNote(charge_bytes=charge_bytes):
                    self.of(consumer).loads += 1
                    self.of(consumer).loaded_bytes += charge_bytes
                case RevokeAskedNote():
                    self.of(consumer).evicted += 1
                case DeniedNote():
                    self.of(consumer).denied += 1
                case SwitchNote(switched=True):
                    self.switches += 1

    @property
    def total(self) -> Tally:
        """Sum over all consumers."""
        columns = zip(*(asdict(tally).values() for tally in self.consumers.values()), strict=True)
        return Tally(*(sum(column[1:], column[0]) for column in columns))

    def rows(self) -> list[tuple[str, ...]]:
        """Return the row of all, then those of the consumers, in the columns of HEAD."""
        rows = []
        for name, tally in [("", self.total), *sorted(self.consumers.items())]:
            starved = sum(wait > STARVED_S for wait in tally.waits_s)
            waits = [f"{tally.wait_s(share):.1f} s" for share in SHARES]
            moved, peak = format_bytes(tally.loaded_bytes), format_bytes(self.peak_bytes)
            counts = [tally.loads, tally.evicted, tally.denied, tally.ooms, moved]
            last = ["", *counts, ""] if name else [self.switches, *counts, peak]
            cells = [self.policy, name, tally.jobs, tally.unserved, *waits, starved, *last]
            rows.append(tuple(map(str, cells)))
        return rows


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the rows of several runs in columns as wide as their longest cell."""
    rows = [HEAD, *(row for outcome in outcomes for row in outcome.rows())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
    return "\n".join(lines)
