"""Outcome of a run, logged or simulated: waits, switches, evictions and bytes, per consumer.

It counts and decides nothing.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Final

from vram_arbiter.arbiter.core.effects import Effect, Note
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.wire.notes import DeniedNote, GrantedNote, RevokeAskedNote, SwitchNote

SHARES: Final = {"p50": 0.5, "p99": 0.99, "max": 1.0}
"""Waits that are shown: the one that this share of the jobs does not exceed."""


@dataclass(slots=True)
class Tally:
    """Outcome of one consumer."""

    jobs: int = 0
    unserved: int = 0  # still waiting at the end; their wait so far is in waits_s
    loads: int = 0
    evicted: int = 0
    denied: int = 0
    loaded_bytes: int = 0
    ooms: int = 0
    waits_s: list[float] = field(default_factory=list)
    """From the arrival of a job until its model is there; 0 if it was."""

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
        return self.consumers.setdefault(consumer, Tally())

    def watch(self, at_s: float, effects: Sequence[Effect]) -> None:
        """Count notes of the engine."""
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
        """Of all consumers."""
        columns = zip(*(asdict(tally).values() for tally in self.consumers.values()), strict=True)
        return Tally(*(sum(column[1:], column[0]) for column in columns))


def as_plain(outcome: Outcome) -> JsonObject:
    """Return the outcome for `--json`, without the timeline."""
    return {
        "policy": outcome.policy,
        "seconds": outcome.seconds,
        "switches": outcome.switches,
        "peak_bytes": outcome.peak_bytes,
        "total": _plain_tally(outcome.total),
        "consumers": {
            name: _plain_tally(tally) for name, tally in sorted(outcome.consumers.items())
        },
    }


def _plain_tally(tally: Tally) -> JsonObject:
    counts = asdict(tally)
    del counts["waits_s"]
    return counts | {f"wait_{name}_s": tally.wait_s(share) for name, share in SHARES.items()}
