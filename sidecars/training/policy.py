"""Training of the small grab policy on recorded demonstrations.

`python -m vram_arbiter.sidecars.training.policy --data DIR --out DIR` reads a folder written by
`python -m vram_arbiter.runner.sim.training.dataset grab` and writes a lerobot checkpoint (config,
weights, processors). Seeded; about ten minutes on two cores. `--smoke` runs a few seconds of the
same code. Must not know the simulator.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import random
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.plain import JsonObject

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

FORMAT: Final = "grab-demonstrations/1"
CAMERAS: Final = ("front", "wrist")
# A joint that hardly moves would be blown up to noise by its own spread.
MIN_STD_RAD: Final = 0.03
AFTER_END_STEPS: Final = 12


class BadDemonstrations(ValueError):
    """The folder does not hold demonstrations; the message says what is wrong."""


@dataclasses.dataclass(frozen=True, slots=True)
class Demonstrations:
    """All steps of all episodes in order, as numpy arrays.

    `episode_end[i]` is one past step i's episode.
    """

    images: dict[str, NDArray[Any]]
    state: Any
    action: Any
    point: Any
    episode_end: Any
    info: JsonObject


def load_demonstrations(*folders: Path) -> Demonstrations:
    """Read data folders in order. Raises BadDemonstrations."""
    import numpy as np

    parts = [_load_folder(folder) for folder in folders]
    joined = {key: np.concatenate([arrays[key] for _, arrays in parts]) for key in parts[0][1]}
    lengths = joined["episode_length"]
    return Demonstrations(
        images={key: joined[key] for key in CAMERAS},
        state=joined["state"],
        action=joined["action"],
        point=joined["point"],
        episode_end=np.repeat(np.cumsum(lengths), lengths),
        info=parts[0][0],
    )


def _load_folder(folder: Path) -> tuple[JsonObject, JsonObject]:
    import numpy as np

    path = folder / "info.json"
    if not path.is_file():
        raise BadDemonstrations(
            f"{path} is missing: record with `python -m vram_arbiter.runner.sim.training.dataset "
            f"grab --out {folder}`"
        )
    info: JsonObject = json.loads(path.read_text(encoding="utf-8"))
    if info.get("format") != FORMAT:
        raise BadDemonstrations(
            f"{path} says format {info.get('format')!r}, this script reads {FORMAT!r}"
        )
    arrays = {
        key: np.load(folder / f"{key}.npy")
        for key in (*CAMERAS, "state", "action", "point", "episode_length")
    }
    steps = int(arrays["episode_length"].sum())
    for key in (*CAMERAS, "state", "action", "point"):
        if len(arrays[key]) != steps:
            raise BadDemonstrations(
                f"{folder / key}.npy has {len(arrays[key])} steps, the episodes sum to {steps}"
            )
    return info, arrays


def make_config(info: JsonObject, *, action_steps: int) -> Any:
    """Return the policy's configuration: cameras at full size, crops as the data describes."""
    from lerobot.configs import FeatureType, PolicyFeature

    from vram_arbiter.sidecars.models.compact_act import CompactActConfig

    inputs = {
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(len(info["joints"]),))
    }
    views = {}
    for camera in CAMERAS:
        width, height = info["views"][camera]["camera_px"]
        key = f"observation.images.{camera}"
        inputs[key] = PolicyFeature(type=FeatureType.VISUAL, shape=(3, height, width))
        views[key] = [
            [float(v) for v in info["views"][camera]["crop"]],
            [float(v) for v in info["views"][camera]["size_px"]],
        ]
    return CompactActConfig(
        input_features=inputs,
        output_features={
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(len(info["joints"]),))
        },
        views=views,
        n_action_steps=action_steps,
        device="cpu",
        push_to_hub=False,
    )


def make_stats(data: Demonstrations) -> dict[str, dict[str, Tensor]]:
    """Return mean and spread of state and action, per joint, for the normalizing processors."""
    import torch

    stats = {}
    for key, values in (("observation.state", data.state), ("action", data.action)):
        tensor = torch.from_numpy(values)
        stats[key] = {"mean": tensor.mean(0), "std": tensor.std(0).clamp_min(MIN_STD_RAD)}
    return stats


def load_stats(checkpoint: Path) -> dict[str, dict[str, Tensor]]:
    """Return the normalization that a checkpoint was trained with, from its preprocessor."""
    from safetensors.torch import load_file

    stats: dict[str, dict[str, Tensor]] = {}
    for path in checkpoint.glob("policy_preprocessor_step_*_normalizer_processor.safetensors"):
        for name, value in load_file(path).items():
            key, _, which = name.rpartition(".")
            if which in ("mean", "std"):
                stats.setdefault(key, {})[which] = value
    if not {"observation.state", "action"} <= set(stats):
        raise BadDemonstrations(f"{checkpoint} has no normalization of state and action")
    return stats


