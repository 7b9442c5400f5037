"""Network, tokenizer and processor of the small scene VLM: a Qwen3.5."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from training.common import Recipe
from training.questions import corpus
from training.tokens import byte_alphabet, learn_merges

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


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class VlmRecipe(Recipe):
    """Parameters of a run; `steps` and the time limit are those of the language stage.

    `split_seed` stays when a run continues another with another seed.
    """

    seed: int = 7
    steps: int = 900
    batch: int = 16
    time_limit_s: float = 3600.0
    vision_steps: int = 1200
    both_steps: int = 150
    camera: str = "wrist"
    # patches across and down; even, as 2 x 2 of them make one token
    grid: tuple[int, int] = (14, 10)
    patch_px: int = 16
    vision_width: int = 128
    vision_layers: int = 3
    width: int = 128
    layer_types: tuple[str, ...] = ("linear_attention", *["full_attention"] * 3)
    questions_per_image: int = 3
    learning_rate: float = 1.0e-3
    held_out: float = 0.12
    split_seed: int = 0

    @property
    def tokens(self) -> int:
        """Image tokens of a picture."""
        return self.grid[0] * self.grid[1] // 4

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height that the processor scales a 4:3 frame to."""
        return self.grid[0] * self.patch_px, self.grid[1] * self.patch_px


SMOKE: Final = VlmRecipe(
    grid=(8, 6), vision_width=32, vision_layers=1, width=32, batch=6,
    vision_steps=6, steps=6, both_steps=4, held_out=0.25,
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
    words = {piece for text in corpus(names) for piece, _ in split.pre_tokenize_str(text)}
    tokens, merges = learn_merges(words, suffix="")
    vocab = dict.fromkeys([*byte_alphabet(), *tokens, *SPECIALS])
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


def take_over(model: Any, start: Path) -> None:
    """Copy an earlier checkpoint: vision tower, and language model of equal layers."""
    earlier = type(model).from_pretrained(start, local_files_only=True)
    weights = earlier.state_dict()
    if earlier.config.text_config.layer_types != model.config.text_config.layer_types:
        weights = {name: w for name, w in weights.items() if name.startswith("model.visual.")}
    model.load_state_dict(weights, strict=False)
