"""Tell a recorder of a goal's ticks and of its end, in this order."""

from __future__ import annotations

from collections.abc import Callable

from vram_arbiter.runner.protocols import Goal, GoalTick, SkillEnded, TickSink


class GoalFollower:
    """Forwards goals to `sink`. A goal that ends within a tick is reported after that tick."""

    def __init__(self) -> None:
        self.sink: TickSink | None = None  # set it before the first goal
        self._asked: Goal | None = None  # the goal whose skill this tick asked
        self._over: tuple[Goal, SkillEnded | None] | None = None

    def goal_asked(self, goal: Goal) -> None:
        """Note that this tick asks the skill of `goal`."""
        self._asked = goal

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        """Report the end of a goal; `ended` None: the robot was taken back."""
        if self.sink is None:
            return
        if self._asked is goal:  # its last tick is still to come
            self._over = (goal, ended)
        else:
            self.sink.goal_ended(goal, ended)

    def tick_over(self, goal_tick: Callable[[Goal], GoalTick | None]) -> None:
        """Report the tick that just ended. `goal_tick` builds its record; None: there is none."""
        asked, self._asked = self._asked, None
        over, self._over = self._over, None
        if self.sink is None:
            return
        if asked is not None and (tick := goal_tick(asked)) is not None:
            self.sink.tick(tick)
        if over is not None:
            self.sink.goal_ended(*over)
