"""Outcomes of seeds, and their sums. Pure: must not know who plays them, nor files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Final

from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonObject

ERRORS_IN_A_ROW_MAX: Final = 3  # a missing sidecar will not be there for the next seed either


@dataclass(frozen=True, slots=True)
class SeedOutcome:
    """Outcome of one seed. `success` None: `error` tells why there is no verdict.

    An error of the contestant while it plays (`model_error`) is a failure; any other error (a
    missing sidecar, an environment that raised, a worker that died) is not a verdict.
    """

    seed: int
    success: bool | None
    steps: int = 0
    truncated: bool = False
    error: str = ""
    message: str = ""
    seconds: float = 0.0
    standing_steps: int = 0  # of `steps`: in the middle of the motion, without an action
    video: str | None = None  # below the folder of the run
    trace_id: str | None = None  # of its span; None without telemetry
    node: str = ""  # name of the machine that played it

    @property
    def verdict(self) -> str:
        return {True: "success", False: "failure", None: "error"}[self.success]

    def __str__(self) -> str:
        said = f"{self.verdict} after {self.steps} steps"
        return said + (f" ({self.message})" if self.message else "")


def unplayed(seed: int, why: str) -> SeedOutcome:
    """Return the outcome of a seed that could not be played to its end."""
    return SeedOutcome(seed, None, error=VramError.code, message=why)


@dataclass(slots=True)
class Cell:
    """All episodes of one contestant in one world. `complete` False: stopped, or abandoned
    (`why`).
    """

    world: str
    contestant: str
    task: str | None
    revision: str = ""
    episodes: list[SeedOutcome] = field(default_factory=list)
    complete: bool = False
    why: str = ""

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{file_name(self.world)}_{file_name(self.contestant)}"

    def summary(self) -> JsonObject:
        """Sums, as they go into the report."""
        ran = [played for played in self.episodes if played.success is not None]
        stepped = [played for played in ran if played.steps]  # lerobot-eval does not tell them
        successes = sum(played.success is True for played in ran)
        return {
            "world": self.world,
            "contestant": self.contestant,
            "revision": self.revision,
            "task": self.task,
            "complete": self.complete,
            "why": self.why,
            "played": len(self.episodes),
            "judged": len(ran),
            "successes": successes,
            "errors": len(self.episodes) - len(ran),
            "success_rate": successes / len(ran) if ran else None,
            "interval_95": wilson(successes, len(ran)),
            "mean_steps": fmean(one.steps for one in stepped) if stepped else None,
            "mean_standing_steps": fmean(one.standing_steps for one in stepped)
            if stepped
            else None,
        }


def wilson(successes: int, of: int) -> tuple[float, float] | None:
    """Return Wilson's 95 % interval of a success rate; None without episodes.

    It is sensible for few episodes, and for zero or all successes.
    """
    if of == 0:
        return None
    from scipy.stats import binomtest

    interval = binomtest(successes, of).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def given_up(played: Sequence[SeedOutcome]) -> str:
    """Return why no more seeds are worth playing after these, in the order of their ends; empty: go
    on.
    """
    last = played[-ERRORS_IN_A_ROW_MAX:]
    if len(last) < ERRORS_IN_A_ROW_MAX or any(one.success is not None for one in last):
        return ""
    return f"given up after {len(last)} errors in a row: {last[-1].message}"


def file_name(text: str) -> str:
    """Return a file name for any text."""
    return re.sub(r"[^A-Za-z0-9.-]+", "-", text).strip("-.")
