"""Recorder of labeled frames of the Panda's wrist camera: scripted grabs at the kitchen counter."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from training.record_scenes import Shot, shoot, write
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.config import CONTROL_DT_S
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.navigate import standoff_pose
from vram_arbiter.runner.sim.worlds import panda_world
from vram_arbiter.runner.skills.actions import Stepper
from vram_arbiter.runner.skills.motion import action_of, joint_positions
from vram_arbiter.runner.skills.wiring import wire_up
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.schemas.world import Action
from vram_arbiter.sidecars.adapters.scripted_pick import ADAPTER, ScriptedPickAdapter

MANIFEST: Final = Path(__file__).parents[1] / "configs/rskills/panda-grab/rskill.yaml"
CHUNKS: Final = 20  # a pick ends within these
OPEN_STEPS: Final = 90  # the fingers seldom close before
MISSES: Final = 0.5
SWAYS_RAD: Final = (0.0, 0.1, 0.2, 0.1, 0.2, 0.3)  # arm poses of one hold: around its own


def pick(
    world: ArmEnvironment, manifest: RSkillManifest, policy: ScriptedPickAdapter, name: str
) -> Iterator[Action]:
    """Yield the actions of a scripted pick, each to be played before the next is asked for.

    Observations, chunks and rows are those of a goal; socket and gate are left out.
    """
    import numpy as np

    env = world.arm
    wiring = wire_up(manifest, world.robot, world.robot.rest_pose_rad)
    speeds = world.limits_for(manifest).speeds_rad_s
    stepper = Stepper(
        wiring.actions, world.robot, wiring.model, period_s=CONTROL_DT_S,
        longest={joint: speed * CONTROL_DT_S * 0.98 for joint, speed in speeds.items()},
    )  # fmt: skip
    for _ in range(CHUNKS):
        seen = world.observe(round(env.time_s * 1e9), None)
        measured = joint_positions(seen, world.robot.joint_names)
        observation = {
            "observation.state": np.array(wiring.state.vector(seen, measured, wiring.model)),
            "observation.images.front": env.render("front"),
            "task": f"grab the {name}",
        }
        call = EndpointCall(endpoint="get_action", data={"observation": observation})
        for row in wiring.actions.rows(policy.run(call)["action"]):
            start = world.sent()
            step = stepper.step(row, start)
            targets = {joint: step.targets.get(joint, start[joint]) for joint in wiring.joints}
            yield action_of(targets, 0, step.twist)


def missing(rng: random.Random, manifest: RSkillManifest) -> RSkillManifest:
    """Return the skill with a camera believed elsewhere: it closes beside or above the object."""
    setup: dict[str, Any] = dict(manifest.policy_extras[ADAPTER])  # type: ignore[arg-type]
    if rng.random() < 0.6:
        angle, reach = rng.uniform(-math.pi, math.pi), rng.uniform(0.045, 0.07)
        x, y, z = setup["pos_m"]
        setup["pos_m"] = (x + reach * math.cos(angle), y + reach * math.sin(angle), z)
        x, y, z = setup["look_at_m"]
        setup["look_at_m"] = (x + reach * math.cos(angle), y + reach * math.sin(angle), z)
    else:
        setup["low_z_m"] += rng.uniform(0.04, 0.07)
    return manifest.model_copy(update={"policy_extras": manifest.policy_extras | {ADAPTER: setup}})


def clear(env: SimEnv) -> bool:
    """Return whether a picture tells what is held: nothing is between the fingers but not yet
    lifted.
    """
    truth = env.ground_truth()
    return all(
        thing.touching_fingers < 2 or thing.name == truth.held for thing in truth.objects.values()
    )


def stand_before(env: SimEnv, name: str, rng: random.Random) -> None:
    """Put the base where an imperfect navigation would have left it in front of an object."""
    x, y, _ = env.ground_truth().objects[name].position_map
    goal = standoff_pose((x, y), env.config)
    aside = [rng.uniform(-0.03, 0.03) for _ in range(2)]
    turned = goal.yaw_rad + rng.uniform(-0.08, 0.08)
    env.place((goal.x_m + aside[0], goal.y_m + aside[1], turned))


def shots(world: ArmEnvironment, manifest: RSkillManifest, seed: int) -> Iterator[Shot]:
    """Yield the frames of one layout: start, way, grabbing, after. Half of the grabs misses.

    Views of a hold cost little beside the grab, and are what the model is asked about most.
    """
    env, rng = world.arm, random.Random(f"counter-{seed}")
    world.reset(seed)
    yield shoot(env, "wrist", "start")
    far = env.config.table_edge_x_m
    env.place((rng.uniform(-0.1, far - 0.55), rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3)))
    yield shoot(env, "wrist", "way")
    name = rng.choice(env.layout.objects).name
    stand_before(env, name, rng)
    skill = missing(rng, manifest) if rng.random() < MISSES else manifest
    during = {rng.randrange(OPEN_STEPS), rng.randrange(OPEN_STEPS)}
    for number, action in enumerate(pick(world, skill, ScriptedPickAdapter(skill), name)):
        world.step(action)
        if number in during and clear(env):
            yield shoot(env, "wrist", "grabbing")
    # the same hold in other arm poses, seen from elsewhere
    lifted: dict[str, Any] = dict(world.sent())
    for sway in SWAYS_RAD:
        pose = {joint: angle + rng.uniform(-sway, sway) for joint, angle in lifted.items()}
        pose["panda_gripper"] = lifted["panda_gripper"]
        turn = (rng.uniform(-0.2, 0.0), rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.3))
        for _ in range(12):
            world.step(action_of(pose, 0, None))
            env.step(None, turn)
        if clear(env):
            yield shoot(env, "wrist", "after")


def record(out: Path, count: int, seed: int) -> JsonObject:
    """Write `count` labeled frames; as `record_scenes.record`."""
    world, manifest = panda_world(None), load_manifest(MANIFEST)
    try:
        return write(out, count, seed, lambda layout: shots(world, manifest, layout))
    finally:
        world.arm.close()