class Batches:
    """Random training batches with light augmentation: shifts, brightness, tint, joint noise."""

    def __init__(
        self, data: Demonstrations, config: Any, stats: dict[str, dict[str, Tensor]], seed: int
    ) -> None:
        import torch

        self._data, self._config, self._stats = data, config, stats
        self._generator = torch.Generator().manual_seed(seed)
        self._images = {
            key: torch.from_numpy(values).permute(0, 3, 1, 2) for key, values in data.images.items()
        }
        self._state, self._action = torch.from_numpy(data.state), torch.from_numpy(data.action)
        self._point, self._end = torch.from_numpy(data.point), torch.from_numpy(data.episode_end)

    def draw(self, size: int) -> dict[str, Tensor]:
        """Return a batch of `size` random steps."""
        import torch

        pick = torch.randint(len(self._state), (size,), generator=self._generator)
        ahead = pick[:, None] + torch.arange(self._config.chunk_size)[None, :]
        last = (self._end[pick] - 1)[:, None]
        # past the end the arm stays: the last target continues for a while and is worth learning
        pad = ahead > last + AFTER_END_STEPS
        state, action = self._stats["observation.state"], self._stats["action"]
        noisy = self._state[pick] + 0.004 * torch.randn(
            size, self._state.shape[1], generator=self._generator
        )
        batch: dict[str, Tensor] = {
            "observation.state": (noisy - state["mean"]) / state["std"],
            "observation.point": self._point[pick],
            "action": (self._action[torch.minimum(ahead, last)] - action["mean"]) / action["std"],
            "action_is_pad": pad,
        }
        for camera, images in self._images.items():
            batch[f"observation.images.{camera}"] = self._augment(images[pick])
        return batch

    def _augment(self, images: Any) -> Any:
        import torch
        from torch.nn import functional as F

        count, _, height, width = images.shape
        image = images.float() / 255
        gain = 1 + 0.06 * torch.randn(count, 3, 1, 1, generator=self._generator)
        light = 0.05 * torch.randn(count, 1, 1, 1, generator=self._generator)
        image = (
            image * gain + light + 0.01 * torch.randn(image.shape, generator=self._generator)
        ).clamp(0, 1)
        # one shift for the whole batch is cheap, and every batch has another
        dx, dy = (int(v) for v in torch.randint(-1, 2, (2,), generator=self._generator))
        padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
        return padded[:, :, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]


def train(
    data: Demonstrations,
    out: Path,
    *,
    steps: int,
    batch_size: int,
    seed: int,
    action_steps: int,
    time_limit_s: float = math.inf,
    init: Path | None = None,
) -> dict[str, float]:
    """Train, write the checkpoint, return the last running losses.

    Ends early (and well: the rate follows time) at the limit. `init` continues an earlier
    checkpoint, with its normalization, since its weights depend on it.
    """
    import torch
    from lerobot.policies.factory import make_pre_post_processors

    from vram_arbiter.sidecars.models.compact_act.modeling_compact_act import CompactActPolicy

    random.seed(seed)
    torch.manual_seed(seed)
    config = make_config(data.info, action_steps=action_steps)
    if init is None:
        stats = make_stats(data)
        policy = CompactActPolicy(config)
        policy.point_centre.copy_(torch.from_numpy(data.point).mean(0))
    else:
        stats = load_stats(init)
        policy = CompactActPolicy.from_pretrained(init, config=config)
    batches = Batches(data, config, stats, seed)
    optimizer = torch.optim.AdamW(
        policy.get_optim_params(),
        lr=config.optimizer_lr,
        weight_decay=config.optimizer_weight_decay,
    )
    averaged = torch.optim.swa_utils.AveragedModel(
        policy, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.998)
    )
    running: dict[str, float] = {}
    began, done = time.monotonic(), 0
    warm_steps = max(1, min(100, steps // 10))
    for step in range(steps):
        done = step + 1
        progress = max(step / steps, (time.monotonic() - began) / time_limit_s)
        if progress >= 1.0:
            break
        warm = min(1.0, (step + 1) / warm_steps)
        for group in optimizer.param_groups:
            group["lr"] = (
                config.optimizer_lr
                * warm
                * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * progress)))
            )
        policy.train()
        loss, parts = policy(batches.draw(batch_size))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        averaged.update_parameters(policy)
        for key, value in parts.items():
            running[key] = value if key not in running else 0.9 * running[key] + 0.1 * value
        if done % 200 == 0:
            line = {"step": done, "s": round(time.monotonic() - began, 1)}
            print(json.dumps(line | {k: round(v, 5) for k, v in running.items()}), flush=True)
    # the average of short runs would still contain the untrained weights
    best = averaged.module if done >= 1000 else policy
    best.save_pretrained(out)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    before.save_pretrained(out)
    after.save_pretrained(out)
    return running | {"steps": float(done), "seconds": time.monotonic() - began}


def main(argv: list[str] | None = None) -> int:
    """Run the command line of the policy trainer."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.sidecars.training.policy", description=__doc__
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        nargs="+",
        help="folders written by vram_arbiter.runner.sim.training.dataset grab",
    )
    parser.add_argument("--init", type=Path, help="checkpoint to continue")
    parser.add_argument("--out", type=Path, required=True, help="checkpoint folder")
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--action-steps", type=int, default=6, help="number of a chunk's targets that are executed"
    )
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--time-limit-s", type=float, default=720.0)
    parser.add_argument(
        "--smoke",
        action="store_true",
        help="a few seconds: checks that the code runs and the loss falls",
    )
    args = parser.parse_args(argv)
    import torch

    torch.set_num_threads(args.threads)
    try:
        data = load_demonstrations(*args.data)
    except BadDemonstrations as error:
        print(error, file=sys.stderr)
        return 2
    result = train(
        data,
        args.out,
        steps=20 if args.smoke else args.steps,
        batch_size=16 if args.smoke else args.batch_size,
        seed=args.seed,
        action_steps=args.action_steps,
        time_limit_s=20.0 if args.smoke else args.time_limit_s,
        init=args.init,
    )
    print(json.dumps({"out": str(args.out)} | {k: round(v, 5) for k, v in result.items()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
