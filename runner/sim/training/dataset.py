"""Writer of training data: `python -m vram_arbiter.runner.sim.training.dataset grab|scenes --out
DIR`.

`scenes`: PNG frames of the front and wrist cameras and `labels.jsonl`, one JSON object per frame
(boxes, names, what is held). `grab`: demonstrations as plain .npy arrays and `info.json`, because a
step is two tiny images and six numbers: random access by index is all the trainer needs, and a
video codec would blur objects that are twelve pixels wide. The programs meet on files only:
trainers live in `sidecars/`, which never imports the runner.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import random
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE, SceneConfig
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import CLOSED_RAD, GrabExpert
from vram_arbiter.runner.sim.kinematics import ArmKinematics
from vram_arbiter.runner.sim.tasks import stand_before
from vram_arbiter.runner.sim.training.learned import LoadedPolicy
from vram_arbiter.schemas.plain import JsonObject

# Views of the grab policy: crops as fractions of the image (x0, y0, x1, y1), and the size they are
# averaged down to.
VIEWS: Final[dict[str, tuple[tuple[float, float, float, float], tuple[int, int]]]] = {
    "front": ((0.45, 0.20, 0.85, 0.7333333333), (96, 96)),
    "wrist": ((0.10, 0.0, 1.0, 1.0), (96, 80)),
}
MIN_VISIBLE_PIXELS: Final = 20
MAX_STEPS: Final = 120


@dataclasses.dataclass(frozen=True, slots=True)
class Capture:
    """One frame of the scene dataset: camera, the RGB image and its label."""

    image: Any
    label: JsonObject


def policy_view(image: Any, camera: str) -> Any:
    """Return the crop of an RGB image that the grab policy sees, averaged down; uint8."""
    import cv2

    (x0, y0, x1, y1), size = VIEWS[camera]
    height, width = image.shape[:2]
    crop = image[round(y0 * height) : round(y1 * height), round(x0 * width) : round(x1 * width)]
    return cv2.resize(crop, size, interpolation=cv2.INTER_AREA)


# -- scenes
def capture(env: SimEnv, camera: str, stage: str) -> Capture:
    """Render a camera and label what is in the picture."""
    truth = env.ground_truth()
    seen = env.seen_objects(camera)
    objects = []
    for item in env.layout.objects:
        found = seen.get(item.name)
        visible = found is not None and found.pixels >= MIN_VISIBLE_PIXELS
        objects.append(
            {
                "name": item.name,
                "colour": item.colour,
                "shape": item.shape,
                "box": list(found.box) if found is not None and visible else None,
                "pixels": found.pixels if found is not None else 0,
                "visible": visible,
                "position_base": list(truth.objects[item.name].position_base),
                "held": truth.held == item.name,
            }
        )
    gripper = env.joint_state()["gripper"]
    label = {
        "camera": camera,
        "seed": env.layout.seed,
        "stage": stage,
        "objects": objects,
        "held": truth.held,
        "gripper_rad": gripper,
        "base_pose": list(truth.base_pose),
        "joints": list(env.joint_state().values()),
        "camera_model": env.camera_model(camera).model_dump(),
    }
    return Capture(env.render(camera), label)


def scene_captures(env: SimEnv, kinematics: ArmKinematics, seed: int) -> Iterator[Capture]:
    """Yield all frames of one layout: at the start, on the way, before an object, grabbing, and
    after.

    A third of the grabs is made to miss, so that a closed gripper, or one above an object, does not
    imply that it holds the object.
    """
    rng = random.Random(f"captures-{seed}")
    env.reset(seed)
    yield capture(env, "front", "start")
    far = env.config.table_edge_x_m
    env.place(
        (rng.uniform(-0.10, far - 0.35), rng.uniform(-0.25, 0.25), rng.uniform(-0.25, 0.25)),
        [a + rng.uniform(-0.08, 0.08) for a in REST_POSE],
    )
    yield capture(env, "front", "way")
    name = rng.choice(env.layout.objects).name
    stand_before(env, name, rng)
    yield capture(env, "front", "standoff")
    yield capture(env, "wrist", "standoff")
    angle, miss = rng.uniform(-math.pi, math.pi), rng.random() < 0.34
    reach = rng.uniform(0.040, 0.055) if miss else 0.0
    expert = GrabExpert(
        env,
        kinematics,
        name,
        offset_m=(reach * math.cos(angle), reach * math.sin(angle)),
        retry=not miss,
    )
    shot = rng.randint(5, 35)
    for step in range(90):
        env.step(expert.act())
        if step == shot:
            yield capture(env, "front", "grabbing")
            yield capture(env, "wrist", "grabbing")
        if expert.done:
            break
    for _ in range(6):
        env.step(expert.act())
    yield capture(env, "front", "after")
    yield capture(env, "wrist", "after")
    # the same hold in another arm pose, seen from elsewhere on the way back
    pose = list(env.joint_state().values())
    wiggle = [a + rng.uniform(-0.2, 0.2) for a in pose[:4]] + [
        pose[4] + rng.uniform(-0.5, 0.5),
        CLOSED_RAD,
    ]
    turn = (rng.uniform(-0.1, 0.0), rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.3))
    for _ in range(12):
        env.step(wiggle, turn)
    yield capture(env, "front", "after")
    yield capture(env, "wrist", "after")


def write_scenes(out: Path, count: int, seed: int) -> dict[str, int]:
    """Write `count` labeled frames. Returns how many show a held object, by camera.

    Raises OSError when it cannot.
    """
    import cv2

    out.mkdir(parents=True, exist_ok=True)
    (out / "images").mkdir(exist_ok=True)
    written, held = 0, {"front": 0, "wrist": 0}
    with SimEnv() as env, (out / "labels.jsonl").open("w", encoding="utf-8") as labels:
        kinematics = ArmKinematics(env.config)
        layout = 0
        while written < count:
            for shot in scene_captures(env, kinematics, seed * 1_000_000 + layout):
                if written == count:
                    break
                file = f"images/{written:06d}_{shot.label['camera']}.png"
                if not cv2.imwrite(
                    str(out / file), shot.image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]
                ):
                    raise OSError(f"cannot write {out / file}")
                labels.write(json.dumps({"file": file, **shot.label}) + "\n")
                held[shot.label["camera"]] += shot.label["held"] is not None
                written += 1
            layout += 1
    return held


# -- grab demonstrations
@dataclasses.dataclass(slots=True)
class Demonstration:
    """One recorded grab: per step both views (uint8), measured joints, expert's target (float32,
    rad).

    `point` is where the object really is in the base frame (m): a second thing to learn from, not
    an input.
    """

    front: list[Any] = dataclasses.field(default_factory=list)
    wrist: list[Any] = dataclasses.field(default_factory=list)
    state: list[list[float]] = dataclasses.field(default_factory=list)
    action: list[list[float]] = dataclasses.field(default_factory=list)
    point: list[tuple[float, float, float]] = dataclasses.field(default_factory=list)

    def in_reach(self) -> bool:
        """Return whether the object stayed where the arm can grab it."""
        return all(0.24 < x < 0.41 and abs(y) < 0.09 and z > 0.2 for x, y, z in self.point)


def demonstrate(
    env: SimEnv, kinematics: ArmKinematics, seed: int, policy: LoadedPolicy | None = None
) -> tuple[Demonstration, bool]:
    """Return one perturbed demonstration and whether it ended with the object held.

    Bursts of noise push the arm off its way (as in DART); what is recorded is always what the
    expert would do from the arm's real pose, so the policy learns to come back. With a `policy` it
    drives most of the time (as in DAgger), so that the states are recorded that it gets itself
    into.
    """
    rng = random.Random(f"demonstration-{seed}")
    env.reset(seed)
    name = rng.choice(env.layout.objects).name
    stand_before(env, name, rng)
    start = [a + rng.uniform(-0.06, 0.06) for a in REST_POSE]
    env.place(env.base_pose(), start)
    expert = GrabExpert(env, kinematics, name)
    demo = Demonstration()
    push = [0.0] * len(ARM_JOINTS)
    burst = 0
    planned: list[list[float]] = []
    expert_from = rng.randint(0, 110) if policy is not None else 0
    after = 0
    for step in range(MAX_STEPS):
        front, wrist = env.render("front"), env.render("wrist")
        demo.front.append(policy_view(front, "front"))
        demo.wrist.append(policy_view(wrist, "wrist"))
        demo.state.append(list(env.joint_state().values()))
        demo.point.append(env.ground_truth().objects[name].position_base)
        target = expert.act()
        demo.action.append(target)
        if policy is not None and step < expert_from:
            planned = planned or policy.chunk(env, {"front": front, "wrist": wrist})
            env.step(planned.pop(0))
        else:
            if burst == 0 and not expert.lifting and rng.random() < 0.12:
                burst = rng.randint(3, 8)
                push = [rng.gauss(0.0, s) for s in (0.08, 0.07, 0.07, 0.07, 0.02, 0.10)]
            shove = burst > 0 and not expert.lifting and policy is None
            env.step([t + p for t, p in zip(target, push, strict=True)] if shove else target)
            burst = max(0, burst - 1)
        after += expert.done
        if after >= 6:
            break
    return demo, env.held_object() == name


def write_grab(
    out: Path, episodes: int, seed: int, policy: LoadedPolicy | None = None
) -> dict[str, int]:
    """Record `episodes` successful demonstrations. Returns episodes, steps and discarded
    failures.
    """
    import numpy as np

    out.mkdir(parents=True, exist_ok=True)
    kept: list[Demonstration] = []
    failed = 0
    with SimEnv() as env:
        kinematics = ArmKinematics(env.config)
        number = 0
        while len(kept) < episodes:
            demo, held = demonstrate(env, kinematics, seed * 1_000_000 + 500_000 + number, policy)
            number += 1
            # an object pushed out of reach teaches nothing; a try that only ran out of time does
            if held or (policy is not None and demo.in_reach()):
                kept.append(demo)
            else:
                failed += 1
                if failed > 20 + episodes:
                    raise RuntimeError(
                        "the expert fails too often: the scene and the expert do not fit together"
                    )
    for key in ("front", "wrist"):
        np.save(
            out / f"{key}.npy", np.stack([image for demo in kept for image in getattr(demo, key)])
        )
    for key in ("state", "action", "point"):
        np.save(
            out / f"{key}.npy",
            np.asarray([row for d in kept for row in getattr(d, key)], dtype=np.float32),
        )
    lengths = [len(demo.action) for demo in kept]
    np.save(out / "episode_length.npy", np.asarray(lengths, dtype=np.int64))
    cameras = SceneConfig().cameras
    info = {
        "format": "grab-demonstrations/1",
        "fps": 30,
        "joints": list(ARM_JOINTS),
        "units": "rad",
        "seed": seed,
        "views": {
            key: {
                "crop": list(VIEWS[key][0]),
                "size_px": list(VIEWS[key][1]),
                "camera_px": [cameras[key].width_px, cameras[key].height_px],
            }
            for key in VIEWS
        },
    }
    (out / "info.json").write_text(json.dumps(info, indent=2) + "\n", encoding="utf-8")
    return {"episodes": len(kept), "steps": sum(lengths), "discarded": failed}


def main(argv: list[str] | None = None) -> int:
    """Command line of the dataset writer."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.runner.sim.training.dataset",
        description="Write training data.",
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    grab = kinds.add_parser("grab", help="demonstrations of the scripted expert")
    grab.add_argument("--episodes", type=int, default=200)
    grab.add_argument(
        "--policy", type=Path, help="checkpoint that drives while the expert labels (second round)"
    )
    scenes = kinds.add_parser("scenes", help="labelled frames for detector and scene VLM")
    scenes.add_argument("--count", type=int, default=2000)
    for one in (grab, scenes):
        one.add_argument("--out", type=Path, required=True)
        one.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    began = time.monotonic()
    counts = (
        write_grab(
            args.out, args.episodes, args.seed, LoadedPolicy(args.policy) if args.policy else None
        )
        if args.kind == "grab"
        else write_scenes(args.out, args.count, args.seed)
    )
    print(
        json.dumps({"out": str(args.out), **counts, "seconds": round(time.monotonic() - began, 1)})
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
