"""Writer of the progress model's data: `python -m vram_arbiter.runner.sim.training.progress --out
DIR`.

Grabs of the scripted expert, two in five made to miss, as small wrist pictures, and for every
object on the table the progress of a grab of *that* object: the same picture is progress for one
instruction and none for another. The simulator's truth decides, not time: a grab that stands still
makes no progress. The trainer lives in `sidecars/` and meets this program on files only.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import random
import sys
import time
from pathlib import Path
from typing import Any, Final

from vram_arbiter.runner.sim.config import REST_POSE
from vram_arbiter.runner.sim.env import GroundTruth, SimEnv
from vram_arbiter.runner.sim.expert import CLOSED_RAD, GrabExpert
from vram_arbiter.runner.sim.kinematics import ArmKinematics
from vram_arbiter.runner.sim.tasks import stand_before

FORMAT: Final = "grab-progress/1"
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


@dataclasses.dataclass(slots=True)
class Grab:
    """One recorded try: pictures, and by object name its progress (0..1) and whether it is held.

    One value per picture.
    """

    images: list[Any]
    progress: dict[str, list[float]]
    held: dict[str, list[bool]]


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


def record(env: SimEnv, kinematics: ArmKinematics, seed: int) -> Grab:
    """Record one try, from the folded pose to the carried one, or to an empty gripper."""
    rng = random.Random(f"progress-{seed}")
    env.reset(seed)
    name = rng.choice(env.layout.objects).name
    stand_before(env, name, rng)
    env.place(env.base_pose(), [angle + rng.uniform(-0.06, 0.06) for angle in REST_POSE])
    missed = rng.random() < MISSES
    angle, aside = rng.uniform(-math.pi, math.pi), rng.uniform(0.035, 0.055) if missed else 0.0
    offset = (aside * math.cos(angle), aside * math.sin(angle))
    expert = GrabExpert(env, kinematics, name, offset_m=offset, retry=not missed)
    names = [item.name for item in env.layout.objects]
    grab = Grab([], {item: [] for item in names}, {item: [] for item in names})
    after = rng.randint(2, 10)
    for step in range(MAX_STEPS):
        if step % EVERY == 0 or expert.done:
            _take(env, grab)
        env.step(expert.act())
        after -= expert.done
        if after <= 0:
            break
    here = list(env.joint_state().values())
    sway = [angle + rng.uniform(-0.2, 0.2) for angle in here[:5]]
    for _ in range(6):  # the same end in another pose: what counts is between the fingers
        env.step([*sway, CLOSED_RAD])
    _take(env, grab)
    return grab


def _take(env: SimEnv, grab: Grab) -> None:
    import cv2

    truth, gripper = env.ground_truth(), env.gripper_position()
    grab.images.append(cv2.resize(env.render(CAMERA), SIZE_PX, interpolation=cv2.INTER_AREA))
    for name in grab.progress:
        grab.progress[name].append(round(progress_of(truth, gripper, name), 4))
        grab.held[name].append(truth.held == name)


def write(out: Path, episodes: int, seed: int) -> dict[str, int]:
    """Record tries into `out`.

    Returns the number of pictures, and of those that show a held object.
    """
    import numpy as np

    out.mkdir(parents=True, exist_ok=True)
    grabs = []
    with SimEnv() as env:
        kinematics = ArmKinematics(env.config)
        for number in range(episodes):
            grabs.append(record(env, kinematics, seed * 1_000_000 + 700_000 + number))
    np.save(out / "images.npy", np.stack([image for grab in grabs for image in grab.images]))
    info = {
        "format": FORMAT,
        "camera": CAMERA,
        "seed": seed,
        "episodes": [
            {"length": len(grab.images), "progress": grab.progress, "held": grab.held}
            for grab in grabs
        ],
    }
    (out / "info.json").write_text(json.dumps(info) + "\n", encoding="utf-8")
    held = sum(any(row) for grab in grabs for row in zip(*grab.held.values(), strict=True))
    return {"pictures": sum(len(grab.images) for grab in grabs), "held": held}


def main(argv: list[str] | None = None) -> int:
    """Command line of the writer."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.runner.sim.training.progress",
        description="Write training data.",
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=240)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    began = time.monotonic()
    counts = write(args.out, args.episodes, args.seed)
    print(
        json.dumps({"out": str(args.out), **counts, "seconds": round(time.monotonic() - began, 1)})
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
