"""Shared by the training scripts: labeled frames on disk, words for objects, seeding, small BPE.

A data set is a folder with `labels.jsonl`, one JSON object per frame, and the PNGs it names. Must
not know the simulator that made the frames (it reads files only) nor either model. torch and its
like are imported late.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
import math
import os
import random
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from vram_arbiter.schemas.plain import JsonMap

LABELS_FILE: Final = "labels.jsonl"
# Below this many visible pixels (at the frame's own size) an object is too hidden for a yes or no.
MIN_VISIBLE_PIXELS: Final = 100


class BadDataset(ValueError):
    """The folder is not a data set of labeled frames; the message names line or file."""


@dataclasses.dataclass(frozen=True, slots=True)
class SeenObject:
    """One visible object of a frame. `box` is (x0, y0, x1, y1) in pixels, of its visible part."""

    name: str
    box: tuple[float, float, float, float]
    pixels: int

    @property
    def clear(self) -> bool:
        """Whether a detector must find it; otherwise finding it is neither right nor wrong."""
        return self.pixels >= MIN_VISIBLE_PIXELS

    @property
    def colour(self) -> str:
        """First word of the name."""
        return self.name.split(" ", 1)[0]

    @property
    def shape(self) -> str:
        """Rest of the name."""
        return self.name.split(" ", 1)[1]


@dataclasses.dataclass(frozen=True, slots=True)
class Frame:
    """One labeled image. `scene` groups frames of the same episode: a split never separates them.

    `objects` are those that show in the image, `present` names all that exist in the scene.
    """

    image: Path
    camera: str
    scene: str
    stage: str
    objects: tuple[SeenObject, ...]
    present: tuple[str, ...]
    held: str | None


def read_frames(folder: Path, cameras: Sequence[str] | None = None) -> list[Frame]:
    """Return all frames of a data set (of these cameras), in file order. Raises BadDataset."""
    labels = folder / LABELS_FILE
    if not labels.is_file():
        raise BadDataset(
            f"{labels} is missing: make a data set with `python -m "
            "vram_arbiter.runner.sim.training.dataset scenes`"
        )
    frames: list[Frame] = []
    for number, line in enumerate(labels.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            frame = _frame(folder, json.loads(line))
        except (KeyError, TypeError, ValueError) as error:
            raise BadDataset(f"{labels}:{number}: {error!r}") from error
        if cameras is None or frame.camera in cameras:
            frames.append(frame)
    if not frames:
        raise BadDataset(f"{labels} has no frame of the cameras {list(cameras or ())}")
    return frames


def _frame(folder: Path, raw: JsonMap) -> Frame:
    objects = tuple(
        SeenObject(
            name=f"{item['colour']} {item['shape']}",
            box=(
                float(item["box"][0]),
                float(item["box"][1]),
                float(item["box"][2]),
                float(item["box"][3]),
            ),
            pixels=int(item["pixels"]),
        )
        for item in raw["objects"]
        if item["box"] is not None
    )
    held = raw["held"]
    return Frame(
        image=folder / str(raw["file"]),
        camera=str(raw["camera"]),
        scene=str(raw["seed"]),
        stage=str(raw["stage"]),
        objects=objects,
        present=tuple(f"{item['colour']} {item['shape']}" for item in raw["objects"]),
        held=None if held is None else str(held),
    )


def visible_names(frame: Frame) -> list[str]:
    """Return names of the clearly visible objects, from left to right."""
    return [o.name for o in sorted(frame.objects, key=lambda o: o.box[0] + o.box[2]) if o.clear]


def split_by_scene(
    frames: Sequence[Frame], held_out: float, seed: int
) -> tuple[list[Frame], list[Frame]]:
    """Return (training, held-out) frames; whole scenes go to one side, at least one each."""
    scenes = sorted({frame.scene for frame in frames})
    if len(scenes) < 2:
        raise BadDataset("a data set needs at least two scenes, or nothing can be held out")
    random.Random(f"split-{seed}").shuffle(scenes)
    count = min(len(scenes) - 1, max(1, round(len(scenes) * held_out)))
    away = set(scenes[:count])
    return [f for f in frames if f.scene not in away], [f for f in frames if f.scene in away]


def seed_everything(seed: int, threads: int) -> None:
    """Seed everything: same seed, thread count and library versions give the same checkpoint."""
    import numpy as np
    import torch

    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.set_num_threads(threads)


def load_pixels(frames: Sequence[Frame], size: tuple[int, int]) -> Any:
    """Return a uint8 tensor (frames, 3, height, width), resized to `size` = (width, height)."""
    import numpy as np
    import torch
    from PIL import Image

    out: Any = np.empty((len(frames), size[1], size[0], 3), dtype=np.uint8)
    for index, frame in enumerate(frames):
        with Image.open(frame.image) as image:
            rgb = image.convert("RGB")
            out[index] = np.asarray(
                rgb if rgb.size == size else rgb.resize(size, Image.Resampling.BICUBIC)
            )
    return torch.from_numpy(out).permute(0, 3, 1, 2)


def jitter_colours(images: Any, generator: Any, strength: float) -> Any:
    """Return float images (n, 3, h, w) in 0..1 under random exposure, white balance and noise.

    Hue names stay true.
    """
    import torch

    count = images.shape[0]
    gain = 1.0 + strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    balance = 1.0 + 0.3 * strength * (2 * torch.rand(count, 3, 1, 1, generator=generator) - 1)
    offset = 0.3 * strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    noise = 0.02 * torch.randn(images.shape, generator=generator)
    return (images * gain * balance + offset + noise).clamp(0.0, 1.0)


def cosine_with_warmup(step: int, total: int, warmup: int) -> float:
    """Return the learning rate's factor: linear to 1 over `warmup` steps, then a cosine down to
    0.02."""
    if step < warmup:
        return (step + 1) / warmup
    done = min(1.0, (step - warmup) / max(1, total - warmup))
    return 0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * done))


def byte_alphabet() -> list[str]:
    """Return the 256 printable stand-ins for bytes of byte-level BPE, in a fixed order."""
    from tokenizers.pre_tokenizers import ByteLevel

    return sorted(ByteLevel.alphabet())


def learn_merges(words: Iterable[str], *, suffix: str) -> tuple[list[str], list[tuple[str, str]]]:
    """Return (tokens, merges) of a BPE that makes each word one token, pieces shared where
    possible.

    `words` are already in byte-level form; `suffix` closes a word (CLIP: `</w>`, Qwen: none). Ties
    are broken by the alphabet, so that the same words give the same tokenizer on every machine.
    """
    pieces = {word: [*word[:-1], word[-1] + suffix] for word in sorted(set(words)) if word}
    tokens: list[str] = []
    merges: list[tuple[str, str]] = []
    while True:
        pairs: collections.Counter[tuple[str, str]] = collections.Counter()
        for parts in pieces.values():
            pairs.update(itertools.pairwise(parts))
        if not pairs:
            return tokens, merges
        best = min(pairs, key=lambda pair: (-pairs[pair], pair))
        merges.append(best)
        tokens.append(best[0] + best[1])
        for parts in pieces.values():
            at = 0
            while at < len(parts) - 1:
                if (parts[at], parts[at + 1]) == best:
                    parts[at : at + 2] = [best[0] + best[1]]
                at += 1


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


def folder_bytes(folder: Path) -> int:
    """Return the size of all files under a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
