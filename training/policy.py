"""Trainer of the small grab policy, lerobot type `compact_act`, on recorded demonstrations.

Ten minutes on two cores. Must not know the simulator.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from training.common import BadInput, Recipe, Report, Trainer, fit_average, seed_everything, tinted
from training.datasets import read_tries
from vram_arbiter.schemas.plain import JsonMap

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

CAMERAS: Final = ("front", "wrist")
COLUMNS: Final = (*CAMERAS, "state", "action", "point")
# A joint that hardly moves would be blown up to noise by its own spread.
MIN_STD_RAD: Final = 0.03
AFTER_END_STEPS: Final = 12
type Stats = dict[str, dict[str, Tensor]]
"""Mean and spread of state and action, per joint."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PolicyRecipe(Recipe):
    """Parameters of a run; `action_steps` targets of a chunk are executed."""

    threads: int = min(2, os.cpu_count() or 1)
    steps: int = 7000
    batch: int = 32
    time_limit_s: float = 720.0
    action_steps: int = 6


def make_config(info: JsonMap, action_steps: int) -> Any:
    """Return the policy's configuration: cameras at full size, crops as the data describes."""
    from lerobot.configs import FeatureType, PolicyFeature

    from vram_arbiter.sidecars.models.compact_act import CompactActConfig

    joints = (len(info["joints"]),)
    inputs = {"observation.state": PolicyFeature(type=FeatureType.STATE, shape=joints)}
    views = {}
    for camera in CAMERAS:
        view = info["views"][camera]
        width, height = view["camera_px"]
        key = f"observation.images.{camera}"
        inputs[key] = PolicyFeature(type=FeatureType.VISUAL, shape=(3, height, width))
        views[key] = [[float(v) for v in view["crop"]], [float(v) for v in view["size_px"]]]
    return CompactActConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=joints)},
        views=views,
        n_action_steps=action_steps,
        device="cpu",
        push_to_hub=False,
    )


def make_stats(columns: Mapping[str, NDArray[Any]]) -> Stats:
    """Return the normalization of new data."""
    import torch

    stats = {}
    for key, name in (("observation.state", "state"), ("action", "action")):
        tensor = torch.from_numpy(columns[name])
        stats[key] = {"mean": tensor.mean(0), "std": tensor.std(0).clamp_min(MIN_STD_RAD)}
    return stats


def load_stats(checkpoint: Path) -> Stats:
    """Return the normalization that a checkpoint was trained with. Raises BadInput."""
    from safetensors.torch import load_file

    stats: Stats = {}
    for path in checkpoint.glob("policy_preprocessor_step_*_normalizer_processor.safetensors"):
        for name, value in load_file(path).items():
            key, _, which = name.rpartition(".")
            if which in ("mean", "std"):
                stats.setdefault(key, {})[which] = value
    if not {"observation.state", "action"} <= set(stats):
        raise BadInput(f"{checkpoint} has no normalization of state and action")
    return stats


class Batches:
    """Random training batches with light augmentation: shifts, brightness, tint, joint noise."""

    def __init__(
        self, columns: Mapping[str, NDArray[Any]], lengths: Sequence[int], chunk: int, stats: Stats,
        seed: int,
    ) -> None:  # fmt: skip
        import numpy as np
        import torch

        self._chunk, self._stats = chunk, stats
        self._generator = torch.Generator().manual_seed(seed)
        self._columns = {name: torch.from_numpy(values) for name, values in columns.items()}
        # of each step the last one of its episode
        self._last = torch.from_numpy(np.repeat(np.cumsum(lengths) - 1, lengths))

    def draw(self, size: int) -> dict[str, Tensor]:
        """Return a batch of `size` random steps."""
        import torch

        state, action = self._columns["state"], self._columns["action"]
        pick = torch.randint(len(state), (size,), generator=self._generator)
        ahead = pick[:, None] + torch.arange(self._chunk)[None, :]
        last = self._last[pick][:, None]
        noise = torch.randn(size, state.shape[1], generator=self._generator)
        batch = {
            "observation.state": self._normal("observation.state", state[pick] + 0.004 * noise),
            "observation.point": self._columns["point"][pick],
            "action": self._normal("action", action[torch.minimum(ahead, last)]),
            # past the end the arm stays: its last target goes on for a while, and is worth learning
            "action_is_pad": ahead > last + AFTER_END_STEPS,
        }
        for camera in CAMERAS:
            images = self._columns[camera][pick].permute(0, 3, 1, 2).float() / 255
            batch[f"observation.images.{camera}"] = self._shifted(tinted(images, self._generator))
        return batch

    def _normal(self, key: str, values: Tensor) -> Tensor:
        return (values - self._stats[key]["mean"]) / self._stats[key]["std"]

    def _shifted(self, images: Tensor) -> Tensor:
        """Return images shifted by a pixel: one shift for a batch is cheap, and each has its own."""
        import torch

        height, width = images.shape[2:]
        dx, dy = (int(v) for v in torch.randint(-1, 2, (2,), generator=self._generator))
        padded = torch.nn.functional.pad(images, (1, 1, 1, 1), mode="replicate")
        return padded[:, :, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]


def train(recipe: PolicyRecipe, data: Sequence[Path], out: Path, start: Path | None) -> Report:
    """Train, and write weights and processors.

    A checkpoint that is continued keeps its normalization, since its weights depend on it.
    """
    import torch
    from lerobot.policies.factory import make_pre_post_processors

    from vram_arbiter.sidecars.models.compact_act.modeling_compact_act import CompactActPolicy

    infos, columns = read_tries(data, "grabs", COLUMNS)
    seed_everything(recipe)
    config = make_config(infos[0], recipe.action_steps)
    if start is None:
        stats, policy = make_stats(columns), CompactActPolicy(config)
        policy.point_centre.copy_(torch.from_numpy(columns["point"]).mean(0))
    else:
        stats, policy = load_stats(start), CompactActPolicy.from_pretrained(start, config=config)
    lengths = [length for info in infos for length in info["lengths"]]
    batches = Batches(columns, lengths, config.chunk_size, stats, recipe.seed)
    best, run = fit_average(
        "policy", policy, lambda: policy(batches.draw(recipe.batch)), recipe, memory_steps=500
    )
    best.save_pretrained(out)
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(out)
    return Report(run.figures())


TRAINER: Final = Trainer(
    model="so101-grab",
    library="lerobot\npipeline_tag: robotics",
    recipe=PolicyRecipe(),
    smoke=PolicyRecipe(steps=20, batch=16),
    train=train,
)
