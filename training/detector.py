"""Trainer of the small open-vocabulary detector, an OwlViT, saved as a zero-shot checkpoint.

Loss: each patch with its center in the middle of an object (or the patch nearest to it) must say
yes to the queries that name it and no to all others; its box is fitted by L1 and GIoU. Patches that
only touch the object are left out. Must not know the simulator or the sidecar.
"""

from __future__ import annotations

import dataclasses
import itertools
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from training import queries
from training.common import (
    Report,
    Run,
    Trainer,
    batches,
    cosine_after_warmup,
    fit,
    lit,
    seed_everything,
)
from training.datasets import Frame, Words, load_pixels, read_frames, split_by_scene, vocabulary
from training.detector_model import SMOKE, DetectorRecipe, build_model, build_processor, take_over
from training.detector_report import area, corners, report

type Thing = tuple[str, tuple[float, float, float, float], bool]
"""Name, box (x0, y0, x1, y1 in 0..1), and whether a model must see it."""


def tokenized(tokenizer: Any, asked: Sequence[queries.Query]) -> Any:
    """Return ids and mask of queries."""
    texts = [query.text for query in asked]
    return tokenizer(texts, padding="max_length", truncation=True, return_tensors="pt")


def teach_words(model: Any, tokenizer: Any, recipe: DetectorRecipe, words: Words) -> Run:
    """Fit the text tower alone: a query's vector is the codes of its color and shape, or `nothing`.

    The codes are random orthogonal directions; the image side then has fixed targets from its first
    step, where learning both towers at once spends minutes on a plateau.
    """
    import torch

    rng = random.Random(f"words-{recipe.seed}")
    basis = torch.linalg.qr(torch.randn(recipe.text_width, recipe.text_width))[0]
    code = {word: basis[i] for i, word in enumerate([*itertools.chain(*words), ""])}
    text, project = model.owlvit.text_model, model.owlvit.text_projection
    parameters = [*text.parameters(), *project.parameters()]
    nothing = torch.zeros(recipe.text_width)

    def loss_of() -> Any:
        asked = [
            query
            for _ in range(4)
            for query in queries.sample_queries(rng, *words, 3 * recipe.strange_queries)
        ]
        known = [[part for part in (q.color, q.shape) if part is not None] for q in asked]
        wanted = [
            sum((code[part] for part in parts), nothing) if query.known else code[""]
            for query, parts in zip(asked, known, strict=True)
        ]
        got = project(text(**tokenized(tokenizer, asked)).pooler_output)
        cosine = torch.nn.functional.cosine_similarity(got, torch.stack(wanted))
        return (1.0 - cosine).mean(), {"cosine": float(cosine.mean().detach())}

    return fit(
        "words", parameters, torch.optim.AdamW(parameters, lr=2e-3, weight_decay=0.01),
        lambda step, _: 2e-3 * cosine_after_warmup(step, recipe.word_steps, 30), loss_of,
        steps=recipe.word_steps, clip=float("inf"),
    )  # fmt: skip


@dataclasses.dataclass(slots=True)
class Targets:
    """Labels of a batch on the patch grid: the object that a patch stands for, and those it
    touches."""

    names: list[list[str]]
    boxes: Any  # (batch, things, 4) center and size in 0..1, zero where padded
    owner: Any  # (batch, patches) index of the object, -1 for none
    touched: Any  # (batch, patches, things) bool: neither yes nor no


