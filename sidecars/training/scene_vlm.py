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

import argparse
import dataclasses
import json
import math
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.sidecars.training import common, questions
from vram_arbiter.sidecars.training.common import Frame, visible_names
from vram_arbiter.sidecars.training.scene_vlm_report import (
    CARD,
    Asker,
    card_rows,
    evaluate,
    inference_ms,
    share,
)

SPECIALS: Final = (
    "<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>",
    "<|image_pad|>", "<|video_pad|>",
)  # fmt: skip
CHAT_TEMPLATE: Final = (
    "{%- for message in messages -%}"
    "{{- '<|im_start|>' + message['role'] + '\\n' -}}"
    "{%- if message['content'] is string -%}{{- message['content'] -}}"
    "{%- else -%}"
    "{%- for part in message['content'] -%}"
    "{%- if part['type'] == 'image' -%}{{- '<|vision_start|><|image_pad|><|vision_end|>' -}}"
    "{%- elif part['type'] == 'text' -%}{{- part['text'] -}}"
    "{%- endif -%}"
    "{%- endfor -%}"
    "{%- endif -%}"
    "{{- '<|im_end|>\\n' -}}"
    "{%- endfor -%}"
    "{%- if add_generation_prompt -%}{{- '<|im_start|>assistant\\n' -}}{%- endif -%}"
)


