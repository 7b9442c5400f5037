"""Training of the small progress model.

`python -m vram_arbiter.sidecars.training.progress --data DIR --out DIR` reads a folder written by
`python -m vram_arbiter.runner.sim.training.progress` and writes a lerobot reward model (config,
weights) and its model card with the held-out figures. Seeded; under three minutes on two cores.
`--smoke` runs a few seconds of the same code. Must not know the simulator.
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
from typing import Any, Final

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.sidecars.weights import Weights, read_config

FORMAT: Final = "grab-progress/1"
HELD_OUT: Final = 0.12  # share of the tries, the last ones: a try is never split
# share of the training questions for the object of the grab; the others ask for anything else
ABOUT_WORK: Final = 0.55
ABSENT: Final = 0.1  # share that asks for an absent object
SURE: Final = 0.5


class BadProgressData(ValueError):
    """The folder does not hold labeled grabs; the message says what is wrong."""


@dataclasses.dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures, uint8 (N, H, W, 3).

    Per picture: the objects on its table with their progress and whether they are held, and its
    try.
    """

    images: Any
    progress: list[dict[str, float]]
    held: list[dict[str, bool]]
    episode: list[int]
    camera: str

    @property
    def names(self) -> list[str]:
        """Names of all objects that were ever on a table."""
        return sorted({name for row in self.progress for name in row})

    def about(self, index: int) -> str:
        """Return the object that is nearest to being held."""
        row = self.progress[index]
        return max(row, key=lambda name: (row[name], name))


def load(folder: Path) -> Pictures:
    """Read a data folder. Raises BadProgressData."""
    import numpy as np

    path = folder / "info.json"
    if not path.is_file():
        raise BadProgressData(
            f"{path} is missing: record with `python -m vram_arbiter.runner.sim.training.progress "
            f"--out {folder}`"
        )
    info = json.loads(path.read_text(encoding="utf-8"))
    if info.get("format") != FORMAT:
        raise BadProgressData(
            f"{path} says format {info.get('format')!r}, this script reads {FORMAT!r}"
        )
    images = np.load(folder / "images.npy")
    progress: list[dict[str, float]] = []
    held: list[dict[str, bool]] = []
    episode: list[int] = []
    for number, one in enumerate(info["episodes"]):
        for step in range(one["length"]):
            progress.append({name: values[step] for name, values in one["progress"].items()})
            held.append({name: values[step] for name, values in one["held"].items()})
            episode.append(number)
    if len(images) != len(progress):
        raise BadProgressData(f"{folder}: {len(images)} pictures, but labels for {len(progress)}")
    return Pictures(images, progress, held, episode, info["camera"])


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


def split(data: Pictures) -> tuple[list[int], list[int]]:
    """Return indices to train on, and held out."""
    last = max(data.episode) + 1
    border = last - max(1, round(last * HELD_OUT))
    return (
        [index for index, number in enumerate(data.episode) if number < border],
        [index for index, number in enumerate(data.episode) if number >= border],
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


def batch_of(
    data: Pictures, config: Any, questions: list[tuple[int, str]], rng: Any | None
) -> JsonObject:
    """Return tensors for (picture, object) pairs; `rng` (a torch generator) adds tint, light and
    noise."""
    import torch

    from vram_arbiter.sidecars.models.compact_progress.modeling_compact_progress import (
        PROGRESS_KEY,
        SUCCESS_KEY,
        WORDS_KEY,
    )
    from vram_arbiter.sidecars.models.compact_progress.processor_compact_progress import words_of

    pictures = (
        torch.from_numpy(data.images[[index for index, _ in questions]]).permute(0, 3, 1, 2).float()
        / 255
    )
    if rng is not None:
        count = len(questions)
        gain = 1 + 0.06 * torch.randn(count, 3, 1, 1, generator=rng)
        light = 0.05 * torch.randn(count, 1, 1, 1, generator=rng)
        noise = 0.01 * torch.randn(pictures.shape, generator=rng)
        pictures = (pictures * gain + light + noise).clamp(0, 1)
    words = [words_of(name, config.colours, config.shapes) for _, name in questions]
    return {
        config.image_key: pictures[:, None],
        WORDS_KEY: torch.tensor(words),
        PROGRESS_KEY: torch.tensor(
            [[data.progress[index].get(name, 0.0)] for index, name in questions]
        ),
        SUCCESS_KEY: torch.tensor(
            [[float(data.held[index].get(name, False))] for index, name in questions]
        ),
    }


def train(
    data: Pictures, out: Path, *, steps: int, batch_size: int, seed: int, time_limit_s: float
) -> dict[str, float]:
    """Train, write the checkpoint, return the last running losses.

    Ends early, and well, at the limit: the rate follows time.
    """
    import torch

    from vram_arbiter.sidecars.models.compact_progress.modeling_compact_progress import (
        CompactProgressRewardModel,
    )

    torch.manual_seed(seed)
    rng, generator = random.Random(f"progress-{seed}"), torch.Generator().manual_seed(seed)
    config = make_config(data)
    model = CompactProgressRewardModel(config)
    learn, _ = split(data)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.optimizer_lr, weight_decay=config.optimizer_weight_decay
    )
    averaged = torch.optim.swa_utils.AveragedModel(
        model, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.995)
    )
    running: dict[str, float] = {}
    began, done = time.monotonic(), 0
    for step in range(steps):
        share = max(step / steps, (time.monotonic() - began) / time_limit_s)
        if share >= 1.0:
            break
        warm = min(1.0, (step + 1) / max(1, min(100, steps // 10)))
        for group in optimizer.param_groups:
            group["lr"] = (
                config.optimizer_lr * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * share)))
            )
        picked = rng.choices(learn, k=batch_size)
        model.train()
        loss, parts = model(
            batch_of(data, config, [(index, ask(data, index, rng)) for index in picked], generator)
        )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        averaged.update_parameters(model)
        done = step + 1
        for key, value in parts.items():
            running[key] = value if key not in running else 0.95 * running[key] + 0.05 * value
        if done % 100 == 0:
            line = {"step": done, "s": round(time.monotonic() - began, 1)}
            print(
                json.dumps(line | {key: round(value, 4) for key, value in running.items()}),
                flush=True,
            )
    # a short run's average still contains the untrained weights
    best = averaged.module if done >= 500 else model
    best.eval()
    best.save_pretrained(out)
    return running | {"steps": float(done), "seconds": time.monotonic() - began}


