"""Change of hands within a goal: from its skill to the operator's teleoperator, and back.

The skill is finished as at a goal's end: nothing of it is in flight while the operator moves the
robot, so its use of the lease ends, and another model may have the GPU. Giving back starts it again
for the same goal: the model is loaded if it is gone, and looks at the robot anew. The goal, its
gate, its deadline and its recording go on all the while. Must not know a socket.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.protocols import Done, Goal, Hold, Paced, Skill, SkillKey, StepOutcome
from vram_arbiter.schemas.errors import BadState, InternalError, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import WorldState

log = logging.getLogger(__name__)

SKILL, CHANGING, OPERATOR, STARTING = "running", "changing hands", "operator", "starting"


class Relay:
    """What has the robot during one goal: its skill, the operator's, or neither, which holds.

    `key` and `manifest` are the goal's. `acting` and `ended` are set on the control thread.
    """

    def __init__(self, skill: Skill) -> None:
        self._skill = skill
        self.acting: Skill | None = skill
        self.ended = False  # by the operator

    @property
    def manifest(self) -> RSkillManifest | None:
        return self._skill.manifest

    @property
    def key(self) -> SkillKey:
        return self._skill.key

    @property
    def cameras(self) -> tuple[str, ...]:
        return self.acting.cameras if self.acting is not None else ()

    @property
    def fraction(self) -> float:
        return self._skill.fraction

    def wants_frames(self) -> bool:
        return self.acting is not None and self.acting.wants_frames()

    def step(self, world: WorldState) -> StepOutcome:
        if self.ended:
            return Done({"ended_by": "operator"})
        return Hold("the robot changes hands") if self.acting is None else self.acting.step(world)

    def withheld(self) -> None:
        """See `runner.protocols.Paced`."""
        if isinstance(self.acting, Paced):
            self.acting.withheld()


@dataclass(kw_only=True)
class TakeOver:
    """Hands of one goal that runs. Event loop; one change at a time, which `close` cuts off.

    `start` and `finish` are those of a goal's skill. `show` is told SKILL, CHANGING, OPERATOR or
    STARTING. `fail` ends the goal. `operated`: the goal is the operator's own.
    """

    control: ControlThread
    goal: Goal
    skill: Skill
    start: Callable[[Skill, Goal], Awaitable[None]]
    finish: Callable[[Skill], Awaitable[None]]
    show: Callable[[str], None]
    fail: Callable[[VramError], None]
    operated: bool

    def __post_init__(self) -> None:
        self.relay = Relay(self.skill)
        self._hands = OPERATOR if self.operated else SKILL
        self._teleop: Skill | None = None
        self._change: asyncio.Task[None] | None = None

    async def take(self, teleop: Skill) -> None:
        """Give the robot to the operator; return once it follows.

        Raises BadState, and what the teleoperator's start raises: then the skill goes on.
        """
        self._require(SKILL, "the operator has the robot already, or it changes hands")
        self._hands = CHANGING
        change = self._change = asyncio.create_task(self._taken(teleop))
        await asyncio.wait([change])
        if change.cancelled():
            raise BadState(f"goal {self.goal.goal_id} ended meanwhile")
        change.result()

    def give_back(self) -> None:
        """Let the robot hold, and start its skill again. Raises BadState."""
        self._require(OPERATOR, "the operator does not have the robot")
        if self.operated:
            hint = "end the goal instead"
            raise BadState(f"goal {self.goal.goal_id} has no other skill", hint=hint)
        self._hands = STARTING
        self._change = asyncio.create_task(self._given_back())

    async def end(self) -> None:
        """End the goal as done. Raises BadState unless the operator has the robot."""
        self._require(OPERATOR, "the operator does not have the robot")

        def ended() -> None:
            self.relay.ended = True

        await self.control.call(ended)

    async def close(self) -> None:
        """Cut off a change, and finish the operator's skill. Repeatable."""
        if self._change is not None:
            self._change.cancel()
            await asyncio.gather(self._change, return_exceptions=True)
        if self._teleop is not None:
            await self.finish(self._teleop)

    # -- steps
    def _require(self, hands: str, otherwise: str) -> None:
        if self._hands != hands:
            raise BadState(f"goal {self.goal.goal_id}: {otherwise}")

    async def _taken(self, teleop: Skill) -> None:
        self._teleop = teleop
        try:
            await self.start(teleop, self.goal)
        except BaseException:
            self._hands = SKILL
            raise
        await self._act(None, CHANGING)
        await asyncio.shield(self.finish(self.skill))  # half a finish would leave its use
        await self._act(teleop, OPERATOR)

    async def _given_back(self) -> None:
        await self._act(None, STARTING)
        if self._teleop is not None:
            await self.finish(self._teleop)
        try:
            await self.start(self.skill, replace(self.goal, from_here=True))
        except VramError as error:
            self.fail(error)
        except Exception as error:
            log.exception("%s cannot go on", self.skill.key)
            self.fail(InternalError(f"{type(error).__name__}: {error}"))
        else:
            await self._act(self.skill, SKILL)

    async def _act(self, skill: Skill | None, hands: str) -> None:
        def acts() -> None:
            self.relay.acting = skill

        await self.control.call(acts)
        self._hands = hands
        self.show(hands)
