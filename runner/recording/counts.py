"""Counts of a recording, for the run's result and its last line in the log."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from vram_arbiter.runner.protocols import GoalData
from vram_arbiter.schemas.errors import VramError

log = logging.getLogger("vram_arbiter.runner.recording")


@dataclass(slots=True)
class Counts:
    """Episodes and frames of this run, and what is not among them. May be read on any thread."""

    root: Path
    episodes: int = 0
    frames: int = 0
    discarded: int = 0  # by the operator
    skipped: int = 0  # goals of too few ticks to be an episode
    dropped: int = 0  # ticks
    incomplete: Counter[str] = field(default_factory=Counter)  # ticks without a row, by reason
    error: VramError | None = None  # the last thing that was not recorded

    def lose(self, error: VramError) -> None:
        """Note something that is not recorded."""
        log.error("not recorded: %s", error)
        self.error = error

    def facts(self) -> GoalData:
        """Return the facts of `runner.protocols.TickSink`: `dropped` and `left_out` count ticks,
        `skipped` and `discarded` goals.
        """
        counted = ("episodes", "frames", "discarded", "skipped", "dropped")
        return {
            **{name: getattr(self, name) for name in counted},
            "left_out": sum(self.incomplete.values()),
            "error": self.error.message if self.error is not None else None,
        }

    def summary(self) -> str:
        """Describe what was recorded, and what was not, in one line."""
        others = {
            "episodes were discarded": self.discarded,
            "goals were too short for an episode": self.skipped,
            "ticks were dropped: the writer was too slow, or gone": self.dropped,
            **{f"ticks left out: {reason}": count for reason, count in self.incomplete.items()},
        }
        parts = [f"recorded {self.episodes} episodes, {self.frames} frames into {self.root}"]
        parts += [f"{count} {what}" for what, count in others.items() if count]
        if self.error is not None:
            parts.append(f"NOT ALL WAS RECORDED: {self.error}")
        return "; ".join(parts)
