"""Streak of withheld actions: its first cause, and its counts by cause.

The first cause is what is wrong; later ones may follow from it (a target that moves on while the
robot stands still becomes too fast). Must not know skills, robots or goals.
"""

from __future__ import annotations

import logging
import re
from collections import Counter

log = logging.getLogger(__name__)

LATE = "it came too late"
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def cause_of(reason: str) -> str:
    """Return a reason without its numbers: the same cause has the same text in every tick."""
    return _NUMBER.sub("…", reason)


class Streak:
    """Withheld actions of one goal, one after the other. Logs where it begins and where it ends."""

    def __init__(self, goal_id: str) -> None:
        self._goal_id = goal_id
        self.first = ""  # reason of the first one; empty: none is withheld
        self.actions = 0  # that a skill asked for; ticks in which it was not asked do not count
        self.causes: Counter[str] = Counter()

    def add(self, reason: str, *, asked: bool) -> None:
        """Count a withheld tick. `asked`: the skill was asked, and gave an action."""
        if not self.first:
            self.first = reason
            log.warning("goal %s: actions are withheld: %s", self._goal_id, reason)
        self.actions += asked
        self.causes[cause_of(reason)] += 1

    def end(self, what: str) -> None:
        """End the streak, if there is one. `what` says why, for the log."""
        if self.first:
            counts = "; ".join(f"{count} × {cause}" for cause, count in self.causes.most_common())
            log.warning(
                "goal %s: %s after %d withheld: %s",
                self._goal_id,
                what,
                self.causes.total(),
                counts,
            )
        self.first, self.actions = "", 0
        self.causes.clear()
