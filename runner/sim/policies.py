"""Policies without a model, as skills: `random`, `expert`, `scripted:FILE`.

They are the floor and the ceiling of a benchmark. A script has a function `make(env, seed)` that
returns `act(world)`: called once a tick with the world state, it returns an `Action`, or joint
targets that `env.action_of` turns into one (a row, or a map by joint), or None when it is done. The
script's code is foreign: what it raises becomes ModelError.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, cast

from vram_arbiter.runner.protocols import Act, Done, Goal, SkillKey, StepOutcome
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.schemas.errors import ConfigError, ModelError, VramError
from vram_arbiter.schemas.world import Action, WorldState

RANDOM: Final = "random"
EXPERT: Final = "expert"
SCRIPTED: Final = "scripted:"
AFTER_STEPS: Final = 8  # that the expert holds what it has lifted

Step = Callable[[WorldState], Any]
MakeStep = Callable[[ArmEnvironment, int], Step]


class PolicySkill:
    """One such policy; `make` begins it anew in every episode, on the control thread."""

    manifest = None
    holds_gpu = False
    cameras: tuple[str, ...] = ()
    fraction = 0.0
    phase = ""

    def __init__(self, name: str, make: MakeStep, env: ArmEnvironment) -> None:
        self.key = SkillKey(name)
        self._make = make
        self._env = env
        self._act: Step | None = None

    async def start(self, goal: Goal) -> None:
        self._act = None

    async def finish(self) -> None: ...

    async def release(self) -> None: ...

    def wants_frames(self) -> bool:
        return False

    def step(self, world: WorldState) -> StepOutcome:
        """Ask the policy. Raises ModelError for its own errors, and for what is not an action."""
        try:
            if self._act is None:
                self._act = self._make(self._env, self._env.seed)
            raw = self._act(world)
        except VramError:
            raise
        except Exception as error:
            raise ModelError(f"{self.key}: {type(error).__name__}: {error}") from error
        if raw is None:
            return Done()
        return Act(raw if isinstance(raw, Action) else self._env.action_of(raw))


def policy_of(name: str) -> MakeStep:
    """Return what begins a policy. Raises ConfigError for an unknown one, or a script that cannot
    be run.
    """
    if name == RANDOM:
        return lambda env, seed: lambda world: env.sample()
    if name == EXPERT:
        return _expert
    where = name.removeprefix(SCRIPTED)
    if not name.startswith(SCRIPTED) or not where:
        raise ConfigError(f"unknown policy {name!r}", hint="random, expert or scripted:FILE")
    return _scripted(where)


def _expert(env: ArmEnvironment, seed: int) -> Step:
    """Begin the scripted grab of the demonstrations, which reads the ground truth."""
    from vram_arbiter.runner.sim.expert import GrabExpert

    expert = GrabExpert(env.arm, env.arm.target)
    after = 0

    def act(_: WorldState) -> list[float] | None:
        nonlocal after
        after += expert.done
        # its targets lead the arm, as those of a policy that learnt from it do
        return None if after > AFTER_STEPS else env.toward(expert.act())

    return act


def _scripted(where: str) -> MakeStep:
    """Return the function `make` of a script."""
    if not Path(where).is_file():
        raise ConfigError(f"script not found: {where}")
    try:
        make = runpy.run_path(where, run_name=f"policy_{Path(where).stem}").get("make")
    except Exception as error:
        raise ConfigError(
            f"the policy {where} cannot be run: {type(error).__name__}: {error}"
        ) from error
    if not callable(make):
        raise ConfigError(f"{where} has no function `make(env, seed)`")
    return cast("MakeStep", make)