@dataclasses.dataclass(frozen=True, slots=True)
class VlmRecipe:
    """Parameters of a run beside its data."""

    seed: int = 7
    threads: int = 1
    cameras: tuple[str, ...] = ("wrist",)
    grid: tuple[int, int] = (
        14,
        10,
    )  # patches across and down; even, as 2 x 2 of them make one token
    patch_px: int = 16
    vision_width: int = 128
    vision_layers: int = 3
    width: int = 128
    layer_types: tuple[str, ...] = (
        "linear_attention",
        "full_attention",
        "full_attention",
        "full_attention",
    )
    batch: int = 16
    questions_per_image: int = 3
    vision_steps: int = 1200
    language_steps: int = 900
    steps: int = 150
    language_budget_s: float = 3600.0
    learning_rate: float = 1.0e-3
    held_out: float = 0.12
    split_seed: int = (
        0  # not the seed of the run: a run that continues another keeps its held-out scenes
    )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height that the processor scales a 4:3 frame to."""
        return self.grid[0] * self.patch_px, self.grid[1] * self.patch_px


SMOKE: Final = VlmRecipe(
    grid=(8, 6), vision_width=32, vision_layers=1, width=32, batch=6,
    vision_steps=6, language_steps=6, steps=4, held_out=0.25,
)  # fmt: skip


def build_processor(folder: Path, recipe: VlmRecipe, names: Sequence[str]) -> Any:
    """Write tokenizer (byte-level BPE of Qwen's kind), image processor and chat template.

    `AutoProcessor` reads them back.
    """
    from transformers import (
        Qwen2TokenizerFast,
        Qwen2VLImageProcessor,
        Qwen3VLProcessor,
        Qwen3VLVideoProcessor,
    )

    blank = Qwen2TokenizerFast(vocab={"<|endoftext|>": 0}, merges=[])
    split = blank.backend_tokenizer.pre_tokenizer
    words = {piece for text in questions.corpus(names) for piece, _ in split.pre_tokenize_str(text)}
    tokens, merges = common.learn_merges(words, suffix="")
    vocab = dict.fromkeys([*common.byte_alphabet(), *tokens, *SPECIALS])
    tokenizer = Qwen2TokenizerFast(
        vocab={token: index for index, token in enumerate(vocab)},
        merges=merges,
        eos_token="<|im_end|>",
        pad_token="<|endoftext|>",
        additional_special_tokens=list(SPECIALS),
        padding_side="left",
        model_max_length=512,
    )
    # exactly one size fits these bounds for a 4:3 frame: that of the grid
    pixels = recipe.size_px[0] * recipe.size_px[1]
    options = {
        "patch_size": recipe.patch_px,
        "temporal_patch_size": 2,
        "merge_size": 2,
        "size": {"shortest_edge": pixels // 2, "longest_edge": round(pixels * 1.06)},
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    processor = Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(**options),
        tokenizer=tokenizer,
        video_processor=Qwen3VLVideoProcessor(**options),
        chat_template=CHAT_TEMPLATE,
    )
    processor.save_pretrained(folder)
    return processor


def build_model(recipe: VlmRecipe, processor: Any) -> Any:
    """Return a new Qwen3.5 with this tokenizer's ids."""
    import torch
    from transformers import Qwen3_5Config, Qwen3_5ForConditionalGeneration

    token = processor.tokenizer.convert_tokens_to_ids
    config = Qwen3_5Config(
        text_config={
            "vocab_size": len(processor.tokenizer),
            "hidden_size": recipe.width,
            "intermediate_size": 2 * recipe.width,
            "num_hidden_layers": len(recipe.layer_types),
            "layer_types": list(recipe.layer_types),
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "head_dim": 32,
            "linear_key_head_dim": 32,
            "linear_value_head_dim": 32,
            "linear_num_key_heads": 1,
            "linear_num_value_heads": 1,
            "max_position_embeddings": 512,
            "rope_parameters": {
                "rope_type": "default",
                "rope_theta": 10000.0,
                "partial_rotary_factor": 0.5,
                "mrope_section": [4, 2, 2],
                "mrope_interleaved": True,
            },
            "pad_token_id": token("<|endoftext|>"),
            "eos_token_id": token("<|im_end|>"),
            "tie_word_embeddings": True,
        },
        vision_config={
            "depth": recipe.vision_layers,
            "hidden_size": recipe.vision_width,
            "intermediate_size": 3 * recipe.vision_width,
            "num_heads": 2,
            "patch_size": recipe.patch_px,
            "temporal_patch_size": 2,
            "spatial_merge_size": 2,
            "out_hidden_size": recipe.width,
            "num_position_embeddings": 12 * 12,
        },
        image_token_id=token("<|image_pad|>"),
        video_token_id=token("<|video_pad|>"),
        vision_start_token_id=token("<|vision_start|>"),
        vision_end_token_id=token("<|vision_end|>"),
        tie_word_embeddings=True,
    )
    model = Qwen3_5ForConditionalGeneration(config)
    model.generation_config.eos_token_id = token("<|im_end|>")
    model.generation_config.pad_token_id = token("<|endoftext|>")
    model.generation_config.do_sample = False
    with torch.no_grad():
        tower = model.model.visual
        for name, module in tower.named_modules():
            if isinstance(module, torch.nn.Linear):
                inner = name.endswith(("attn.proj", "mlp.linear_fc2"))
                depth = (2 * recipe.vision_layers) ** -0.5 if inner else 1.0
                module.weight.normal_(std=depth * module.in_features**-0.5)
        tower.patch_embed.proj.weight.normal_(std=(6 * recipe.patch_px**2) ** -0.5)
        tower.pos_embed.weight.normal_(std=0.3)
    return model


def to_patches(images: Any, recipe: VlmRecipe) -> Any:
    """Convert float images (n, 3, h, w) in 0..1 to patch rows of Qwen's image processor."""
    count = images.shape[0]
    across, down = recipe.grid
    side = recipe.patch_px
    x = ((images - 0.5) / 0.5)[:, None].expand(-1, 2, -1, -1, -1)
    x = x.reshape(count, 1, 2, 3, down // 2, 2, side, across // 2, 2, side)
    x = x.permute(0, 1, 4, 7, 5, 8, 3, 2, 6, 9)
    return x.reshape(count * across * down, 3 * 2 * side * side)


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


def image_tokens(model: Any, patches: Any, recipe: VlmRecipe) -> Any:
    """Return (images, tokens, width) of the vision tower: its forward pass for equal images.

    The library's convolution over patches and its attention image by image cost three times as much
    on a CPU.
    """
    import torch
    from torch.nn import functional
    from transformers.models.qwen3_5.modeling_qwen3_5 import apply_rotary_pos_emb_vision

    tower = model.model.visual
    per_image = recipe.grid[0] * recipe.grid[1]
    count = patches.shape[0] // per_image
    grid = torch.tensor([[1, recipe.grid[1], recipe.grid[0]]])
    conv = tower.patch_embed.proj
    x = functional.linear(patches, conv.weight.flatten(1), conv.bias).view(count, per_image, -1)
    x = x + tower.fast_pos_embed_interpolate(grid)
    turn = tower.rot_pos_emb(grid)
    turn = torch.cat([turn, turn], dim=-1)
    cos, sin = turn.cos(), turn.sin()
    for block in tower.blocks:
        attention = block.attn
        qkv = attention.qkv(block.norm1(x)).view(count, per_image, 3, attention.num_heads, -1)
        query, key, value = qkv.unbind(dim=2)
        query, key = apply_rotary_pos_emb_vision(query, key, cos, sin)
        score = (query.transpose(1, 2) @ key.permute(0, 2, 3, 1)) * attention.scaling
        mixed = (score.softmax(dim=-1) @ value.transpose(1, 2)).transpose(1, 2)
        x = x + attention.proj(mixed.reshape(count, per_image, -1))
        x = x + block.mlp(block.norm2(x))
    tokens = tower.merger(x.reshape(count * per_image, -1))
    return tokens.view(count, per_image // 4, -1)


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


def take_over(model: Any, start: Path) -> None:
    """Copy an earlier checkpoint: vision tower, and language model of equal layers."""
    earlier = type(model).from_pretrained(start, local_files_only=True)
    weights = earlier.state_dict()
    if earlier.config.text_config.layer_types != model.config.text_config.layer_types:
        weights = {
            name: value for name, value in weights.items() if name.startswith("model.visual.")
        }
    model.load_state_dict(weights, strict=False)


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
    """Run the command line; 2 for a folder that is not a data set."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.sidecars.training.scene_vlm", description=__doc__
    )
    parser.add_argument(
        "--data", type=Path, required=True, help="folder with labels.jsonl and images"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the checkpoint")
    parser.add_argument("--start-from", type=Path, help="checkpoint of this script to continue")
    parser.add_argument(
        "--vision-steps", type=int, help="steps of the first stage; default: the recipe's"
    )
    parser.add_argument(
        "--steps", type=int, help="steps of the language stage; default: the recipe's"
    )
    parser.add_argument(
        "--budget-s", type=float, help="time limit of the language stage in seconds"
    )
    parser.add_argument(
        "--smoke", action="store_true", help="toy size, a few seconds: checks that all code runs"
    )
    parser.add_argument("--seed", type=int, default=VlmRecipe().seed)
    parser.add_argument("--threads", type=int, default=VlmRecipe().threads)
    args = parser.parse_args(argv)
    recipe = dataclasses.replace(
        SMOKE if args.smoke else VlmRecipe(), seed=args.seed, threads=args.threads
    )
    if args.vision_steps is not None:
        recipe = dataclasses.replace(recipe, vision_steps=args.vision_steps)
    if args.budget_s is not None:
        recipe = dataclasses.replace(recipe, language_budget_s=args.budget_s)
    if args.steps is not None:
        recipe = dataclasses.replace(recipe, language_steps=args.steps)
    try:
        figures = run(recipe, args.data, args.out, args.start_from)
    except common.BadDataset as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
