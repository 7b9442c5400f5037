"""Skill of the operator: the robot follows lerobot's teleoperator, through the gate of its goal.

After a start or a gap the leader is somewhere else than the robot: the robot then goes to the
leader's pose at ALIGN_RAD_S, and follows at the joints' own speed once it was there. An action that
the gate withholds halves the next step. A teleoperator that stops answering is a stale input: the
robot holds, and the goal fails after STALE_FAIL_S.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.protocols import Act, Goal, Hold, StepOutcome
from vram_arbiter.runner.robots.teleoperators import Teleoperator
from vram_arbiter.runner.safety.limits import Limits
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.motion import action_of, bounded, joint_positions
from vram_arbiter.schemas.errors import StateStale
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import WorldState

ALIGN_RAD_S = 0.5  # a person sees where the arm is going, and can stop it
STEP_SHARE = 0.98  # of the longest step: rounding must not reach the gate
STALE_FAIL_S = 1.0  # as for a joint state or a camera
PACE_MIN = 1 / 64  # of a step that keeps being withheld
PACE_GAIN = 1.25  # by which steps grow again
NAME = "vram-arbiter/teleop"
INTERFACE = "vram_arbiter/Teleoperate"

MANIFEST = RSkillManifest.model_validate(
    {
        "name": NAME,
        "version": "1.0.0",
        "license": "apache-2.0",
        "kind": "ros_action",  # of no ROS server: this runner stands in for its interface
        "role": "s2",  # planners are offered s1 alone: no model calls the operator to work
        "embodiment_tags": ["any"],
        "actuators_required": [
            {"kind": "joint_position", "control_mode_semantics": {"mode": "absolute"}}
        ],
        "chunk_size": 1,
        "latency_budget": {"per_chunk_ms": 1000.0, "max_execution_s": 3600.0},
        "description": "The operator moves the robot by the teleoperator of its file.",
        "actions": ["generalist"],
        "ros_integration": {
            "package": "vram_arbiter",
            "interface_type": "Teleoperate",
            "interface_name": "/teleoperate",
            "default_goal_json": "{}",
        },
    }
)


class Teleop(SkillBase):
    """`limits` are the robot's: ranges and speeds by joint. `sent` are the motors' last targets."""

    def __init__(
        self,
        manifest: RSkillManifest,
        teleoperator: Teleoperator,
        limits: Limits,
        *,
        period_s: float,
        sent: Callable[[], Mapping[str, float]],
    ) -> None:
        super().__init__(manifest)
        self._teleoperator = teleoperator
        self._ranges = limits.joints_rad
        self._period_s = period_s
        self._longest = {
            name: STEP_SHARE * speed * period_s for name, speed in limits.speeds_rad_s.items()
        }
        self._sent = sent
        self._clock = SystemClock()
        self._aligned = False  # the robot was where the leader is
        self._moving = False  # the motors have a target of ours
        self._pace = 1.0
        self._stale_since_s: float | None = None

    async def _start(self, goal: Goal) -> None:
        await asyncio.to_thread(self._teleoperator.start)
        self._stand()
        self._stale_since_s = None

    async def _release(self) -> None:
        await asyncio.to_thread(self._teleoperator.stop)

    # -- control thread
    def withheld(self) -> None:
        """See `runner.protocols.Paced`."""
        self._pace = max(self._pace / 2, PACE_MIN)

    def _stand(self) -> None:
        """Begin the next motion anew."""
        self._aligned = self._moving = False
        self._pace = 1.0

    def _step(self, world: WorldState) -> StepOutcome:
        try:
            wanted = self._teleoperator.pose()
        except StateStale as error:
            return self._hold(error)
        self._stale_since_s = None
        here = joint_positions(world, tuple(self._ranges))
        if self._moving:
            here.update({name: value for name, value in self._sent().items() if name in here})
        there = {
            name: min(max(wanted.get(name, value), self._ranges[name][0]), self._ranges[name][1])
            for name, value in here.items()
        }
        targets = {
            name: bounded(value, there[name], self._reach(name)) for name, value in here.items()
        }
        self._aligned = self._aligned or (self._teleoperator.leads and targets == there)
        self._moving = True
        self._pace = min(1.0, self._pace * PACE_GAIN)
        return Act(action_of(targets, world.stamp_ns), operator=True)

    def _reach(self, name: str) -> float:
        """Return how far a joint may go in this tick, rad."""
        longest = self._longest[name]
        if not self._aligned:
            longest = min(longest, ALIGN_RAD_S * self._period_s)
        return self._pace * longest

    def _hold(self, error: StateStale) -> StepOutcome:
        self._stand()
        now_s = self._clock.now_s()
        if self._stale_since_s is None:
            self._stale_since_s = now_s
        if now_s - self._stale_since_s >= STALE_FAIL_S:
            raise error
        return Hold(error.message, operator=True)