def judge(data: Pictures, checkpoint: Path) -> dict[str, float]:
    """Return held-out figures.

    How often success is right, for the held object, for others beside it, and for an empty gripper;
    and the mean error of progress for the object of the grab.
    """
    import torch
    from lerobot.configs.rewards import RewardModelConfig
    from lerobot.rewards.factory import get_reward_model_class

    import vram_arbiter.sidecars.models.compact_progress  # noqa: F401  # registers the type

    config = read_config(RewardModelConfig, Weights(str(checkpoint), local=True))
    model = get_reward_model_class(config.type).from_pretrained(checkpoint, config=config)
    _, kept = split(data)
    asked: dict[str, list[tuple[int, str]]] = {
        "held": [],
        "another is held": [],
        "nothing is held": [],
    }
    for index in kept:
        holds = any(data.held[index].values())
        for name, held in data.held[index].items():
            asked["held" if held else "another is held" if holds else "nothing is held"].append(
                (index, name)
            )
    figures: dict[str, float] = {}
    errors: list[float] = []
    for group, questions in asked.items():
        right = 0
        for start in range(0, len(questions), 256):
            part = questions[start : start + 256]
            batch = batch_of(data, config, part, None)
            with torch.inference_mode():
                progress, success = model.score(batch)
            right += int(((success > SURE) == (batch["success"] > SURE)).sum())
            gaps = (progress - batch["progress"]).abs()[:, 0].tolist()
            errors += [
                gap
                for gap, (index, name) in zip(gaps, part, strict=True)
                if name == data.about(index)
            ]
        figures[group] = round(right / max(1, len(questions)), 4)
        figures[f"{group}: asked"] = len(questions)
    return figures | {
        "progress error": round(sum(errors) / max(1, len(errors)), 4),
        "held-out pictures": len(kept),
    }


CARD = """---
license: apache-2.0
library_name: lerobot
---
# so101-progress

The demo's reward model: lerobot type `compact_progress`, trained from scratch by
`python -m vram_arbiter.sidecars.training.progress` on
`python -m vram_arbiter.runner.sim.training.progress` (wrist camera, two grabs in five miss on
purpose).
It stands in for Robometer-4B, judges each picture by itself, and knows the tabletop's colors and
shapes only: an instruction has to name one object by both.

Progress is the simulator's truth, not time: nearing the named object up to 0.5, both fingers on it
0.6, held from 0.7, carried 1.
The policy's own grabs look slightly different from the expert's in the training data.
Its answer is advice: no goal begins or ends by it.

Held out by try ({held_out} pictures):

| success is right when | asked | right |
| --- | --- | --- |
{rows}

Mean error of progress for the object of the grab: {error}.
Trained {steps} steps in {seconds} s.
"""


def card(figures: dict[str, float], trained: dict[str, float]) -> str:
    """Return the model card."""
    groups = [name for name in figures if f"{name}: asked" in figures]
    rows = "\n".join(
        f"| {name} | {figures[f'{name}: asked']:.0f} | {figures[name]:.2%} |" for name in groups
    )
    return CARD.format(
        held_out=int(figures["held-out pictures"]), rows=rows, error=figures["progress error"],
        steps=int(trained["steps"]), seconds=round(trained["seconds"]),
    )  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Run the command line of the trainer."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.sidecars.training.progress", description=__doc__
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        help="folder written by vram_arbiter.runner.sim.training.progress",
    )
    parser.add_argument("--out", type=Path, required=True, help="checkpoint folder")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--time-limit-s", type=float, default=165.0)
    parser.add_argument(
        "--smoke", action="store_true", help="a few seconds: checks that the code runs"
    )
    args = parser.parse_args(argv)
    import torch

    torch.set_num_threads(args.threads)
    try:
        data = load(args.data)
    except BadProgressData as error:
        print(error, file=sys.stderr)
        return 2
    trained = train(
        data,
        args.out,
        steps=20 if args.smoke else args.steps,
        batch_size=16 if args.smoke else args.batch_size,
        seed=args.seed,
        time_limit_s=20.0 if args.smoke else args.time_limit_s,
    )
    figures = judge(data, args.out)
    (args.out / "README.md").write_text(card(figures, trained), encoding="utf-8")
    print(
        json.dumps({"out": str(args.out), **figures} | {k: round(v, 4) for k, v in trained.items()})
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
