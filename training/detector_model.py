"""Network, tokenizer and processor of the small detector: an OwlViT."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from training.common import Recipe
from training.tokens import byte_alphabet, learn_merges

PAD, START, END = "<|pad|>", "<|startoftext|>", "<|endoftext|>"
MAX_TOKENS: Final = 16


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DetectorRecipe(Recipe):
    """Parameters of a run; `split_seed` stays when a run continues another with another seed."""

    seed: int = 7
    steps: int = 3000
    batch: int = 16
    time_limit_s: float = 3600.0
    camera: str = "front"
    image_px: int = 400
    patch_px: int = 20
    width: int = 128
    layers: int = 4
    heads: int = 2
    text_width: int = 64
    text_layers: int = 2
    learning_rate: float = 1.5e-3
    held_out: float = 0.12
    split_seed: int = 7
    strange_queries: int = 10
    word_steps: int = 250


SMOKE: Final = DetectorRecipe(
    image_px=128, patch_px=16, width=48, layers=2, text_width=32, text_layers=1, batch=8,
    steps=30, held_out=0.25, strange_queries=4, word_steps=40,
)  # fmt: skip


def build_processor(folder: Path, image_px: int, words: Sequence[str]) -> Any:
    """Write processor and tokenizer, a BPE in CLIP's format. Returns the processor.

    Pad is id 0 (OWL masks queries that start with it), end the greatest id.
    """
    from transformers import CLIPTokenizer, OwlViTImageProcessor, OwlViTProcessor

    alphabet = byte_alphabet()
    tokens, merges = learn_merges(words, suffix="</w>")
    closed = [letter + "</w>" for letter in alphabet]
    vocab = [PAD, *alphabet, *closed, *dict.fromkeys(tokens), START, END]
    CLIPTokenizer(
        vocab={token: index for index, token in enumerate(vocab)},
        merges=merges,
        unk_token=END,
        bos_token=START,
        eos_token=END,
        pad_token=PAD,
        model_max_length=MAX_TOKENS,
    ).save_pretrained(folder)
    size = {"height": image_px, "width": image_px}
    processor = OwlViTProcessor(
        image_processor=OwlViTImageProcessor(size=size, crop_size=size, do_center_crop=False),
        tokenizer=CLIPTokenizer.from_pretrained(folder),
    )
    processor.save_pretrained(folder)
    return processor


def build_model(recipe: DetectorRecipe, tokenizer: Any) -> Any:
    """Return a new OwlViT. Its position tables start as sines, so it need not learn adjacency."""
    import torch
    from transformers import OwlViTConfig, OwlViTForObjectDetection

    config = OwlViTConfig(
        text_config={
            "vocab_size": len(tokenizer),
            "hidden_size": recipe.text_width,
            "intermediate_size": 2 * recipe.text_width,
            "num_hidden_layers": recipe.text_layers,
            "num_attention_heads": 4,
            "max_position_embeddings": MAX_TOKENS,
            "pad_token_id": tokenizer.pad_token_id,
            "bos_token_id": tokenizer.bos_token_id,
            "eos_token_id": tokenizer.eos_token_id,
        },
        vision_config={
            "hidden_size": recipe.width,
            "intermediate_size": 4 * recipe.width,
            "num_hidden_layers": recipe.layers,
            "num_attention_heads": recipe.heads,
            "image_size": recipe.image_px,
            "patch_size": recipe.patch_px,
        },
        projection_dim=recipe.text_width,
    )
    # eager attention in bfloat16 is twice as fast as fused attention on CPUs with bfloat16
    model = OwlViTForObjectDetection._from_config(config, attn_implementation="eager")
    vision = model.owlvit.vision_model.embeddings
    side = recipe.image_px // recipe.patch_px
    with torch.no_grad():
        # transformers draws every Linear of an OwlViT with a deviation of 1, fit for a loaded
        # checkpoint only
        for name, module in model.named_modules():
            if isinstance(module, torch.nn.Linear):
                inner = name.endswith(("out_proj", "fc2"))
                depth = (2 * recipe.layers) ** -0.5 if inner else 1.0
                module.weight.normal_(std=depth * module.in_features**-0.5)
        for head in (
            model.box_head.dense2,
            model.class_head.logit_shift,
            model.class_head.logit_scale,
        ):
            head.weight.mul_(0.1)
        vision.position_embedding.weight[1:] = 0.3 * _sine_table(side, recipe.width)
        vision.patch_embedding.weight.normal_(std=(3 * recipe.patch_px**2) ** -0.5)
        model.class_head.logit_shift.bias.fill_(-0.7)
        model.class_head.logit_scale.bias.fill_(8.0)
    return model


def _sine_table(side: int, width: int) -> Any:
    import torch

    quarter = width // 4
    at = torch.arange(side, dtype=torch.float32)[:, None] / side
    angles = at * (2 * torch.pi * torch.logspace(-0.5, 0.9, quarter, 2.0 * 2.0))
    line = torch.cat([angles.sin(), angles.cos()], dim=1)
    grid = torch.cat(
        [line[:, None].expand(side, side, -1), line[None].expand(side, side, -1)], dim=-1
    )
    return torch.nn.functional.pad(grid.reshape(side * side, -1), (0, width - 4 * quarter))


def take_over(model: Any, start: Path) -> None:
    """Copy the weights of an earlier checkpoint; patch filters are scaled to another patch size."""
    import torch
    from transformers import OwlViTForObjectDetection

    weights = OwlViTForObjectDetection.from_pretrained(start, local_files_only=True).state_dict()
    name = "owlvit.vision_model.embeddings.patch_embedding.weight"
    old, new = weights[name], model.state_dict()[name]
    scaled = torch.nn.functional.interpolate(
        old, new.shape[-2:], mode="bicubic", align_corners=False
    )
    weights[name] = scaled * (old.shape[-1] / new.shape[-1]) ** 2
    model.load_state_dict(weights)
