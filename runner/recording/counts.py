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
    last_frames: int = 0  # of the last episode

    def finished(self, goal_id: str, episode: int, frames: int) -> None:
        """Count an episode."""
        self.episodes += 1
        self.frames += frames
        self.last_frames = frames
        log.info("goal %s is episode %d, %d frames", goal_id, episode, frames)

    def discard(self, goal_id: str, *, finished: bool) -> None:
        """Count an episode that the operator discarded; `finished`: it was counted already."""
        self.discarded += 1
        if finished:
            self.episodes -= 1
            self.frames -= self.last_frames
        log.info("the episode of goal %s is discarded", goal_id)

    def skip(self, goal_id: str, reason: str) -> None:
        """Count a goal that did not become an episode."""
        self.skipped += 1
        log.warning("goal %s is not recorded: %s", goal_id, reason)

    def lose(self, error: VramError) -> None:
        """Note something that is not recorded."""
        if self.error is None or self.error.message != error.message:
            log.error("not recorded: %s", error)
        self.error = error

    def facts(self) -> GoalData:
        """Return the facts of `runner.protocols.TickSink`: `dropped` and `left_out` count ticks,
        `skipped` and `discarded` goals.
        """
        return {
            "episodes": self.episodes,
            "frames": self.frames,
            "discarded": self.discarded,
            "skipped": self.skipped,
            "dropped": self.dropped,
            "left_out": sum(self.incomplete.values()),
            "error": self.error.message if self.error is not None else None,
        }

    def summary(self) -> str:
        """Describe what was recorded, and what was not, in one line."""
        parts = [f"recorded {self.episodes} episodes, {self.frames} frames into {self.root}"]
        if self.discarded:
            parts.append(f"{self.discarded} episodes were discarded")
        if self.skipped:
            parts.append(f"{self.skipped} goals were too short for an episode")
        if self.dropped:
            parts.append(f"{self.dropped} ticks were dropped: the writer was too slow, or gone")
        parts += [f"{count} ticks left out: {reason}" for reason, count in self.incomplete.items()]
        if self.error is not None:
            parts.append(f"NOT ALL WAS RECORDED: {self.error}")
        return "; ".join(parts)
