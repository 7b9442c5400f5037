"""Episodes as a view of the results of a run's ticks.

An episode begins with its reset tick and ends with the first tick that is terminated or truncated.
A run that is stopped before that has an unfinished episode, which does not count.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from vram_arbiter.schemas.world import TickResult

EPISODES_KEPT = 10_000  # a live run may have any number; older ones are counted, no longer listed


@dataclass(frozen=True, slots=True)
class Episode:
    """One finished episode. `total_reward`, `success` None: the environment does not report it."""

    index: int
    steps: int
    success: bool | None
    truncated: bool
    total_reward: float | None = None


class EpisodeView:
    """Takes a run's ticks in order.

    `finished` are the last whole episodes, `count` is their number; `steps` and `total_reward` are
    those of the open one.
    """

    def __init__(self) -> None:
        self.finished: deque[Episode] = deque(maxlen=EPISODES_KEPT)
        self.count = 0
        self._begin()

    def _begin(self) -> None:
        self.steps = 0
        self.total_reward: float | None = None

    def add(self, tick: TickResult) -> None:
        """Ticks without an episode (a runner that has none) are passed over."""
        if tick.episode_idx is None:
            return
        ends = bool(tick.terminated or tick.truncated)
        if tick.step_idx is None and not ends:
            if tick.terminated is None:  # a reset tick: what was open before it never finished
                self._begin()
            return
        self.steps += tick.step_idx is not None
        if tick.reward is not None:
            self.total_reward = (self.total_reward or 0.0) + tick.reward
        if ends:
            self.finished.append(
                Episode(
                    index=tick.episode_idx,
                    steps=self.steps,
                    success=tick.success,
                    truncated=bool(tick.truncated),
                    total_reward=self.total_reward,
                )
            )
            self.count += 1
            self._begin()
