"""Closed-loop success rate of a grab policy.

`python -m vram_arbiter.runner.sim.training.evaluate --policy DIR --episodes 40` loads the
checkpoint through lerobot's own factory, as the sidecar does, puts the base where navigation would
leave it, and lets the policy act. The verdict is the simulator's ground truth. Must not know
leases, goals or sockets.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import json
import random
import sys
import time
from pathlib import Path

from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import RestController
from vram_arbiter.runner.sim.tasks import NAVIGATION_ERROR_M, stand_before
from vram_arbiter.runner.sim.training.learned import OWN_POLICIES, LoadedPolicy

MAX_STEPS = 120


@dataclasses.dataclass(frozen=True, slots=True)
class Attempt:
    """How one grab went. `first` is success without, `any` with the retries."""

    seed: int
    name: str
    first: bool
    tries: int
    steps: int
    held: str | None


def attempt(env: SimEnv, policy: LoadedPolicy, seed: int, *, tries: int, error_m: float) -> Attempt:
    """Grab the target of a seed, going to rest and trying again up to `tries` times."""
    env.reset(seed)
    stand_before(env, env.target, random.Random(f"evaluation-{seed}"), error_m=error_m)
    began = env.steps
    for number in range(1, tries + 1):
        policy.reset()
        steps, calm = 0, 0
        while steps < MAX_STEPS and calm < 8:
            for target in policy.chunk(env):
                env.step(target)
                steps += 1
                calm = calm + 1 if env.held_object() == env.target else 0
        if env.held_object() == env.target:
            return Attempt(seed, env.target, number == 1, number, env.steps - began, env.target)
        if number < tries:
            rest = RestController(env.joint_state())
            while not rest.done:
                env.step(rest.act())
            x, _, _ = env.ground_truth().objects[env.target].position_map
            if not 0 <= x - env.config.table_edge_x_m <= env.config.table_depth_m:
                break  # pushed off the table: no retry will find it
            stand_before(
                env, env.target, random.Random(f"evaluation-{seed}-{number}"), error_m=error_m
            )
    return Attempt(seed, env.target, False, tries, env.steps - began, env.held_object())


def main(argv: list[str] | None = None) -> int:
    """Command line of the evaluation."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.runner.sim.training.evaluate", description=__doc__
    )
    parser.add_argument("--policy", type=Path, required=True)
    parser.add_argument(
        "--plugin", default=OWN_POLICIES, help="module that registers the policy type"
    )
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=900_000, help="first scene seed")
    parser.add_argument("--tries", type=int, default=1)
    parser.add_argument(
        "--execute", type=int, help="targets of a chunk to execute (default: the checkpoint's)"
    )
    parser.add_argument(
        "--error-m", type=float, default=NAVIGATION_ERROR_M, help="navigation error, each axis"
    )
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(argv)
    import torch

    torch.set_num_threads(args.threads)
    policy = LoadedPolicy(args.policy, args.plugin, args.execute)
    results: list[Attempt] = []
    began = time.monotonic()
    with SimEnv() as env:
        for number in range(args.episodes):
            done = attempt(env, policy, args.seed + number, tries=args.tries, error_m=args.error_m)
            results.append(done)
            if done.held != done.name:
                print(json.dumps(dataclasses.asdict(done)), flush=True)
    shapes: dict[str, list[int]] = collections.defaultdict(list)
    for one in results:
        shapes[one.name.split()[1]].append(int(one.first))
    summary = {
        "episodes": len(results),
        "first_try": round(sum(r.first for r in results) / len(results), 3),
        "in_all_tries": round(sum(r.held == r.name for r in results) / len(results), 3),
        "tries_allowed": args.tries,
        "execute": policy.execute,
        "by_shape": {k: f"{sum(v)}/{len(v)}" for k, v in sorted(shapes.items())},
        "mean_steps": round(sum(r.steps for r in results) / len(results), 1),
        "seconds": round(time.monotonic() - began, 1),
    }
    print(json.dumps(summary))
    return 0


if __name__ == "__main__":
    sys.exit(main())
