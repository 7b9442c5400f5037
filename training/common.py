"""Shared by the trainers: recipe, training loop, random light, model card.

Must not know a model or the simulator. torch is imported late.
"""

from __future__ import annotations

import dataclasses
import math
import os
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from vram_arbiter.schemas.plain import JsonMap, JsonObject

SHOWN: Final = 0.05  # share of a run between two lines on stderr
RECENT: Final = 50  # steps that a shown figure is the mean of


class BadInput(ValueError):
    """Data or an option that nothing can be trained with; the message names file, line or option."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Parameters of a run beside its data; the numbers are options of the command line.

    `time_limit_s` (seconds) ends the training loop early, and well: the learning rate follows it.
    """

    seed: int = 0
    threads: int = 1
    steps: int
    batch: int
    time_limit_s: float

    def __post_init__(self) -> None:
        for name in ("threads", "steps", "batch", "time_limit_s"):
            if not getattr(self, name) > 0:
                option = f"--{name.replace('_', '-')}"
                raise BadInput(f"{option} must be above 0, got {getattr(self, name)}")


@dataclasses.dataclass(frozen=True, slots=True)
class Report:
    """What a run found: figures, and its held-out answers as rows of a table with equal keys."""

    figures: JsonObject
    held_out: Sequence[JsonMap] = ()


class Train(Protocol):
    """A trainer's work: write the checkpoint to `out`, and judge it as a user would load it."""

    def __call__(
        self, recipe: Any, data: Sequence[Path], out: Path, start: Path | None
    ) -> Report: ...


@dataclasses.dataclass(frozen=True, slots=True)
class Trainer:
    """One trained model: name and library of its card, the recipe and a toy one, and the work."""

    model: str
    library: str
    recipe: Recipe
    smoke: Recipe
    train: Train


def seed_everything(recipe: Recipe) -> None:
    """Seed everything: same seed, thread count and library versions give the same checkpoint."""
    import numpy as np
    import torch

    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    random.seed(recipe.seed)
    np.random.seed(recipe.seed)
    torch.manual_seed(recipe.seed)
    torch.set_num_threads(recipe.threads)


# -- the training loop
@dataclasses.dataclass(slots=True)
class Run:
    """What a training loop went through: its figures at each step, and its seconds."""

    rows: list[Mapping[str, float]] = dataclasses.field(default_factory=list)
    seconds: float = 0.0

    def mean(self, name: str) -> float:
        """Return the mean of a figure over the last steps."""
        recent = self.rows[-RECENT:]
        return sum(row[name] for row in recent) / len(recent)

    def figures(self) -> JsonObject:
        """Return steps, seconds, and the last means of all figures."""
        means = {name: round(self.mean(name), 4) for name in self.rows[-1]}
        return {"steps": len(self.rows), "train_s": round(self.seconds, 1), **means}


def fit(
    name: str,
    parameters: Iterable[Any],
    optimizer: Any,
    rate: Callable[[int, float], float],
    loss_of: Callable[[], tuple[Any, Mapping[str, float]]],
    *,
    steps: int,
    time_limit_s: float = math.inf,
    clip: float = 1.0,
    after: Callable[[], object] = lambda: None,
) -> Run:
    """Train for `steps` steps, or as many as begin within the time limit (seconds): at least one.

    Args:
        rate: learning rate of (step, share of the run that is over).
        loss_of: loss of a new batch, and figures to show.
        clip: norm that gradients are cut to.
        after: called after each step.
    """
    import torch

    parameters = list(parameters)
    run, shown, began = Run(), 0.0, time.monotonic()
    for step in range(steps):
        share = max(step / steps, run.seconds / time_limit_s)
        if share >= 1.0:
            break
        for group in optimizer.param_groups:
            group["lr"] = rate(step, share)
        loss, figures = loss_of()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, clip)
        optimizer.step()
        after()
        run.rows.append(figures)
        run.seconds = time.monotonic() - began
        if share >= shown:
            shown = share + SHOWN
            means = "".join(f"  {key} {run.mean(key):.4f}" for key in figures)
            print(f"{run.seconds:6.0f} s  {name} {step:5d}{means}", file=sys.stderr, flush=True)
    return run


def cosine(share: float) -> float:
    """Return the learning rate's factor: from 1 down to 0.02."""
    return 0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * share))


def cosine_after_warmup(step: int, total: int, warmup: int) -> float:
    """Return the learning rate's factor: linear to 1 over `warmup` steps, then a cosine."""
    if step < warmup:
        return (step + 1) / warmup
    return cosine(min(1.0, (step - warmup) / max(1, total - warmup)))