def make_targets(things: Sequence[Sequence[Thing]], side: int) -> Targets:
    """Label a batch; `things` are those of each image."""
    import torch

    most = max(1, max(len(row) for row in things))
    boxes = torch.zeros(len(things), most, 4)
    owner = torch.full((len(things), side * side), -1, dtype=torch.long)
    touched = torch.zeros(len(things), side * side, most, dtype=torch.bool)
    middle = (torch.arange(side) + 0.5) / side
    my, mx = (grid.reshape(-1) for grid in torch.meshgrid(middle, middle, indexing="ij"))
    half = 0.5 / side
    for b, row in enumerate(things):
        # the smallest last: a patch shared by two objects goes to the smaller
        for t, (_, (x0, y0, x1, y1), clear) in sorted(
            enumerate(row), key=lambda item: -area(item[1][1])
        ):
            cx, cy, w, h = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
            boxes[b, t] = torch.tensor([cx, cy, w, h])
            touched[b, :, t] = (
                (mx + half > x0) & (mx - half < x1) & (my + half > y0) & (my - half < y1)
            )
            if clear:
                core = ((mx - cx).abs() < 0.3 * w) & ((my - cy).abs() < 0.3 * h)
                core[((mx - cx) ** 2 + (my - cy) ** 2).argmin()] = True
                owner[b, core] = t
    return Targets([[name for name, _, _ in row] for row in things], boxes, owner, touched)


def loss_of_batch(
    model: Any, pixels: Any, targets: Targets, asked: Sequence[queries.Query], text: Any
) -> Any:
    """Return focal classification over (patch, query) plus box loss over owning patches."""
    import torch
    from torch.nn import functional
    from torchvision.ops import generalized_box_iou_loss

    batch, most = targets.boxes.shape[:2]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        grid, _ = model.image_embedder(pixels)
    # the text tower is trained already and frozen: fixed targets, and a tenth less work
    with torch.no_grad():
        words = model.owlvit.text_projection(model.owlvit.text_model(**text).pooler_output)
    words = words.float()
    words = words / words.norm(dim=-1, keepdim=True)
    patches = grid.flatten(1, 2).float()
    logits, _ = model.class_predictor(patches, words[None].expand(batch, -1, -1))
    predicted = model.box_predictor(patches, grid)

    answers = torch.zeros(batch, most, len(asked))
    for b, names in enumerate(targets.names):
        for t, name in enumerate(names):
            answers[b, t] = torch.tensor([float(query.matches(name)) for query in asked])
    owned = targets.owner >= 0
    owner = targets.owner.clamp(min=0)[..., None]
    wanted = torch.gather(answers, 1, owner.expand(-1, -1, len(asked))) * owned[..., None]
    # a patch that touches an object without owning it may answer its queries either way
    unsure = torch.einsum("bpt,btq->bpq", targets.touched.float(), answers) > 0
    weight = 1.0 - (unsure & (wanted == 0)).float()
    # right color and wrong shape, or the reverse, is the mistake to unlearn: objects weigh more
    weight = weight * (1.0 + 2.0 * owned[..., None])
    chance = logits.sigmoid()
    raw = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    focus = torch.where(wanted > 0, 1 - chance, chance) ** 2
    alpha = torch.where(wanted > 0, 0.75, 0.25)
    class_loss = (raw * focus * alpha * weight).sum() / wanted.sum().clamp(min=1.0)

    truth = torch.gather(targets.boxes, 1, owner.expand(-1, -1, 4))[owned]
    mine = predicted[owned]
    if len(truth) == 0:
        return class_loss
    box_loss = functional.l1_loss(mine, truth, reduction="sum") / len(truth)
    iou_loss = generalized_box_iou_loss(corners(mine), corners(truth), reduction="mean")
    return class_loss + 3.0 * box_loss + 0.5 * iou_loss


