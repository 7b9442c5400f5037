"""Recorder of the progress model's data: grabs as small wrist pictures, two in five miss.

Each picture is labeled for every object on the table with the progress of a grab of *that* object:
the same picture is progress for one instruction and none for another. The simulator's truth
decides, not time: a grab that stands still makes no progress.
"""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, Final

from training.datasets import write_tries
from training.record_grabs import begin_grab
from vram_arbiter.runner.sim.env import GroundTruth, SimEnv
from vram_arbiter.runner.sim.expert import CLOSED_RAD, GrabExpert
from vram_arbiter.schemas.plain import JsonObject

CAMERA: Final = "wrist"
SIZE_PX: Final = (96, 72)
EVERY: Final = 4  # control steps between two pictures
MAX_STEPS: Final = 110
MISSES: Final = 0.4
REACH_M: Final = 0.20  # farther away a grab has not begun
REACHED: Final = 0.5
TOUCHED: Final = 0.6
LIFTED_FROM: Final = 0.7
LIFT_M: Final = 0.10  # where the arm carries a thing


def progress_of(truth: GroundTruth, gripper: tuple[float, float, float], name: str) -> float:
    """Return the progress of a grab of this object.

    Nearing it counts up to 0.5, both fingers on it 0.6, held 0.7 and, with its height, up to 1.
    """
    thing = truth.objects[name]
    if truth.held == name:
        return LIFTED_FROM + (1 - LIFTED_FROM) * min(1.0, thing.lift_m / LIFT_M)
    if thing.touching_fingers == 2:
        return TOUCHED
    return REACHED * (1 - min(1.0, math.dist(gripper, thing.position_base) / REACH_M))


class Grab:
    """One recorded try: pictures, and of each the objects' progress (0..1) and what is held."""

    def __init__(self) -> None:
        self.images: list[Any] = []
        self.labels: list[JsonObject] = []

    def take(self, env: SimEnv) -> None:
        """Take a picture, and label it."""
        import cv2

        truth, gripper = env.ground_truth(), env.gripper_position()
        image = cv2.resize(env.render(CAMERA), SIZE_PX, interpolation=cv2.INTER_AREA)
        progress = {name: round(progress_of(truth, gripper, name), 4) for name in truth.objects}
        self.images.append(image)
        self.labels.append({"progress": progress, "held": truth.held})


def grab(env: SimEnv, seed: int) -> Grab:
    """Record one try, from the folded pose to the carried one, or to an empty gripper."""
    rng = random.Random(f"progress-{seed}")
    name = begin_grab(env, rng, seed)
    missed = rng.random() < MISSES
    angle, aside = rng.uniform(-math.pi, math.pi), rng.uniform(0.035, 0.055) if missed else 0.0
    offset = (aside * math.cos(angle), aside * math.sin(angle))
    expert = GrabExpert(env, name, offset_m=offset, retry=not missed)
    taken = Grab()
    after = rng.randint(2, 10)
    for step in range(MAX_STEPS):
        if step % EVERY == 0 or expert.done:
            taken.take(env)
        env.step(expert.act())
        after -= expert.done
        if after <= 0:
            break
    here = list(env.joint_state().values())
    sway = [angle + rng.uniform(-0.2, 0.2) for angle in here[:5]]
    for _ in range(6):  # the same end in another pose: what counts is between the fingers
        env.step([*sway, CLOSED_RAD])
    taken.take(env)
    return taken


def record(out: Path, count: int, seed: int) -> JsonObject:
    """Record `count` tries. Returns pictures, and how many of them show a held object."""
    import numpy as np

    with SimEnv() as env:
        tries = [grab(env, seed * 1_000_000 + 700_000 + number) for number in range(count)]
    images = np.stack([image for one in tries for image in one.images])
    labels = [label for one in tries for label in one.labels]
    lengths = [len(one.images) for one in tries]
    columns = {"images": images}
    write_tries(out, "progress", lengths, columns, seed=seed, camera=CAMERA, labels=labels)
    return {"pictures": len(images), "held": sum(label["held"] is not None for label in labels)}
