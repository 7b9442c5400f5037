"""Tiny models with random weights, saved as hub checkpoints are, for the production loading path to
read back."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.schemas.manifest import RSkillManifest, parse_manifest
from vram_arbiter.sidecars.weights import Weights, resolve

CHAT = (
    "{%- for message in messages -%}<|im_start|>{{ message.role }}\n{%- for part in "
    "message.content -%}"
    "{%- if part.type == 'image' -%}<|vision_start|><|image_pad|><|vision_end|>{%- else -%}{{ "
    "part.text }}{%- endif -%}{%- endfor -%}"
    "<|im_end|>\n{%- endfor -%}{%- if add_generation_prompt -%}<|im_start|>assistant\n{%- endif -%}"
)


def bytes_alphabet() -> list[str]:
    from tokenizers.pre_tokenizers import ByteLevel

    return sorted(ByteLevel.alphabet())


def save_owlvit(folder: Path, **vision: int) -> None:
    """`vision`: of its vision tower, where the model is to be larger."""
    import torch
    from transformers import (
        CLIPTokenizer,
        OwlViTConfig,
        OwlViTForObjectDetection,
        OwlViTImageProcessor,
        OwlViTProcessor,
    )

    letters = bytes_alphabet()
    tokens = ["<pad>", *letters, *(letter + "</w>" for letter in letters), "<start>", "<end>"]
    tokenizer = CLIPTokenizer(
        vocab={token: index for index, token in enumerate(tokens)}, merges=[], unk_token="<end>",
        bos_token="<start>",
        eos_token="<end>", pad_token="<pad>", model_max_length=16,
    )  # fmt: skip
    size = {"height": 64, "width": 64}
    OwlViTProcessor(
        image_processor=OwlViTImageProcessor(size=size, crop_size=size, do_center_crop=False),
        tokenizer=tokenizer,
    ).save_pretrained(folder)
    torch.manual_seed(0)
    small = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
    }
    config = OwlViTConfig(
        text_config=small | {"vocab_size": len(tokens), "max_position_embeddings": 16,
        "pad_token_id": 0,
                             "bos_token_id": len(tokens) - 2, "eos_token_id": len(tokens) - 1},
        vision_config=small | {"image_size": 64, "patch_size": 16} | vision,
        projection_dim=32,
    )  # fmt: skip
    model = OwlViTForObjectDetection(config)
    for parameter in model.parameters():  # transformers' own draw makes a small OWL answer NaN
        parameter.data.normal_(std=0.2)
    model.save_pretrained(folder)


def save_qwen(folder: Path, **text: object) -> None:
    """`text`: of its language model, where the model is to be larger."""
    import torch
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers
    from transformers import (
        PreTrainedTokenizerFast,
        Qwen2VLImageProcessor,
        Qwen3_5Config,
        Qwen3_5ForConditionalGeneration,
        Qwen3VLProcessor,
        Qwen3VLVideoProcessor,
    )

    special = [
        "<|endoftext|>",
        "<|im_start|>",
        "<|im_end|>",
        "<|vision_start|>",
        "<|vision_end|>",
        "<|image_pad|>",
        "<|video_pad|>",
    ]
    letters = bytes_alphabet()
    raw = Tokenizer(
        models.BPE(vocab={token: index for index, token in enumerate(letters)}, merges=[])
    )
    raw.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    raw.decoder = decoders.ByteLevel()
    raw.add_special_tokens(special)
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=raw, eos_token="<|im_end|>", pad_token="<|endoftext|>"
    )
    ids = tokenizer.convert_tokens_to_ids
    pixels = {"shortest_edge": 32 * 32, "longest_edge": 64 * 64}
    Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(
            patch_size=8, temporal_patch_size=2, merge_size=2, size=pixels
        ),
        tokenizer=tokenizer,
        video_processor=Qwen3VLVideoProcessor(patch_size=8, temporal_patch_size=2, merge_size=2),
        chat_template=CHAT,
    ).save_pretrained(folder)
    torch.manual_seed(0)
    config = Qwen3_5Config(
        text_config={"vocab_size": len(tokenizer), "hidden_size": 32, "intermediate_size": 64,
        "num_hidden_layers": 2,
                     "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 16,
                     "linear_key_head_dim": 8,
                     "linear_value_head_dim": 8, "linear_num_key_heads": 2,
                     "linear_num_value_heads": 2,
                     "layer_types": ["linear_attention", "full_attention"],
                     "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0,
                     "mrope_section": [2, 1, 1], "mrope_interleaved": True,
                     "partial_rotary_factor": 0.5}} | text,
        vision_config={"depth": 1, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2,
        "patch_size": 8,
        "out_hidden_size": text.get("hidden_size", 32), "num_position_embeddings": 64},
        image_token_id=ids("<|image_pad|>"), video_token_id=ids("<|video_pad|>"),
        vision_start_token_id=ids("<|vision_start|>"), vision_end_token_id=ids("<|vision_end|>"),
    )  # fmt: skip
    model = Qwen3_5ForConditionalGeneration(config)
    model.generation_config.eos_token_id = ids("<|im_end|>")
    model.generation_config.pad_token_id = ids("<|endoftext|>")
    model.save_pretrained(folder)


def save_act(folder: Path, **larger: int) -> None:
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    torch.manual_seed(0)
    config = ACTConfig(
        input_features={
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
            "observation.state": PolicyFeature(FeatureType.STATE, (6,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (6,))},
        pretrained_backbone_weights=None, n_vae_encoder_layers=1, chunk_size=5, n_action_steps=5,
        device="cpu",
        **{"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1} | larger,
    )  # fmt: skip
    ones = torch.ones(6)
    stats = {
        "observation.state": {"mean": 0 * ones, "std": ones},
        "action": {
            "mean": 100 * ones,
            "std": ones,
        },  # shows in the answer that the postprocessor ran
        "observation.images.front": {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)},
    }
    ACTPolicy(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)


SAVERS = {"owlvit": save_owlvit, "qwen": save_qwen, "act": save_act}


@pytest.fixture(scope="session")
def configs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configs folder; models are made when first asked for."""
    return tmp_path_factory.mktemp("configs")


