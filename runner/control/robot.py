"""What the control loop needs of a robot, be it hardware or a simulated world.

Shapes only. `robots.hardware.HardwareRobot` and `sim.robot.SimRobot` implement `Robot`; neither
knows the loop.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from vram_arbiter.runner.protocols import (
    GoalData,
    Picture,
    SafetyGate,
    SkillEnded,
    Stepped,
)
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.world import Action, WorldState


@dataclass(frozen=True, slots=True)
class StaleInput:
    """An input of the skill that is too old to act on. `error` ends the goal."""

    problem: str
    first: bool  # of an uninterrupted series of ticks with a stale input
    error: VramError | None = None


@dataclass(frozen=True, slots=True)
class Sensed:
    """Outcome of sensing; the world state itself is `Robot.world`.

    `ended` says that the skill loses the robot, `problem` goes into the tick's violations.
    """

    sensors_ms: float = 0.0
    world_state_ms: float = 0.0
    stale: StaleInput | None = None
    ended: SkillEnded | None = None
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Applied:
    """Outcome of applying an action, or of a reset.

    `ended` says that the skill loses the robot, `problem` goes into the run's violations.
    """

    action_applied: bool = False
    step_idx: int | None = None
    episode_idx: int | None = None
    terminated: bool | None = None
    truncated: bool | None = None
    success: bool | None = None
    ended: SkillEnded | None = None
    problem: str = ""


class Robot(Protocol):
    """Hardware or a simulated world. All calls on the control thread.

    `world` is the newest state and is replaced whole, so that the event loop may read it.
    """

    world: WorldState | None

    # -- life
    def open(self, stopping: threading.Event) -> None:
        """Acquire what a run needs. Raises when it cannot, Cancelled once `stopping` is set."""
        ...

    def close(self) -> None:
        """Free everything. Repeatable."""
        ...

    # -- one tick
    @property
    def reset_due(self) -> bool:
        """Whether the next tick prepares a scene: it takes no work and asks no skill."""
        ...

    def reset(self) -> Applied:
        """Prepare the scene of the next episode."""
        ...

    def sense(self, skill: Stepped | None, *, followed: bool) -> Sensed:
        """Read the sensors and replace `world`.

        Args: `skill` is the one that will be asked; `followed` demands the frames of all cameras.
        """
        ...

    def apply(self, action: Action | None, *, skill_active: bool) -> Applied:
        """Carry out an action that passed the gate; None holds."""
        ...

    # -- safety
    def admit(self, skill: Stepped) -> SafetyGate:
        """Return the gate for one goal of this skill.

        Raises ConfigError for an envelope that cannot be kept, GoalRejected for missing cameras.
        """
        ...

    def stop(self) -> None:
        """Stop the motors for the latched emergency stop. Repeatable."""
        ...

    # -- for recordings and reports
    def targets(self) -> Mapping[str, float]:
        """Return the joint targets in force, rad by joint; joints without a target are missing."""
        ...

    def facts(self) -> GoalData:
        """Return what the run's result says of the robot."""
        ...

    # -- cameras
    def camera_names(self) -> tuple[str, ...]:
        """Return the observation cameras, the default one first."""
        ...

    def snapshot(self, camera: str, max_age_s: float) -> Picture:
        """Return a picture no older than `max_age_s`. Raises FrameStale, BadRequest."""
        ...
