"""Training of the demo's open-vocabulary detector: a small OwlViT, saved as a zero-shot checkpoint.

`python -m vram_arbiter.sidecars.training.detector --data DIR --out DIR [--smoke]`. DIR holds
`labels.jsonl` and PNGs. The result is read by `AutoProcessor` and
`AutoModelForZeroShotObjectDetection` like google/owlvit-base-patch32. Must not know the simulator
or the sidecar that will serve the model.

Loss: each patch with its center in the middle of an object (or the patch nearest to it) must say
yes to the queries that name it and no to all others; its box is fitted by L1 and GIoU. Patches that
only touch the object are left out.
"""

from __future__ import annotations

import dataclasses
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.sidecars.training import common, queries
from vram_arbiter.sidecars.training.command import run_command
from vram_arbiter.sidecars.training.common import Frame
from vram_arbiter.sidecars.training.detector_model import (
    SMOKE,
    Recipe,
    build_model,
    build_processor,
    take_over,
)
from vram_arbiter.sidecars.training.detector_report import (
    CARD,
    area,
    card_rows,
    choose_threshold,
    corners,
    inference_ms,
    rates,
    run_trials,
)


def teach_words(
    model: Any, tokenizer: Any, recipe: Recipe, colours: Sequence[str], shapes: Sequence[str]
) -> float:
    """Fit the text tower alone: a query's vector is the codes of its color and shape, or of
    `nothing`.

    The codes are random orthogonal directions; the image side then has fixed targets from its first
    step, where learning both towers at once spends minutes on a plateau. Returns the mean cosine
    that was reached.
    """
    import torch

    rng = random.Random(f"words-{recipe.seed}")
    basis = torch.linalg.qr(torch.randn(recipe.text_width, recipe.text_width))[0]
    code = {word: basis[i] for i, word in enumerate([*colours, *shapes, ""])}
    text, project = model.owlvit.text_model, model.owlvit.text_projection
    optimizer = torch.optim.AdamW(
        [*text.parameters(), *project.parameters()], lr=2e-3, weight_decay=0.01
    )
    reached = 0.0
    for step in range(recipe.word_steps):
        for group in optimizer.param_groups:
            group["lr"] = 2e-3 * common.cosine_with_warmup(step, recipe.word_steps, 30)
        asked = [
            q
            for _ in range(4)
            for q in queries.sample_queries(rng, colours, shapes, 3 * recipe.strange_queries)
        ]
        batch = tokenizer(
            [q.text for q in asked], padding="max_length", truncation=True, return_tensors="pt"
        )
        wanted = torch.stack(
            [
                sum(
                    (code[part] for part in (q.colour, q.shape) if part is not None),
                    torch.zeros(recipe.text_width),
                )
                if q.known
                else code[""]
                for q in asked
            ]
        )
        got = project(
            text(input_ids=batch["input_ids"], attention_mask=batch["attention_mask"]).pooler_output
        )
        cosine = torch.nn.functional.cosine_similarity(got, wanted)
        loss = (1.0 - cosine).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        reached = float(cosine.mean().detach())
    return reached


@dataclasses.dataclass(slots=True)
class Targets:
    """Labels of a batch on the patch grid: the object that a patch stands for, and those it
    touches."""

    names: list[list[str]]
    boxes: Any  # (batch, things, 4) centre-size in 0..1, zero where padded
    owner: Any  # (batch, patches) index of the object, -1 for none
    touched: Any  # (batch, patches, things) bool: neither yes nor no


def make_targets(things: Sequence[Sequence[tuple[str, Any, bool]]], side: int) -> Targets:
    """Label a batch. `things`: per image (name, box x0 y0 x1 y1 in 0..1, clear)."""
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
        for t, (_, box, clear) in sorted(enumerate(row), key=lambda item: -area(item[1][1])):
            x0, y0, x1, y1 = (float(v) for v in box)
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


