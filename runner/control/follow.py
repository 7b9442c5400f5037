"""Tell a recorder of a goal's ticks and of its end, in this order."""

from __future__ import annotations

from collections.abc import Callable

from vram_arbiter.runner.protocols import Goal, GoalData, GoalTick, SkillEnded, TickSink


class GoalFollower:
    """Forwards goals to `sinks`. A goal that ends within a tick is reported after that tick."""

    def __init__(self) -> None:
        self.sinks: tuple[TickSink, ...] = ()  # complete before the first goal
        self._asked: Goal | None = None  # the goal whose skill this tick asked
        self._over: tuple[Goal, SkillEnded | None] | None = None

    def goal_asked(self, goal: Goal) -> None:
        """Note that this tick asks the skill of `goal`."""
        self._asked = goal

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        """Report the end of a goal; `ended` None: the robot was taken back."""
        if self._asked is goal:  # its last tick is still to come
            self._over = (goal, ended)
        else:
            self._tell_end(goal, ended)

    def facts(self) -> GoalData:
        """Return the facts of all sinks."""
        return {name: fact for sink in self.sinks for name, fact in sink.facts().items()}

    def tick_over(self, goal_tick: Callable[[Goal], GoalTick | None]) -> None:
        """Report the tick that just ended. `goal_tick` builds its record; None: there is none."""
        asked, self._asked = self._asked, None
        over, self._over = self._over, None
        if self.sinks and asked is not None and (tick := goal_tick(asked)) is not None:
            for sink in self.sinks:
                sink.tick(tick)
        if over is not None:
            self._tell_end(*over)

    def _tell_end(self, goal: Goal, ended: SkillEnded | None) -> None:
        for sink in self.sinks:
            sink.goal_ended(goal, ended)
