"""Training of the demo's scene VLM: a small Qwen3.5, saved as an image-text-to-text checkpoint.

`python -m vram_arbiter.sidecars.training.scene_vlm --data DIR --out DIR [--smoke]`. DIR holds
`labels.jsonl` and PNGs. The result is read by `AutoProcessor` and `AutoModelForImageTextToText`
like Qwen/Qwen3.5-4B: chat template, `generate`. Must not know the simulator or the sidecar that
will serve the model.

Three stages: the vision tower learns, through throw-away linear heads on its mean output token,
what is held and what shows; then the language model learns to answer from the tower's tokens; at
last both are fitted together.
"""

from __future__ import annotations

import dataclasses
import math
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.sidecars.training import common, questions
from vram_arbiter.sidecars.training.command import run_command
from vram_arbiter.sidecars.training.common import Frame, visible_names
from vram_arbiter.sidecars.training.scene_vlm_model import (
    SMOKE,
    VlmRecipe,
    build_model,
    build_processor,
    image_tokens,
    take_over,
    to_patches,
)
from vram_arbiter.sidecars.training.scene_vlm_report import (
    CARD,
    Asker,
    card_rows,
    evaluate,
    inference_ms,
    share,
)


def augment(images: Any, generator: Any) -> Any:
    """Augment uint8 images by small random shifts, zooms and light.

    They are never mirrored, because the gripper is not symmetric.
    """
    import torch

    count = images.shape[0]
    zoom = 1.0 - 0.08 * torch.rand(count, generator=generator)
    shift = (2 * torch.rand(count, 2, generator=generator) - 1) * (1 - zoom)[:, None]
    theta = torch.zeros(count, 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = zoom
    theta[:, :, 2] = shift
    grid = torch.nn.functional.affine_grid(theta, list(images.shape), align_corners=False)
    moved = torch.nn.functional.grid_sample(
        images.float() / 255.0, grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return common.jitter_colours(moved, generator, 0.12)


class Heads:
    """Throw-away linear heads on the mean image token: what is held, and what shows."""

    def __init__(self, width: int, names: Sequence[str]) -> None:
        import torch

        self.names = list(names)
        self.held = torch.nn.Linear(width, len(names) + 1)
        self.shows = torch.nn.Linear(width, len(names))

    def parameters(self) -> list[Any]:
        """Return the logits of both heads."""
        return [*self.held.parameters(), *self.shows.parameters()]

    def loss(self, tokens: Any, frames: Sequence[Frame]) -> tuple[Any, float]:
        """Return summed losses, and the share of frames with the right held object."""
        import torch
        from torch.nn import functional

        mean = tokens.mean(dim=1)
        held = torch.tensor([0 if f.held is None else 1 + self.names.index(f.held) for f in frames])
        shows = torch.zeros(len(frames), len(self.names))
        weight = torch.ones_like(shows)
        for row, frame in enumerate(frames):
            for seen in frame.objects:
                shows[row, self.names.index(seen.name)] = 1.0
                weight[row, self.names.index(seen.name)] = float(seen.clear)
        logits = self.held(mean)
        visible = functional.binary_cross_entropy_with_logits(
            self.shows(mean), shows, weight=weight
        )
        right = float((logits.argmax(dim=1) == held).float().mean())
        return functional.cross_entropy(logits, held) + visible, right


def ask_about(rng: random.Random, frame: Frame, names: Sequence[str]) -> tuple[str, str]:
    """Return a question about a frame and its answer; two of three ask whether an object is
    grasped.

    While an object is held, wrong names are mostly those that share its color or its shape.
    """
    kind = rng.random()
    if kind < 0.66:
        draw = rng.random()
        alike = [
            n
            for n in names
            if n != frame.held and set(n.split(" ")) & set((frame.held or "").split(" "))
        ]
        if frame.held is not None and draw < 0.45:
            name = frame.held
        elif alike and draw < 0.75:
            name = rng.choice(alike)
        else:
            name = rng.choice(frame.present if draw < 0.9 else list(names))
        return questions.grasped(rng, name, frame.held)
    if kind < 0.78:
        return questions.holding(rng, frame.held)
    seen = visible_names(frame)
    if kind < 0.94:
        half_hidden = {o.name for o in frame.objects if not o.clear}
        likely = seen if seen and rng.random() < 0.5 else [n for n in names if n not in half_hidden]
        return questions.present(rng, rng.choice(likely), seen)
    return questions.listing(rng, seen)


def encode(
    processor: Any, pairs: Sequence[tuple[str, str]], image_token_count: int
) -> tuple[Any, Any, Any]:
    """Return (ids, attention mask, labels) of chats, left-padded; labels only on the answers."""
    import torch

    rows, answers = [], []
    for question, answer in pairs:
        content = [{"type": "image"}, {"type": "text", "text": question}]
        prompt = processor.apply_chat_template(
            [{"role": "user", "content": content}], add_generation_prompt=True, tokenize=False
        )
        prompt = prompt.replace("<|image_pad|>", "<|image_pad|>" * image_token_count)
        ids = processor.tokenizer(prompt)["input_ids"]
        reply = processor.tokenizer(f"{answer}<|im_end|>")["input_ids"]
        rows.append(ids + reply)
        answers.append(len(reply))
    longest = max(len(row) for row in rows)
    ids = torch.full((len(rows), longest), processor.tokenizer.pad_token_id)
    mask = torch.zeros(len(rows), longest, dtype=torch.long)
    labels = torch.full((len(rows), longest), -100)
    for index, row in enumerate(rows):
        ids[index, longest - len(row) :] = torch.tensor(row)
        mask[index, longest - len(row) :] = 1
        labels[index, longest - answers[index] :] = ids[index, longest - answers[index] :]
    return ids, mask, labels


def answer_loss(
    model: Any, tokens: Any, owner: Any, encoded: tuple[Any, Any, Any], recipe: VlmRecipe
) -> tuple[Any, float]:
    """Return the cross-entropy of the answers, and the share with the right first word.

    `owner[i]` is the image of chat i; its tokens are reused by all its chats. The first word, the
    yes or the no, weighs as much as four others: it is one in ten, and the only one that takes
    comparing question and picture.
    """
    import torch

    ids, mask, labels = encoded
    embeds = model.get_input_embeddings()(ids)
    spot = (ids == model.config.image_token_id)[..., None].expand_as(embeds)
    embeds = embeds.masked_scatter(spot, tokens[owner].to(embeds.dtype))
    grid = torch.tensor([[1, recipe.grid[1], recipe.grid[0]]] * len(ids))
    kinds = (ids == model.config.image_token_id).int()
    positions, _ = model.model.get_rope_index(ids, kinds, image_grid_thw=grid, attention_mask=mask)
    hidden = model.model.language_model(
        inputs_embeds=embeds, attention_mask=mask, position_ids=positions, use_cache=False
    ).last_hidden_state
    asked = labels[:, 1:] != -100
    logits = model.lm_head(hidden[:, :-1][asked]).float()
    wanted = labels[:, 1:][asked]
    first = (asked & (asked.cumsum(dim=1) == 1))[asked]
    each = torch.nn.functional.cross_entropy(logits, wanted, reduction="none")
    weight = 1.0 + 3.0 * first
    right = float((logits[first].argmax(dim=1) == wanted[first]).float().mean())
    return (each * weight).sum() / weight.sum(), right


def train(
    recipe: VlmRecipe,
    frames: Sequence[Frame],
    names: Sequence[str],
    out: Path,
    start: Path | None = None,
) -> tuple[Any, JsonObject]:
    """Run all stages on `frames`, from the weights of `start` if given; saves the processor.

    Returns (model, figures).
    """
    import torch

    common.seed_everything(recipe.seed, recipe.threads)
    processor = build_processor(out, recipe, names)
    model = build_model(recipe, processor)
    if start is not None:
        take_over(model, start)
    model.train()
    pixels = common.load_pixels(frames, recipe.size_px)
    heads = Heads(recipe.width, names)
    rng = random.Random(f"scene-vlm-{recipe.seed}")
    generator = torch.Generator().manual_seed(recipe.seed)
    started = time.monotonic()
    image_token_count = recipe.grid[0] * recipe.grid[1] // 4

    # Held and empty frames equally often: an empty gripper is the easy guess.
    order = balanced(
        [i for i, f in enumerate(frames) if f.held], [i for i, f in enumerate(frames) if not f.held]
    )
    batches = common.batches(len(order), recipe.batch, recipe.seed)
    tower = list(model.model.visual.parameters())
    language = [*model.model.language_model.parameters()]
    stages = {
        "vision": (recipe.vision_steps, [*tower, *heads.parameters()]),
        "language": (recipe.language_steps, language),
        "both": (recipe.steps, [*tower, *language]),
    }
    figures: JsonObject = {"train_frames": len(frames)}
    for stage, (steps, parameters) in stages.items():
        optimizer = torch.optim.AdamW(
            parameters, lr=recipe.learning_rate, betas=(0.9, 0.98), weight_decay=0.02
        )
        seen: list[tuple[float, float]] = []
        peak = recipe.learning_rate * (0.3 if stage == "both" else 1.0)
        budget_s = recipe.language_budget_s if stage == "language" else math.inf
        began = time.monotonic()
        for step in range(steps):
            done = max(step / steps, (time.monotonic() - began) / budget_s)
            if done >= 1.0:
                break
            for group in optimizer.param_groups:
                group["lr"] = peak * common.cosine_with_warmup(round(1000 * done), 1000, 40)
            chosen = [order[i] for i in next(batches)]
            picked = [frames[i] for i in chosen]
            patches = to_patches(augment(pixels[chosen], generator), recipe)
            with (
                torch.autocast("cpu", dtype=torch.bfloat16),
                torch.set_grad_enabled(stage != "language"),
            ):
                tokens = image_tokens(model, patches, recipe)
            tokens = tokens.float()
            if stage == "vision":
                loss, right = heads.loss(tokens, picked)
            else:
                owner = [i for i in range(len(picked)) for _ in range(recipe.questions_per_image)]
                pairs = [ask_about(rng, picked[i], names) for i in owner]
                encoded = encode(processor, pairs, image_token_count)
                loss, right = answer_loss(model, tokens, owner, encoded, recipe)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            seen.append((right, loss.item()))
            if step % max(1, steps // 20) == 0:
                last = seen[-30:]
                rights, losses = zip(*last, strict=True)
                shown = f"right {sum(rights) / len(last):.3f}  loss {sum(losses) / len(last):.3f}"
                print(
                    f"{time.monotonic() - started:6.0f} s  {stage} {step:5d}  {shown}", flush=True
                )
        figures[f"{stage}_steps"] = len(seen)
    figures["train_s"] = round(time.monotonic() - started, 1)
    model.eval()
    return model, figures


def balanced(some: Sequence[int], others: Sequence[int]) -> list[int]:
    """Return both lists, the shorter one repeated to the longer one's length."""
    if not some or not others:
        return [*some, *others]
    longest = max(len(some), len(others))
    return [half[i % len(half)] for i in range(longest) for half in (some, others)]


def run(recipe: VlmRecipe, data: Path, out: Path, start: Path | None = None) -> JsonObject:
    """Train, save, evaluate the saved checkpoint as a user would load it, write the model card.

    Returns the figures.
    """
    frames = common.read_frames(data, recipe.cameras)
    training, testing = common.split_by_scene(frames, recipe.held_out, recipe.split_seed)
    names = sorted({name for frame in frames for name in frame.present})
    out.mkdir(parents=True, exist_ok=True)
    model, figures = train(recipe, training, names, out, start)
    model.save_pretrained(out)
    return figures | report(recipe, training, testing, names, out, figures)


def report(
    recipe: VlmRecipe,
    training: Sequence[Frame],
    testing: Sequence[Frame],
    names: Sequence[str],
    out: Path,
    figures: JsonObject,
) -> JsonObject:
    """Evaluate the checkpoint in `out` and write its model card. Returns the figures."""
    asker = Asker(out)
    rows = evaluate(asker, testing, names, recipe.seed)
    grasp = [r for r in rows if r["group"] in ("held", "holds another", "empty")]
    found: JsonObject = {
        "train_frames": len(training),
        "test_frames": len(testing),
        "parameters": sum(p.numel() for p in asker.model.parameters()),
        "inference_ms": inference_ms(asker, testing[0]),
        "bytes": common.folder_bytes(out),
        "grasp_asked": len(grasp),
        "grasp_right": round(share(grasp, "right"), 4),
        "all_exact": round(share(rows, "exact"), 4),
    }
    card = CARD.format(
        **{**dataclasses.asdict(recipe), **figures, **found},
        camera=", ".join(recipe.cameras),
        size="{} x {}".format(*recipe.size_px),
        rows=card_rows(rows),
    )
    (out / "README.md").write_text(card, encoding="utf-8")
    for row in [r for r in grasp if not r["right"]][:12]:
        print(
            f"wrong: {row['image']} {row['question']!r}: {row['answer']!r}, truth {row['truth']!r}",
            flush=True,
        )
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 2 for a folder that is not a data set."""
    limits = {
        "--vision-steps": ("vision_steps", "steps of the first stage; default: the recipe's", int),
        "--steps": ("language_steps", "steps of the language stage; default: the recipe's", int),
        "--budget-s": (
            "language_budget_s", "time limit of the language stage in seconds", float
        ),
    }  # fmt: skip
    program = "python -m vram_arbiter.sidecars.training.scene_vlm"
    return run_command(argv, program, __doc__, (VlmRecipe(), SMOKE), limits, run)


if __name__ == "__main__":
    sys.exit(main())
