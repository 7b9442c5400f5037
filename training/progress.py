"""Trainer of the small progress model, lerobot reward model type `compact_progress`.

Three minutes on two cores. Must not know the simulator.
"""

from __future__ import annotations

import dataclasses
import os
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from training.common import (
    BadInput,
    Recipe,
    Report,
    Trainer,
    as_floats,
    fit_average,
    seed_everything,
    share,
    tinted,
)
from training.datasets import read_tries
from vram_arbiter.schemas.plain import JsonObject

HELD_OUT: Final = 0.12  # share of the tries, the last ones: a try is never split
# share of the training questions for the object of the grab; the others ask for anything else
ABOUT_WORK: Final = 0.55
ABSENT: Final = 0.1  # share that asks for an absent object
SURE: Final = 0.5


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ProgressRecipe(Recipe):
    """Parameters of a run."""

    threads: int = min(2, os.cpu_count() or 1)
    steps: int = 4000
    batch: int = 32
    time_limit_s: float = 165.0


@dataclasses.dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures, uint8 (N, H, W, 3).

    Per picture: the objects on its table with their progress, the object that is held, and the
    number of its try.
    """

    images: Any
    progress: list[dict[str, float]]
    held: list[str | None]
    grab: list[int]
    camera: str

    @property
    def names(self) -> list[str]:
        """Names of all objects that were ever on a table."""
        return sorted({name for row in self.progress for name in row})

    def about(self, index: int) -> str:
        """Return the object that is nearest to being held."""
        row = self.progress[index]
        return max(row, key=lambda name: (row[name], name))

    def split(self) -> tuple[list[int], list[int]]:
        """Return indices to train on, and held out."""
        last = max(self.grab) + 1
        border = last - max(1, round(last * HELD_OUT))
        learn = [index for index, number in enumerate(self.grab) if number < border]
        return learn, list(range(len(learn), len(self.grab)))


def load(folders: Sequence[Path]) -> Pictures:
    """Read data folders. Raises BadInput."""
    infos, columns = read_tries(folders, "progress", ["images"])
    labels = [label for info in infos for label in info["labels"]]
    lengths = [length for info in infos for length in info["lengths"]]
    if len(labels) != sum(lengths) or len(lengths) < 2:
        raise BadInput(
            f"{folders[0]}: expected two tries or more and a label for each picture, got "
            f"{len(lengths)} tries, {sum(lengths)} pictures and {len(labels)} labels"
        )
    return Pictures(
        images=columns["images"],
        progress=[label["progress"] for label in labels],
        held=[label["held"] for label in labels],
        grab=[number for number, length in enumerate(lengths) for _ in range(length)],
        camera=infos[0]["camera"],
    )


def make_config(data: Pictures) -> Any:
    """Return the model's configuration for this data."""
    from vram_arbiter.sidecars.models.compact_progress import CompactProgressConfig

    height, width = data.images.shape[1:3]
    return CompactProgressConfig(
        image_key=f"observation.images.{data.camera}",
        size_px=[width, height],
        colours=sorted({name.split(" ", 1)[0] for name in data.names}),
        shapes=sorted({name.split(" ", 1)[1] for name in data.names}),
        device="cpu",
        license="apache-2.0",
    )


def ask(data: Pictures, index: int, rng: random.Random) -> str:
    """Return an object to ask a picture for."""
    draw = rng.random()
    here = data.progress[index]
    if draw < ABOUT_WORK:
        return data.about(index)
    absent = [name for name in data.names if name not in here]
    if draw > 1 - ABSENT and absent:
        return rng.choice(absent)
    return rng.choice([name for name in here if name != data.about(index)] or list(here))


def batch_of(data: Pictures, config: Any, questions: Sequence[tuple[int, str]]) -> JsonObject:
    """Return tensors for (picture, object) pairs."""
    import torch

    from vram_arbiter.sidecars.models.compact_progress.modeling_compact_progress import (
        PROGRESS_KEY,
        SUCCESS_KEY,
        WORDS_KEY,
    )
    from vram_arbiter.sidecars.models.compact_progress.processor_compact_progress import words_of

    words = [words_of(name, config.colours, config.shapes) for _, name in questions]
    progress = [[data.progress[index].get(name, 0.0)] for index, name in questions]
    success = [[float(data.held[index] == name)] for index, name in questions]
    return {
        config.image_key: as_floats(data.images[[index for index, _ in questions]]),
        WORDS_KEY: torch.tensor(words),
        PROGRESS_KEY: torch.tensor(progress),
        SUCCESS_KEY: torch.tensor(success),
    }


def train(recipe: ProgressRecipe, data: Sequence[Path], out: Path, start: Path | None) -> Report:
    """Train, write the checkpoint, judge it."""
    import torch

    from vram_arbiter.sidecars.models.compact_progress.modeling_compact_progress import (
        CompactProgressRewardModel,
    )

    pictures = load(data)
    seed_everything(recipe)
    rng = random.Random(f"progress-{recipe.seed}")
    generator = torch.Generator().manual_seed(recipe.seed)
    config = make_config(pictures)
    model = CompactProgressRewardModel(config)
    if start is not None:
        model = CompactProgressRewardModel.from_pretrained(start, config=config)
    learn, _ = pictures.split()

    def loss_of() -> Any:
        asked = [(index, ask(pictures, index, rng)) for index in rng.choices(learn, k=recipe.batch)]
        batch = batch_of(pictures, config, asked)
        return model(batch | {config.image_key: tinted(batch[config.image_key], generator)})

    best, run = fit_average("progress", model, loss_of, recipe, memory_steps=200)
    best.save_pretrained(out)
    return judge(pictures, out, run.figures())


def judge(data: Pictures, checkpoint: Path, figures: JsonObject) -> Report:
    """Judge a saved checkpoint on held-out pictures.

    How often success is right, for the held object, for others beside it, and for an empty gripper;
    and the mean error of progress for the object of the grab.
    """
    import torch
    from lerobot.configs.rewards import RewardModelConfig
    from lerobot.rewards.factory import get_reward_model_class

    from vram_arbiter.sidecars.weights import Weights, read_config

    config = read_config(RewardModelConfig, Weights(str(checkpoint), local=True))
    model = get_reward_model_class(config.type).from_pretrained(checkpoint, config=config)
    _, kept = data.split()
    right: dict[str, list[bool]] = {"held": [], "another is held": [], "nothing is held": []}
    errors: list[float] = []
    for index in kept:
        names = list(data.progress[index])
        batch = batch_of(data, config, [(index, name) for name in names])
        with torch.inference_mode():
            progress, success = model.score(batch)
        for row, name in enumerate(names):
            held = data.held[index]
            group = "held" if held == name else "another is held" if held else "nothing is held"
            right[group].append(bool((success[row] > SURE) == (held == name)))
            if name == data.about(index):
                errors.append(abs(float(progress[row]) - data.progress[index][name]))
    figures |= {
        "held_out_pictures": len(kept),
        "progress_error": round(sum(errors) / max(1, len(errors)), 4),
    }
    rows = [
        {"success is right when": group, "asked": len(flags), "right": share(flags)}
        for group, flags in right.items()
    ]
    return Report(figures, rows)


TRAINER: Final = Trainer(
    model="so101-progress",
    library="lerobot",
    recipe=ProgressRecipe(),
    smoke=ProgressRecipe(steps=20, batch=16),
    train=train,
)