@pytest.fixture(scope="session")
def weights(configs: Path) -> Callable[[str], Weights]:
    def weights(name: str) -> Weights:
        folder = configs / "models" / name
        if not folder.exists():
            folder.mkdir(parents=True)
            SAVERS[name](folder)
        return resolve(f"local://models/{name}", configs)

    return weights


@pytest.fixture(scope="module")
def saved(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str, Callable[[Path], None]], Weights]:
    """Saves a family's checkpoint in float32, once, and returns its weights."""
    root = tmp_path_factory.mktemp("saved")

    def saved(family: str, save: Callable[[Path], None]) -> Weights:
        folder = root / family
        if not folder.exists():
            folder.mkdir()
            save(folder)
        return Weights(str(folder), local=True)

    return saved


def placed(adapter: Any) -> Any:
    """Load an adapter's weights and place them on the CPU."""
    adapter.prepare()
    adapter.load("cpu")
    adapter.place("cpu")
    return adapter


@pytest.fixture
def manifest() -> Callable[[str, str], RSkillManifest]:
    def manifest(kind: str, more: str) -> RSkillManifest:
        return parse_manifest(
            f"name: test/model\nversion: 0.1.0\nkind: {kind}\nembodiment_tags: [any]\nchunk_size: "
            "1\n"
            "weights_uri: local://models/x\ndescription: a tiny model\nlatency_budget: "
            f"{{per_chunk_ms: 100}}\n{more}"
        )

    return manifest


@pytest.fixture
def png() -> Callable[..., bytes]:
    def png(
        width: int = 80, height: int = 60, colour: tuple[int, int, int] = (200, 30, 30)
    ) -> bytes:
        from PIL import Image

        stream = io.BytesIO()
        Image.new("RGB", (width, height), colour).save(stream, "PNG")
        return stream.getvalue()

    return png