def augment(
    rng: random.Random, generator: Any, images: Any, frames: Sequence[Frame], size_px: int
) -> tuple[Any, list[list[Thing]]]:
    """Apply random zoom, shift, mirror and light; boxes follow.

    Returns float images in 0..1 and their objects.
    """
    import torch

    height, width = images.shape[-2:]
    out = torch.empty(len(frames), 3, size_px, size_px)
    things: list[list[Thing]] = []
    for index, frame in enumerate(frames):
        zoom = 1.0 if rng.random() < 0.4 else rng.uniform(0.45, 1.0)
        stretch = rng.uniform(0.92, 1.0) if zoom < 1.0 else 1.0
        w, h = zoom * width, zoom * height * stretch
        x, y = rng.uniform(0, width - w), rng.uniform(0, height - h)
        x0, y0, x1, y1 = round(x), round(y), round(x + w), round(y + h)
        crop = images[index : index + 1, :, y0:y1, x0:x1].float() / 255.0
        crop = torch.nn.functional.interpolate(
            crop, (size_px, size_px), mode="bilinear", antialias=True, align_corners=False
        )
        mirror = rng.random() < 0.5
        out[index] = crop[0].flip(-1) if mirror else crop[0]
        row: list[Thing] = []
        for seen in frame.objects:
            left, top = (seen.box[0] - x0) / (x1 - x0), (seen.box[1] - y0) / (y1 - y0)
            right, bottom = (seen.box[2] - x0) / (x1 - x0), (seen.box[3] - y0) / (y1 - y0)
            cut = (max(0.0, left), max(0.0, top), min(1.0, right), min(1.0, bottom))
            if cut[2] <= cut[0] or cut[3] <= cut[1]:
                continue
            whole = area(cut) / ((right - left) * (bottom - top))
            box = (1 - cut[2], cut[1], 1 - cut[0], cut[3]) if mirror else cut
            row.append((seen.name, box, seen.clear and whole > 0.6))
        things.append(row)
    return lit(out, generator), things


def fit_images(
    model: Any,
    processor: Any,
    recipe: DetectorRecipe,
    frames: Sequence[Frame],
    words: Words,
) -> Run:
    """Fit the image side, with the text tower as it is"""
    import torch
    from PIL import Image

    with Image.open(frames[0].image) as first:
        pixels = load_pixels(frames, first.size)
    images = processor.image_processor
    mean, std = (torch.tensor(v)[:, None, None] for v in (images.image_mean, images.image_std))
    groups: dict[bool, list[Any]] = {True: [], False: []}
    for name, parameter in model.named_parameters():
        groups[parameter.ndim >= 2 and "embedding" not in name].append(parameter)
    optimizer = torch.optim.AdamW(
        [
            {"params": groups[True], "weight_decay": 0.03},
            {"params": groups[False], "weight_decay": 0.0},
        ],
        lr=recipe.learning_rate,
        betas=(0.9, 0.98),
    )
    rng = random.Random(f"detector-{recipe.seed}")
    generator = torch.Generator().manual_seed(recipe.seed)
    chosen = batches(len(frames), recipe.batch, recipe.seed)

    def loss_of() -> Any:
        picks = next(chosen)
        picked = [frames[i] for i in picks]
        batch, things = augment(rng, generator, pixels[picks], picked, recipe.image_px)
        asked = queries.sample_queries(rng, *words, recipe.strange_queries)
        targets = make_targets(things, recipe.image_px // recipe.patch_px)
        text = tokenized(processor.tokenizer, asked)
        loss = loss_of_batch(model, (batch - mean) / std, targets, asked, text)
        return loss, {"loss": loss.item()}

    return fit(
        "images", model.parameters(), optimizer,
        lambda _, share: recipe.learning_rate * cosine_after_warmup(round(1000 * share), 1000, 30),
        loss_of, steps=recipe.steps, time_limit_s=recipe.time_limit_s,
    )  # fmt: skip


def train(recipe: DetectorRecipe, data: Sequence[Path], out: Path, start: Path | None) -> Report:
    """Train, write the checkpoint, judge it on the held-out scenes."""
    frames = read_frames(data, recipe.camera)
    learn, kept = split_by_scene(frames, recipe.held_out, recipe.split_seed)
    known, words = vocabulary(frames)[1], vocabulary(learn)[1]
    seed_everything(recipe)
    processor = build_processor(out, recipe.image_px, queries.every_word(*known))
    model = build_model(recipe, processor.tokenizer)
    model.train()
    if start is None:
        teach_words(model, processor.tokenizer, recipe, words)
    else:
        take_over(model, start)
    run = fit_images(model, processor, recipe, learn, words)
    model.eval().save_pretrained(out)
    return report(out, kept, recipe.seed, run.figures() | {"train_frames": len(learn)})


TRAINER: Final = Trainer(
    model="so101-detector",
    library="transformers\npipeline_tag: zero-shot-object-detection",
    recipe=DetectorRecipe(),
    smoke=SMOKE,
    train=train,
)
