"""Trainer of the small scene VLM, a Qwen3.5, saved as an image-text-to-text checkpoint.

Three stages: the vision tower learns, through throw-away linear heads on its mean output token,
what is held and what shows; then the language model learns to answer from the tower's tokens; at
last both are fitted together. Must not know the simulator or the sidecar.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from training import questions
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
from training.datasets import Frame, load_pixels, read_frames, split_by_scene, vocabulary
from training.scene_vlm_model import (
    SMOKE,
    VlmRecipe,
    build_model,
    build_processor,
    image_tokens,
    take_over,
    to_patches,
)
from training.scene_vlm_report import report


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
    return lit(moved, generator)


class Heads:
    """Throw-away linear heads on the mean image token: what is held, and what shows."""

    def __init__(self, width: int, names: Sequence[str]) -> None:
        import torch

        self.names = list(names)
        self.held = torch.nn.Linear(width, len(names) + 1)
        self.shows = torch.nn.Linear(width, len(names))

    def parameters(self) -> list[Any]:
        """Return the parameters of both heads."""
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
    """Return a question about a frame and its answer; two of three: is an object grasped?

    While an object is held, wrong names are mostly those that share its color or its shape.
    """
    kind = rng.random()
    if kind < 0.66:
        draw = rng.random()
        alike = questions.alike(frame.held, names)
        if frame.held is not None and draw < 0.45:
            name = frame.held
        elif alike and draw < 0.75:
            name = rng.choice(alike)
        else:
            name = rng.choice(frame.present if draw < 0.9 else list(names))
        return questions.grasped(rng, name, frame.held)
    if kind < 0.78:
        return questions.holding(rng, frame.held)
    seen = frame.visible
    if kind < 0.94:
        sure = seen and rng.random() < 0.5
        likely = seen if sure else [name for name in names if name not in frame.hidden]
        return questions.present(rng, rng.choice(likely), seen)
    return questions.listing(rng, seen)


def encode(
    processor: Any, pairs: Sequence[tuple[str, str]], image_token_count: int
) -> tuple[Any, Any, Any]:
    """Return (ids, attention mask, labels) of chats, left-padded; labels only on the answers."""
    import torch

    rows, answers = [], []
    for question, answer in pairs:
        prompt = questions.as_prompt(processor, question)
        prompt = prompt.replace("<|image_pad|>", "<|image_pad|>" * image_token_count)
        reply = processor.tokenizer(f"{answer}<|im_end|>")["input_ids"]
        rows.append(processor.tokenizer(prompt)["input_ids"] + reply)
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


def balanced(some: Sequence[int], others: Sequence[int]) -> list[int]:
    """Return both lists, the shorter one repeated to the longer one's length."""
    if not some or not others:
        return [*some, *others]
    longest = max(len(some), len(others))
    return [half[i % len(half)] for i in range(longest) for half in (some, others)]


class Stages:
    """A model in training: the frames, the throw-away heads, and the loss of each stage."""

    def __init__(
        self, model: Any, processor: Any, recipe: VlmRecipe, frames: Sequence[Frame],
        names: Sequence[str],
    ) -> None:  # fmt: skip
        import torch

        self.model, self.processor, self.recipe = model, processor, recipe
        self.frames, self.names = frames, names
        self.pixels = load_pixels(frames, recipe.size_px)
        self.heads = Heads(recipe.width, names)
        self.rng = random.Random(f"scene-vlm-{recipe.seed}")
        self.generator = torch.Generator().manual_seed(recipe.seed)
        # without the instructions for it, bfloat16 takes ten times as long as float32
        self.half = torch.backends.cpu.get_cpu_capability() == "AVX512"
        # held and empty frames equally often: an empty gripper is the easy guess
        holding: dict[bool, list[int]] = {True: [], False: []}
        for index, frame in enumerate(frames):
            holding[frame.held is not None].append(index)
        self.order = balanced(holding[True], holding[False])
        self.batches = batches(len(self.order), recipe.batch, recipe.seed)

    def run(self) -> dict[str, Run]:
        """Run all stages."""
        tower = list(self.model.model.visual.parameters())
        language = list(self.model.model.language_model.parameters())
        recipe = self.recipe
        return {
            "vision": self.fit("vision", [*tower, *self.heads.parameters()], recipe.vision_steps),
            "language": self.fit("language", language, recipe.steps, recipe.time_limit_s),
            "both": self.fit("both", [*tower, *language], recipe.both_steps),
        }

    def fit(
        self, stage: str, parameters: list[Any], steps: int, time_limit_s: float = float("inf")
    ) -> Run:
        """Run one stage."""
        import torch

        peak = self.recipe.learning_rate * (0.3 if stage == "both" else 1.0)
        optimizer = torch.optim.AdamW(
            parameters, lr=self.recipe.learning_rate, betas=(0.9, 0.98), weight_decay=0.02
        )
        return fit(
            stage, parameters, optimizer,
            lambda _, share: peak * cosine_after_warmup(round(1000 * share), 1000, 40),
            lambda: self.loss(stage), steps=steps, time_limit_s=time_limit_s,
        )  # fmt: skip

    def loss(self, stage: str) -> Any:
        """Return the loss of a new batch, and its figures."""
        import torch

        chosen = [self.order[i] for i in next(self.batches)]
        picked = [self.frames[i] for i in chosen]
        patches = to_patches(augment(self.pixels[chosen], self.generator), self.recipe)
        with (
            torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.half),
            torch.set_grad_enabled(stage != "language"),
        ):
            tokens = image_tokens(self.model, patches, self.recipe)
        tokens = tokens.float()
        if stage == "vision":
            loss, right = self.heads.loss(tokens, picked)
        else:
            owner = [i for i in range(len(picked)) for _ in range(self.recipe.questions_per_image)]
            pairs = [ask_about(self.rng, picked[i], self.names) for i in owner]
            encoded = encode(self.processor, pairs, self.recipe.tokens)
            loss, right = answer_loss(self.model, tokens, owner, encoded, self.recipe)
        return loss, {"right": right, "loss": loss.item()}


def train(recipe: VlmRecipe, data: Sequence[Path], out: Path, start: Path | None) -> Report:
    """Train, write the checkpoint, judge it on the held-out scenes."""
    frames = read_frames(data, recipe.camera)
    learn, kept = split_by_scene(frames, recipe.held_out, recipe.split_seed)
    names, _ = vocabulary(frames)
    seed_everything(recipe)
    processor = build_processor(out, recipe, names)
    model = build_model(recipe, processor)
    if start is not None:
        take_over(model, start)
    model.train()
    runs = Stages(model, processor, recipe, learn, names).run()
    model.eval().save_pretrained(out)
    figures = {
        **runs["language"].figures(),
        **{f"{stage}_steps": len(run.rows) for stage, run in runs.items()},
        "train_s": round(sum(run.seconds for run in runs.values()), 1),
        "train_frames": len(learn),
    }
    return report(out, kept, names, recipe.seed, figures)


TRAINER: Final = Trainer(
    model="so101-scene-vlm",
    library="transformers\npipeline_tag: image-text-to-text",
    recipe=VlmRecipe(),
    smoke=SMOKE,
    train=train,
)