def loss_of(
    model: Any, pixels: Any, targets: Targets, asked: Sequence[queries.Query], ids: Any, mask: Any
) -> Any:
    """Return focal classification over (patch, query) plus box loss over owning patches."""
    import torch
    from torch.nn import functional
    from torchvision.ops import generalized_box_iou_loss

    batch = pixels.shape[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        grid, _ = model.image_embedder(pixels)
    # the text tower is trained already and frozen: fixed targets, and a tenth less work
    with torch.no_grad():
        words = model.owlvit.text_projection(
            model.owlvit.text_model(input_ids=ids, attention_mask=mask).pooler_output
        )
    words = words.float()
    words = words / words.norm(dim=-1, keepdim=True)
    patches = grid.flatten(1, 2).float()
    logits, _ = model.class_predictor(patches, words[None].expand(batch, -1, -1))
    predicted = model.box_predictor(patches, grid)

    most = targets.boxes.shape[1]
    answers = torch.zeros(batch, most, len(asked))
    for b, names in enumerate(targets.names):
        for t, name in enumerate(names):
            colour, shape = name.split(" ", 1)
            answers[b, t] = torch.tensor([float(query.matches(colour, shape)) for query in asked])
    owned = targets.owner >= 0
    owner = targets.owner.clamp(min=0)
    wanted = (
        torch.gather(answers, 1, owner[..., None].expand(-1, -1, len(asked))) * owned[..., None]
    )
    # a patch that touches an object without owning it may answer its queries either way
    unsure = torch.einsum("bpt,btq->bpq", targets.touched.float(), answers) > 0
    weight = 1.0 - (unsure & (wanted == 0)).float()
    # right color and wrong shape, or the reverse, is the mistake to unlearn: objects weigh more
    weight = weight * (1.0 + 2.0 * owned[..., None])
    chance = logits.sigmoid()
    raw = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    focus = torch.where(wanted > 0, 1 - chance, chance) ** 2
    alpha = torch.where(wanted > 0, 0.75, 0.25)
    count = wanted.sum().clamp(min=1.0)
    class_loss = (raw * focus * alpha * weight).sum() / count

    truth = torch.gather(targets.boxes, 1, owner[..., None].expand(-1, -1, 4))[owned]
    mine = predicted[owned]
    if len(truth) == 0:
        return class_loss
    box_loss = functional.l1_loss(mine, truth, reduction="sum") / len(truth)
    iou_loss = generalized_box_iou_loss(corners(mine), corners(truth), reduction="mean")
    return class_loss + 3.0 * box_loss + 0.5 * iou_loss


def augment(
    rng: random.Random, generator: Any, images: Any, frames: Sequence[Frame], size_px: int
) -> tuple[Any, list[list[tuple[str, Any, bool]]]]:
    """Apply random zoom, shift, mirror and light; boxes follow.

    Returns float images in 0..1 and their objects.
    """
    import torch
    from torch.nn import functional

    height, width = images.shape[-2:]
    out = torch.empty(len(frames), 3, size_px, size_px)
    things: list[list[tuple[str, Any, bool]]] = []
    for index, frame in enumerate(frames):
        zoom = 1.0 if rng.random() < 0.4 else rng.uniform(0.45, 1.0)
        stretch = rng.uniform(0.92, 1.0) if zoom < 1.0 else 1.0
        w, h = zoom * width, zoom * height * stretch
        x, y = rng.uniform(0, width - w), rng.uniform(0, height - h)
        x0, y0, x1, y1 = round(x), round(y), round(x + w), round(y + h)
        crop = images[index : index + 1, :, y0:y1, x0:x1].float() / 255.0
        crop = functional.interpolate(
            crop, (size_px, size_px), mode="bilinear", antialias=True, align_corners=False
        )
        mirror = rng.random() < 0.5
        out[index] = crop[0].flip(-1) if mirror else crop[0]
        row: list[tuple[str, Any, bool]] = []
        for seen in frame.objects:
            left, top = (seen.box[0] - x0) / (x1 - x0), (seen.box[1] - y0) / (y1 - y0)
            right, bottom = (seen.box[2] - x0) / (x1 - x0), (seen.box[3] - y0) / (y1 - y0)
            cut = (max(0.0, left), max(0.0, top), min(1.0, right), min(1.0, bottom))
            if cut[2] <= cut[0] or cut[3] <= cut[1]:
                continue
            whole = (cut[2] - cut[0]) * (cut[3] - cut[1]) / ((right - left) * (bottom - top))
            box = (1 - cut[2], cut[1], 1 - cut[0], cut[3]) if mirror else cut
            row.append((seen.name, box, seen.clear and whole > 0.6))
        things.append(row)
    return common.jitter_colours(out, generator, 0.12), things


def train(
    recipe: Recipe,
    frames: Sequence[Frame],
    words: Sequence[str],
    out: Path,
    start: Path | None = None,
) -> tuple[Any, Any, JsonObject]:
    """Train on `frames`, from the weights of `start` if given.

    Returns (processor, model, figures of the run).
    """
    import torch

    common.seed_everything(recipe.seed, recipe.threads)
    colours = sorted({thing.colour for frame in frames for thing in frame.objects})
    shapes = sorted({thing.shape for frame in frames for thing in frame.objects})
    processor = build_processor(out, recipe.image_px, words)
    model = build_model(recipe, processor.tokenizer)
    model.train()
    from PIL import Image

    with Image.open(frames[0].image) as first:
        pixels = common.load_pixels(frames, first.size)
    mean = torch.tensor(processor.image_processor.image_mean)[:, None, None]
    std = torch.tensor(processor.image_processor.image_std)[:, None, None]
    plain = [p for n, p in model.named_parameters() if p.ndim < 2 or "embedding" in n]
    decayed = [p for n, p in model.named_parameters() if not (p.ndim < 2 or "embedding" in n)]
    optimizer = torch.optim.AdamW(
        [{"params": decayed, "weight_decay": 0.03}, {"params": plain, "weight_decay": 0.0}],
        lr=recipe.learning_rate,
        betas=(0.9, 0.98),
    )
    rng = random.Random(f"detector-{recipe.seed}")
    generator = torch.Generator().manual_seed(recipe.seed)
    started, step, shown = time.monotonic(), 0, 0.0
    if start is None:
        cosine = teach_words(model, processor.tokenizer, recipe, colours, shapes)
        print(f"{time.monotonic() - started:6.0f} s  words: mean cosine {cosine:.3f}", flush=True)
    else:
        take_over(model, start)
    losses: list[float] = []
    for chosen in common.batches(len(frames), recipe.batch, recipe.seed):
        done = max((time.monotonic() - started) / recipe.budget_s, step / recipe.max_steps)
        if done >= 1.0:
            break
        factor = common.cosine_with_warmup(round(done * 1000), 1000, 30)
        for group in optimizer.param_groups:
            group["lr"] = recipe.learning_rate * factor
        picked = [frames[i] for i in chosen]
        images, things = augment(rng, generator, pixels[chosen], picked, recipe.image_px)
        asked = queries.sample_queries(rng, colours, shapes, recipe.strange_queries)
        text = processor.tokenizer(
            [query.text for query in asked],
            padding="max_length",
            truncation=True,
            return_tensors="pt",
        )
        targets = make_targets(things, recipe.image_px // recipe.patch_px)
        loss = loss_of(
            model, (images - mean) / std, targets, asked, text["input_ids"], text["attention_mask"]
        )
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        step += 1
        losses.append(loss.item())
        if done - shown >= 0.05:
            shown = done
            recent = sum(losses[-50:]) / len(losses[-50:])
            print(
                f"{time.monotonic() - started:6.0f} s  step {step:5d}  loss {recent:.3f}",
                flush=True,
            )
    model.eval()
    return (
        processor,
        model,
        {
            "steps": step,
            "train_frames": len(frames),
            "train_s": round(time.monotonic() - started, 1),
            "loss_first": round(sum(losses[:10]) / len(losses[:10]), 3),
            "loss_last": round(sum(losses[-10:]) / len(losses[-10:]), 3),
        },
    )


def run(recipe: Recipe, data: Path, out: Path, start: Path | None = None) -> JsonObject:
    """Train, save, evaluate the saved checkpoint as a user would load it, write the model card.

    Returns the figures.
    """
    from transformers import AutoModelForZeroShotObjectDetection, AutoProcessor

    frames = common.read_frames(data, [recipe.camera])
    training, testing = common.split_by_scene(frames, recipe.held_out, recipe.split_seed)
    out.mkdir(parents=True, exist_ok=True)
    names = sorted({name for frame in frames for name in frame.present})
    words = queries.every_word(
        sorted({n.split()[0] for n in names}), sorted({n.split()[1] for n in names})
    )
    _, trained, figures = train(recipe, training, words, out, start)
    trained.save_pretrained(out)
    processor = AutoProcessor.from_pretrained(out, local_files_only=True)
    model = AutoModelForZeroShotObjectDetection.from_pretrained(out, local_files_only=True)
    model.eval()
    trials = run_trials(processor, model, testing, recipe.seed)
    threshold = choose_threshold(trials)
    figures |= {
        "threshold": threshold,
        "test_frames": len(testing),
        "parameters": sum(p.numel() for p in model.parameters()),
        "inference_ms": inference_ms(processor, model, testing[0]),
        "bytes": common.folder_bytes(out),
        **rates(trials, threshold),
    }
    card = CARD.format(
        **{**dataclasses.asdict(recipe), **figures},
        min_pixels=common.MIN_VISIBLE_PIXELS,
        rows=card_rows(trials, threshold),
    )
    (out / "README.md").write_text(card, encoding="utf-8")
    return figures


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 2 for a folder that is not a data set."""
    limits = {
        "--steps": ("max_steps", "steps; default: the recipe's", int),
        "--budget-s": (
            "budget_s", "time limit in seconds; the learning rate follows it", float
        ),
    }  # fmt: skip
    program = "python -m vram_arbiter.sidecars.training.detector"
    return run_command(argv, program, __doc__, (Recipe(), SMOKE), limits, run)


if __name__ == "__main__":
    sys.exit(main())
