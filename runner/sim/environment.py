"""`Environment`: what `SimRunner` needs of a simulator, whatever it simulates.

`runner.sim.arm_env.ArmEnvironment` is our SO-101 scene, `runner.sim.gym_env.GymEnv` any gymnasium environment. All calls on one thread, the one
that made it. Nothing is filled in: what an environment does not tell is missing in its world state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from vram_arbiter.runner.protocols import SafetyGate, Stepped
from vram_arbiter.schemas.world import Action, CameraModel, SensorFrame, WorldState


@dataclass(frozen=True, slots=True)
class EnvStep:
    """What one step came to. None: this environment does not say.

    `moved` False: time stood still, because there was no action and this world has no way to wait. `success` is what is so now, not only
    at the end. `unearned`: whoever does nothing has this success, as long as the episode goes on; it takes one that is played to its end.
    """

    reward: float | None = None
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    moved: bool = True
    unearned: bool = False


class Environment(Protocol):
    """One simulated world. `reset` begins an episode that follows from the seed alone; it comes before everything else.

    Raises EnvironmentFailed for what goes wrong inside; the world is then of no use before the next reset.
    """

    def reset(self, seed: int) -> None: ...

    def observe(self, stamp_ns: int, frames: Mapping[str, SensorFrame] | None) -> WorldState:
        """The state now, with the frames that the caller took. Raises pydantic's ValidationError for numbers that are not finite."""
        ...

    def shown(self) -> Mapping[str, float] | None:
        """What it observes, in numbers, by name and in its own units, for recordings; None for a robot: that is its joint state. Raises
        EnvironmentFailed."""
        ...

    @property
    def acted(self) -> Mapping[str, float]:
        """What the last step was given, by name and in its own units; empty for a robot, and where time stood still."""
        ...

    def step(self, action: Action | None) -> EnvStep:
        """One period with a one-step action that has passed `gate`; None holds."""
        ...

    def gate(self, skill: Stepped) -> SafetyGate:
        """What every action of a skill passes before `step`, over all resets. Raises ConfigError for an envelope that cannot be kept here."""
        ...

    def action_of(self, raw: Any) -> Action:
        """An action from what a scripted policy returns. Raises ModelError for what cannot be one."""
        ...

    def sample(self) -> Action:
        """An action at random, within the limits; the sequence follows from the seed of the reset."""
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