def fit_average(
    name: str,
    model: Any,
    loss_of: Callable[[], tuple[Any, Mapping[str, float]]],
    recipe: Recipe,
    memory_steps: int,
) -> tuple[Any, Run]:
    """Train a model of lerobot's with its configuration's rate and decay.

    Returns it with the running average of its weights, unless the run is so short that the average
    still contains the untrained ones.
    """
    import torch
    from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

    config = model.config
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.optimizer_lr, weight_decay=config.optimizer_weight_decay
    )
    averaged = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / memory_steps))
    warmup = max(1, min(100, recipe.steps // 10))

    def rate(step: int, share: float) -> float:
        return float(config.optimizer_lr * min(1.0, (step + 1) / warmup) * cosine(share))

    model.train()
    run = fit(
        name, model.parameters(), optimizer, rate, loss_of, steps=recipe.steps,
        time_limit_s=recipe.time_limit_s, after=lambda: averaged.update_parameters(model),
    )  # fmt: skip
    best = averaged.module if len(run.rows) >= 2 * memory_steps else model
    return best.eval(), run


def batches(count: int, size: int, seed: int) -> Iterator[list[int]]:
    """Yield endless shuffled batches of indices; a pass's last batch is filled from the next."""
    rng = random.Random(f"batches-{seed}")
    queue: list[int] = []
    while True:
        while len(queue) < size:
            order = list(range(count))
            rng.shuffle(order)
            queue += order
        yield queue[:size]
        del queue[:size]


# -- random light
def tinted(images: Any, generator: Any) -> Any:
    """Return float images (n, 3, h, w) in 0..1 under a random tint, light and noise."""
    import torch

    gain = 1 + 0.06 * torch.randn(len(images), 3, 1, 1, generator=generator)
    light = 0.05 * torch.randn(len(images), 1, 1, 1, generator=generator)
    noise = 0.01 * torch.randn(images.shape, generator=generator)
    return (images * gain + light + noise).clamp(0, 1)


def lit(images: Any, generator: Any, strength: float = 0.12) -> Any:
    """Return float images (n, 3, h, w) in 0..1 under random exposure, white balance and noise.

    Names of colors stay true.
    """
    import torch

    count = len(images)
    gain = 1.0 + strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    balance = 1.0 + 0.3 * strength * (2 * torch.rand(count, 3, 1, 1, generator=generator) - 1)
    offset = 0.3 * strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    noise = 0.02 * torch.randn(images.shape, generator=generator)
    return (images * gain * balance + offset + noise).clamp(0.0, 1.0)


def as_floats(images: Any) -> Any:
    """Convert a uint8 array (n, h, w, 3) to a float tensor (n, 3, h, w) in 0..1."""
    import torch

    return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255


# -- figures
def share(flags: Iterable[object]) -> float:
    """Return which part of the flags is true, 0 for none at all."""
    counted = [bool(flag) for flag in flags]
    return round(sum(counted) / max(1, len(counted)), 4)


def median_ms(call: Callable[[], object], times: int = 15) -> float:
    """Return median milliseconds of a call."""
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        taken.append(1000 * (time.perf_counter() - began))
    return round(sorted(taken)[times // 2], 1)


def table(rows: Sequence[JsonMap]) -> str:
    """Return rows of equal keys as a Markdown table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def write_card(out: Path, trainer: Trainer, recipe: Recipe, report: Report) -> JsonObject:
    """Write the model card of a checkpoint. Returns its figures."""
    from safetensors.torch import load_file

    weights = out / "model.safetensors"
    figures = {
        **report.figures,
        "parameters": sum(tensor.numel() for tensor in load_file(weights).values()),
        "bytes": weights.stat().st_size,
    }
    told = [{"": key, "value": value} for key, value in figures.items()]
    made = [{"": key, "value": value} for key, value in dataclasses.asdict(recipe).items()]
    parts = [
        f"---\nlicense: apache-2.0\nlibrary_name: {trainer.library}\n---\n# {trainer.model}\n",
        "Trained from scratch by `training/`, whose README says what the figures mean.\n",
        f"## Figures\n\n{table(told)}\n",
        f"## Recipe\n\n{table(made)}\n",
        *([f"## Held out\n\n{table(report.held_out)}\n"] if report.held_out else []),
    ]
    (out / "README.md").write_text("\n".join(parts), encoding="utf-8")
    return figures
