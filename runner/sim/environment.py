"""`Environment`: interface of the simulators behind `SimRobot`.

`runner.sim.arm_env.ArmEnvironment` is our SO-101 scene, `runner.sim.gym_env.GymEnv` any gymnasium
environment. All calls on the thread that made it. Nothing is filled in: what an environment does
not report is missing in its world state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from vram_arbiter.runner.protocols import SafetyGate, Stepped
from vram_arbiter.schemas.world import Action, CameraModel, SensorFrame, WorldState


@dataclass(frozen=True, slots=True)
class EnvStep:
    """Outcome of one step. None: the environment does not report it.

    `moved` False: time stood still, because there was no action and this world cannot wait.
    `success` holds now, not only at the end. `unearned`: doing nothing has this success while the
    episode goes on; it counts only when the episode is played to its end.
    """

    reward: float | None = None
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    moved: bool = True
    unearned: bool = False


class Environment(Protocol):
    """One simulated world.

    `reset` begins an episode that follows from the seed alone; call it first.

    Raises EnvironmentFailed for errors inside; the world is then unusable until the next reset.
    """

    def reset(self, seed: int) -> None: ...

    def observe(self, stamp_ns: int, frames: Mapping[str, SensorFrame] | None) -> WorldState:
        """Return the state with the caller's frames.

        Raises pydantic's ValidationError if it is not finite.
        """
        ...

    def shown(self) -> Mapping[str, float] | None:
        """Return the observed numbers by name, in the world's own units, for recordings.

        None for a robot, whose joint state is recorded. Raises EnvironmentFailed.
        """
        ...

    @property
    def acted(self) -> Mapping[str, float]:
        """Numbers of the last action, by name and in the world's own units.

        Empty for a robot, and where time stood still.
        """
        ...

    def step(self, action: Action | None) -> EnvStep:
        """Step one period with a one-step action that has passed `gate`; None holds."""
        ...

    def gate(self, skill: Stepped) -> SafetyGate:
        """Return the gate of a skill's actions, over all resets.

        Raises ConfigError for an envelope that cannot be enforced here.
        """
        ...

    def action_of(self, raw: Any) -> Action:
        """Convert the result of a scripted policy. Raises ModelError for what cannot be an
        action.
        """
        ...

    def sample(self) -> Action:
        """Return a random action within the limits; the sequence follows from the seed of the
        reset.
        """
        ...

    @property
    def observation(self) -> Any:
        """What the environment itself calls its observation, for scripted policies."""
        ...

    @property
    def targets(self) -> Mapping[str, float]:
        """Joint targets in force, rad by joint; empty where actions are something else."""
        ...

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras for skills, the default one first; known after the first reset."""
        ...

    @property
    def clock_text(self) -> str:
        """How far the episode is, for a video's caption."""
        ...

    def render(self, camera: str) -> Any:
        """RGB, uint8, height × width × 3. Raises KeyError for an unknown camera."""
        ...

    def camera_model(self, camera: str) -> CameraModel | None: ...

    def close(self) -> None: ...
