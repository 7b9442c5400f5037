"""Recorder of grab demonstrations: the scripted expert, pushed off its way or at a policy's side."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from training.common import BadInput
from training.datasets import write_tries
from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE, SceneConfig
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import GrabExpert, Phase
from vram_arbiter.runner.sim.tasks import stand_before
from vram_arbiter.schemas.plain import JsonObject

if TYPE_CHECKING:
    from torch import Tensor

# Views of the grab policy: crops as fractions of the image (x0, y0, x1, y1), and the size they are
# averaged down to.
VIEWS: Final[dict[str, tuple[tuple[float, float, float, float], tuple[int, int]]]] = {
    "front": ((0.45, 0.20, 0.85, 0.7333333333), (96, 96)),
    "wrist": ((0.10, 0.0, 1.0, 1.0), (96, 80)),
}
MAX_STEPS: Final = 120
AFTER_STEPS: Final = 6
PUSH_RAD: Final = (0.08, 0.07, 0.07, 0.07, 0.02, 0.10)  # deviation of a burst, per joint


def view(image: Any, camera: str) -> Any:
    """Return the crop of an RGB image that the grab policy sees, averaged down; uint8."""
    import cv2

    (x0, y0, x1, y1), size = VIEWS[camera]
    height, width = image.shape[:2]
    crop = image[round(y0 * height) : round(y1 * height), round(x0 * width) : round(x1 * width)]
    return cv2.resize(crop, size, interpolation=cv2.INTER_AREA)


def begin_grab(env: SimEnv, rng: random.Random, seed: int) -> str:
    """Stand before an object of a new scene, the arm about at rest. Returns its name."""
    env.reset(seed)
    name = rng.choice(env.layout.objects).name
    stand_before(env, name, rng)
    env.place(env.base_pose(), [angle + rng.uniform(-0.06, 0.06) for angle in REST_POSE])
    return name


class Driver:
    """A checkpoint in this process, loaded through lerobot's factory as the sidecar does."""

    def __init__(self, folder: Path) -> None:
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        import vram_arbiter.sidecars.models.compact_act  # noqa: F401  # registers the policy type
        from vram_arbiter.sidecars.weights import Weights, read_config

        config = read_config(PreTrainedConfig, Weights(str(folder), local=True))
        config.device = "cpu"
        kind = get_policy_class(config.type)
        self._policy = kind.from_pretrained(folder, config=config, strict=True)
        self._before, self._after = make_pre_post_processors(config, pretrained_path=str(folder))
        self._steps = config.n_action_steps

    def chunk(self, joints: list[float], images: Mapping[str, Any]) -> list[list[float]]:
        """Return the next joint targets (rad) for joint angles and RGB images by camera."""
        import torch

        from training.common import as_floats

        observation: dict[str, Tensor] = {
            f"observation.images.{camera}": as_floats(image[None])[0]
            for camera, image in images.items()
        }
        observation["observation.state"] = torch.tensor(joints)
        with torch.inference_mode():
            targets = self._after(self._policy.predict_action_chunk(self._before(observation)))
        rows: list[list[float]] = targets[0, : self._steps].tolist()
        return rows


@dataclasses.dataclass(slots=True)
class Demonstration:
    """One recorded grab: per step both views (uint8), measured joints, expert's target (rad).

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


def demonstrate(env: SimEnv, seed: int, driver: Driver | None) -> tuple[Demonstration, bool]:
    """Return one perturbed demonstration and whether it ended with the object held.

    Bursts of noise push the arm off its way (as in DART); what is recorded is always what the
    expert would do from the arm's real pose, so the policy learns to come back. A driver drives
    most of the time (as in DAgger), so that the states are recorded that it gets itself into.
    """
    rng = random.Random(f"demonstration-{seed}")
    name = begin_grab(env, rng, seed)
    expert, demo = GrabExpert(env, name), Demonstration()
    push, burst = [0.0] * len(ARM_JOINTS), 0
    planned: list[list[float]] = []
    expert_from = rng.randint(0, 110) if driver is not None else 0
    after = 0
    for step in range(MAX_STEPS):
        images = {camera: env.render(camera) for camera in VIEWS}
        joints = list(env.joint_state().values())
        demo.front.append(view(images["front"], "front"))
        demo.wrist.append(view(images["wrist"], "wrist"))
        demo.state.append(joints)
        demo.point.append(env.ground_truth().objects[name].position_base)
        target = expert.act()
        demo.action.append(target)
        lifting = expert.phase in (Phase.LIFT, Phase.DONE)
        if driver is not None and step < expert_from:
            planned = planned or driver.chunk(joints, images)
            env.step(planned.pop(0))
        else:
            if burst == 0 and not lifting and rng.random() < 0.12:
                burst = rng.randint(3, 8)
                push = [rng.gauss(0.0, deviation) for deviation in PUSH_RAD]
            shove = burst > 0 and not lifting and driver is None
            env.step([t + p for t, p in zip(target, push, strict=True)] if shove else target)
            burst = max(0, burst - 1)
        after += expert.done
        if after >= AFTER_STEPS:
            break
    return demo, env.held_object() == name


def record(out: Path, count: int, seed: int, policy: Path | None = None) -> JsonObject:
    """Record `count` demonstrations that succeed. Returns episodes, steps, discarded failures.

    Raises BadInput when the expert fails too often.
    """
    kept: list[Demonstration] = []
    failed = number = 0
    driver = Driver(policy) if policy is not None else None
    with SimEnv() as env:
        while len(kept) < count:
            demo, held = demonstrate(env, seed * 1_000_000 + 500_000 + number, driver)
            number += 1
            # an object pushed out of reach teaches nothing; a try that only ran out of time does
            if held or (driver is not None and demo.in_reach()):
                kept.append(demo)
                continue
            failed += 1
            if failed > 20 + count:
                raise BadInput(
                    f"{failed} of {number} grabs failed: scene and expert do not fit together"
                )
    steps = write(out, kept, seed)
    return {"episodes": len(kept), "steps": steps, "discarded": failed}


def write(out: Path, kept: list[Demonstration], seed: int) -> int:
    """Write demonstrations. Returns their steps."""
    import numpy as np

    columns = {
        key: np.asarray(
            [row for demo in kept for row in getattr(demo, key)],
            dtype=np.uint8 if key in VIEWS else np.float32,
        )
        for key in (*VIEWS, "state", "action", "point")
    }
    cameras = SceneConfig().cameras
    views = {
        key: {
            "crop": crop,
            "size_px": size,
            "camera_px": [cameras[key].width_px, cameras[key].height_px],
        }
        for key, (crop, size) in VIEWS.items()
    }
    lengths = [len(demo.action) for demo in kept]
    write_tries(out, "grabs", lengths, columns, seed=seed, joints=list(ARM_JOINTS), views=views)
    return sum(lengths)
