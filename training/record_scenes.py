"""Recorder of labeled frames: what the front and wrist cameras see in an episode of the table."""

from __future__ import annotations

import itertools
import json
import math
import random
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from training.datasets import LABELS
from vram_arbiter.runner.sim.config import REST_POSE
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import CLOSED_RAD, GrabExpert
from vram_arbiter.runner.sim.tasks import stand_before
from vram_arbiter.schemas.plain import JsonObject

LEAST_PIXELS: Final = 20  # of an object that shows at all
MISSES: Final = 0.34
type Shot = tuple[Any, JsonObject]
"""RGB image and its label."""


def shoot(env: SimEnv, camera: str, stage: str) -> Shot:
    """Render a camera, and label what is in the picture."""
    seen = env.seen_objects(camera)
    objects = []
    for thing in env.layout.objects:
        found = seen.get(thing.name)
        shows = found is not None and found.pixels >= LEAST_PIXELS
        objects.append(
            {
                "name": thing.name,
                "box": list(found.box) if found is not None and shows else None,
                "pixels": found.pixels if found is not None else 0,
            }
        )
    return env.render(camera), {
        "camera": camera, "seed": env.layout.seed, "stage": stage, "objects": objects,
        "held": env.held_object(),
    }  # fmt: skip


def shots(env: SimEnv, seed: int) -> Iterator[Shot]:
    """Yield all frames of one layout: start, way, standoff, grabbing, after.

    A third of the grabs is made to miss, so that a closed gripper, or one above an object, does not
    imply that it holds the object.
    """
    rng = random.Random(f"captures-{seed}")
    env.reset(seed)
    yield shoot(env, "front", "start")
    far = env.config.table_edge_x_m
    env.place(
        (rng.uniform(-0.10, far - 0.35), rng.uniform(-0.25, 0.25), rng.uniform(-0.25, 0.25)),
        [a + rng.uniform(-0.08, 0.08) for a in REST_POSE],
    )
    yield shoot(env, "front", "way")
    name = rng.choice(env.layout.objects).name
    stand_before(env, name, rng)
    yield from both(env, "standoff")
    angle, miss = rng.uniform(-math.pi, math.pi), rng.random() < MISSES
    reach = rng.uniform(0.040, 0.055) if miss else 0.0
    aside = (reach * math.cos(angle), reach * math.sin(angle))
    expert = GrabExpert(env, name, offset_m=aside, retry=not miss)
    during = rng.randint(5, 35)
    for step in range(90):
        env.step(expert.act())
        if step == during:
            yield from both(env, "grabbing")
        if expert.done:
            break
    for _ in range(6):
        env.step(expert.act())
    yield from both(env, "after")
    # the same hold in another arm pose, seen from elsewhere on the way back
    pose = list(env.joint_state().values())
    sway = [a + rng.uniform(-0.2, 0.2) for a in pose[:4]]
    sway += [pose[4] + rng.uniform(-0.5, 0.5), CLOSED_RAD]
    turn = (rng.uniform(-0.1, 0.0), rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.3))
    for _ in range(12):
        env.step(sway, turn)
    yield from both(env, "after")


def both(env: SimEnv, stage: str) -> Iterator[Shot]:
    """Yield a frame of each camera."""
    yield shoot(env, "front", stage)
    yield shoot(env, "wrist", stage)


def record(out: Path, count: int, seed: int) -> JsonObject:
    """Write `count` labeled frames. Returns how many show a held object.

    Raises OSError when it cannot.
    """
    with SimEnv() as env:
        return write(out, count, seed, lambda layout: shots(env, layout))


def write(out: Path, count: int, seed: int, of: Callable[[int], Iterable[Shot]]) -> JsonObject:
    """Write the first `count` frames of the layouts that follow from `seed`; as `record`."""
    import cv2

    (out / "images").mkdir(parents=True, exist_ok=True)
    written = held = 0
    frames = (shot for layout in itertools.count(seed * 1_000_000) for shot in of(layout))
    with (out / LABELS).open("w", encoding="utf-8") as labels:
        for image, label in itertools.islice(frames, count):
            file = f"images/{written:06d}_{label['camera']}.png"
            fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
            if not cv2.imwrite(str(out / file), image[..., ::-1], fast):
                raise OSError(f"cannot write {out / file}")
            labels.write(json.dumps({"file": file, **label}) + "\n")
            held += label["held"] is not None
            written += 1
    return {"frames": written, "held": held}
