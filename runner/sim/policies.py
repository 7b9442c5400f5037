"""Policies without a model: `random`, and `scripted:MODULE` or `scripted:FILE.py`.

They are for trying worlds out, and the floor of a benchmark. A script has a function `make(env,
seed)` that returns `act(world)`: called once a tick with the world state, it returns an `Action`,
or whatever `env.action_of` turns into one (a number for a Discrete, a row for a Box or the arm's
joints, a map for a Dict), or None when it is done. `env.observation` is the environment's own
observation. The script's code is foreign: what it raises becomes ModelError.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from vram_arbiter.runner.protocols import Act, Done, SkillKey, StepOutcome
from vram_arbiter.runner.sim.environment import Environment
from vram_arbiter.schemas.errors import ConfigError, ModelError, VramError
from vram_arbiter.schemas.world import Action, WorldState

RANDOM: Final = "random"
SCRIPTED: Final = "scripted:"

Step = Callable[[WorldState], Any]
MakeStep = Callable[[Environment, int], Step]


class PolicyPlayer:
    """One episode of such a policy: the part of a skill that the control thread sees."""

    manifest = None
    cameras: tuple[str, ...] = ()
    fraction = 0.0

    def __init__(self, name: str, env: Environment, act: Step) -> None:
        self.key = SkillKey(name)
        self._env = env
        self._act = act

    def wants_frames(self) -> bool:
        return False

    def step(self, world: WorldState) -> StepOutcome:
        """Ask the policy. Raises ModelError for its own errors, and for what is not an action."""
        try:
            raw = self._act(world)
        except VramError:
            raise
        except Exception as error:
            raise ModelError(f"{self.key}: {type(error).__name__}: {error}") from error
        if raw is None:
            return Done()
        return Act(raw if isinstance(raw, Action) else self._env.action_of(raw))


class Policy:
    """A policy that `--policy` names. `play(env, seed)` begins an episode with a fresh player."""

    def __init__(self, name: str, make: MakeStep) -> None:
        self.name = name
        self._make = make

    def play(self, env: Environment, seed: int) -> PolicyPlayer:
        """Begin an episode. Raises ModelError for a script whose `make` raises."""
        try:
            return PolicyPlayer(self.name, env, self._make(env, seed))
        except VramError:
            raise
        except Exception as error:
            raise ModelError(f"{self.name}: make: {type(error).__name__}: {error}") from error


def policy_of(name: str) -> Policy:
    """Return a policy. Raises ConfigError for an unknown one, or a module that cannot be
    imported.
    """
    if name == RANDOM:
        return Policy(name, lambda env, seed: lambda world: env.sample())
    where = name.removeprefix(SCRIPTED)
    if not name.startswith(SCRIPTED) or not where:
        raise ConfigError(
            f"unknown policy {name!r}",
            hint="random, scripted:MODULE, scripted:FILE.py, or expert in so101",
        )
    make = getattr(_load(where), "make", None)
    if not callable(make):
        raise ConfigError(f"{where} has no function `make(env, seed)`")
    return Policy(name, make)


def _load(where: str) -> ModuleType:
    try:
        if not where.endswith(".py"):
            return importlib.import_module(where)
        path = Path(where)
        spec = importlib.util.spec_from_file_location(f"policy_{path.stem}", path)
        if spec is None or spec.loader is None or not path.is_file():
            raise ConfigError(f"script not found: {where}")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses and pickle look there
        spec.loader.exec_module(module)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"the policy {where} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    return module
