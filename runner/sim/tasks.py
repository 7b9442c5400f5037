"""Tasks of episodes in our own scene, for benchmarks: set-up, goal and verdict.

Both tasks are about the seed's target object; the verdict is the simulator's ground truth, which no
skill sees.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from vram_arbiter.runner.protocols import GoalParams
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.config import REST_POSE
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.navigate import standoff_pose
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import RSkillManifest

HELD_STEPS: Final = 8  # a thing that is held this long, above the table, does not slip out any more
STANDS_M: Final = 0.03  # of the grasp spot: what the grab policy was trained to make up for
NAVIGATION_ERROR_M: Final = 0.035
NAVIGATION_ERROR_RAD: Final = 0.10


@dataclass(frozen=True, slots=True)
class Task:
    """One task.

    `actions` are those of a manifest that ask for it. `prepare` follows `reset(seed)`. `steady`:
    the episode is over after this many steps in a row with a positive verdict; 0: when the skill
    ends.
    """

    name: str
    actions: frozenset[str]
    judge: Callable[[SimEnv], bool]
    steady: int
    prepare: Callable[[SimEnv, int], None] | None
    told: Callable[[SimEnv], tuple[str, GoalParams]]
    """Prompt and goal parameters."""


def stand_before(
    env: SimEnv, name: str, rng: random.Random, *, error_m: float = NAVIGATION_ERROR_M
) -> None:
    """Put the base where an imperfect navigation would have left it in front of an object."""
    x, y, _ = env.ground_truth().objects[name].position_map
    goal = standoff_pose((x, y), env.config)
    env.place(
        (
            min(
                goal.x_m + rng.uniform(-error_m, error_m), standoff_pose((9.0, 0.0), env.config).x_m
            ),
            goal.y_m + rng.uniform(-error_m, error_m),
            goal.yaw_rad + rng.uniform(-NAVIGATION_ERROR_RAD, NAVIGATION_ERROR_RAD),
        ),
        REST_POSE,
    )
    for _ in range(3):
        env.step(None)


def _stand(env: SimEnv, seed: int) -> None:
    """Put the base where navigation leaves it: before the target, a few centimeters off."""
    stand_before(env, env.target, random.Random(f"benchmark-{seed}"))


def _target_point(env: SimEnv) -> GoalParams:
    x, y, z = env.ground_truth().objects[env.target].position_base
    return {"target_point": {"x": x, "y": y, "z": z}}


def _stands_before(env: SimEnv) -> bool:
    x, y, _ = env.ground_truth().objects[env.target].position_base
    return math.dist((x, y), env.config.grasp_spot_in_base_m) < STANDS_M


GRAB = Task(
    name="grab",
    actions=frozenset({"grasp", "pick"}),
    judge=lambda env: env.held_object() == env.target,
    steady=HELD_STEPS,
    prepare=_stand,
    told=lambda env: (f"grab the {env.target}", {}),
)
NAVIGATE = Task(
    name="navigate",
    actions=frozenset({"navigate"}),
    judge=_stands_before,
    steady=0,
    prepare=None,
    told=lambda env: (f"go to the {env.target}", _target_point(env)),
)
TASKS: Final = {task.name: task for task in (GRAB, NAVIGATE)}


def task_of(manifest: RSkillManifest) -> Task:
    """Return the task that fits a skill. Raises ConfigError when none does, or several."""
    fitting = [task for task in TASKS.values() if task.actions & set(manifest.actions)]
    if len(fitting) != 1:
        raise ConfigError(
            f"which task is {manifest.name} for? Its actions are {', '.join(manifest.actions)}",
            hint=f"--task {' or --task '.join(TASKS)}",
        )
    return fitting[0]


def set_task(task: Task, world: ArmEnvironment) -> None:
    """Let the episodes of our own scene be about a task, from the next reset on."""
    arm, prepare = world.arm, task.prepare
    world.about(
        prepare=None if prepare is None else lambda seed: prepare(arm, seed),
        judge=lambda: task.judge(arm),
        steady=task.steady,
    )
