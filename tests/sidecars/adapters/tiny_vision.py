"""Tiny detectors and vision-language models with random weights, saved by their families' own
`save_pretrained`."""

import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

_SMALL = {
    "hidden_size": 32,
    "intermediate_size": 32,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
}


def bytes_alphabet() -> list[str]:
    from tokenizers.pre_tokenizers import ByteLevel

    return sorted(ByteLevel.alphabet())


def _save(model: Any, folder: Path) -> None:
    import torch

    torch.manual_seed(0)
    for parameter in model.parameters():  # the libraries' own draws make some small models NaN
        parameter.data.normal_(std=0.2)
    model.save_pretrained(folder)


# -- detectors
def _clip_tokenizer(length: int) -> Any:
    from transformers import CLIPTokenizer

    letters = bytes_alphabet()
    tokens = ["<pad>", *letters, *(letter + "</w>" for letter in letters), "<start>", "<end>"]
    return CLIPTokenizer(
        vocab={token: index for index, token in enumerate(tokens)},
        merges=[],
        unk_token="<end>",
        bos_token="<start>",
        eos_token="<end>",
        pad_token="<pad>",
        model_max_length=length,
    )


def _clip_text(tokenizer: Any) -> dict[str, Any]:
    return _SMALL | {
        "vocab_size": len(tokenizer),
        "max_position_embeddings": tokenizer.model_max_length,
        "pad_token_id": tokenizer.pad_token_id,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
    }


def _swin() -> Any:
    from transformers import SwinConfig

    return SwinConfig(
        image_size=64,
        patch_size=4,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 2, 2],
        window_size=4,
        out_indices=[2, 3, 4],
    )


def save_owlvit(folder: Path, **larger: int) -> None:
    """`larger`: of its vision tower, where the model is to be larger."""
    from transformers import (
        OwlViTConfig,
        OwlViTForObjectDetection,
        OwlViTImageProcessor,
        OwlViTProcessor,
    )

    tokenizer, size = _clip_tokenizer(16), {"height": 64, "width": 64}
    OwlViTProcessor(
        OwlViTImageProcessor(size=size, crop_size=size, do_center_crop=False), tokenizer
    ).save_pretrained(folder)
    vision = _SMALL | {"image_size": 64, "patch_size": 16} | larger
    config = OwlViTConfig(
        text_config=_clip_text(tokenizer), vision_config=vision, projection_dim=32
    )
    _save(OwlViTForObjectDetection(config), folder)


def save_owlv2(folder: Path) -> None:
    from transformers import (
        Owlv2Config,
        Owlv2ForObjectDetection,
        Owlv2ImageProcessor,
        Owlv2Processor,
    )

    tokenizer = _clip_tokenizer(16)
    Owlv2Processor(
        Owlv2ImageProcessor(size={"height": 64, "width": 64}), tokenizer
    ).save_pretrained(folder)
    vision = _SMALL | {"image_size": 64, "patch_size": 16}
    config = Owlv2Config(text_config=_clip_text(tokenizer), vision_config=vision, projection_dim=32)
    _save(Owlv2ForObjectDetection(config), folder)


def save_grounding_dino(folder: Path) -> None:
    from transformers import (
        BertConfig,
        BertTokenizer,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessor,
        GroundingDinoProcessor,
    )

    letters = string.ascii_lowercase + string.digits + ".,"
    tokens = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", *letters]
    tokens += [f"##{letter}" for letter in letters]
    tokenizer = BertTokenizer(
        vocab={token: index for index, token in enumerate(tokens)}, model_max_length=512
    )
    GroundingDinoProcessor(
        GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96}), tokenizer
    ).save_pretrained(folder)
    config = GroundingDinoConfig(
        backbone_config=_swin(),
        text_config=BertConfig(vocab_size=len(tokens), max_position_embeddings=64, **_SMALL),
        max_text_len=64,
        d_model=32,
        num_queries=10,
        encoder_layers=1,
        encoder_ffn_dim=32,
        encoder_attention_heads=2,
        encoder_n_points=2,
        decoder_layers=2,  # with one, the class has nothing to tie its box heads to
        decoder_ffn_dim=32,
        decoder_attention_heads=2,
        decoder_n_points=2,
    )
    _save(GroundingDinoForObjectDetection(config), folder)


def save_omdet_turbo(folder: Path, backbone: Any = None) -> None:
    from transformers import (
        DetrImageProcessor,
        OmDetTurboConfig,
        OmDetTurboForObjectDetection,
        OmDetTurboProcessor,
    )

    tokenizer = _clip_tokenizer(77)
    OmDetTurboProcessor(
        DetrImageProcessor(size={"height": 64, "width": 64}), tokenizer
    ).save_pretrained(folder)
    channels = [16, 32, 64] if backbone is None else [32, 48, 64]
    config = OmDetTurboConfig(
        backbone_config=backbone or _swin(),
        text_config={"model_type": "clip_text_model", **_clip_text(tokenizer)},
        apply_layernorm_after_vision_backbone=False,
        image_size=64,
        num_queries=10,
        text_projection_in_dim=32,
        text_projection_out_dim=32,
        class_embed_dim=32,
        task_encoder_hidden_dim=32,
        vision_features_channels=[16] * 3,
        encoder_in_channels=channels,
        encoder_hidden_dim=16,
        encoder_attention_heads=2,
        encoder_dim_feedforward=32,
        decoder_hidden_dim=16,
        decoder_num_heads=2,
        decoder_num_layers=2,
        decoder_dim_feedforward=32,
    )
    _save(OmDetTurboForObjectDetection(config), folder)


def save_omdet_turbo_timm(folder: Path) -> None:
    """Save one whose backbone is timm's, as the published checkpoint's is."""
    from transformers import TimmBackboneConfig

    save_omdet_turbo(folder, TimmBackboneConfig(backbone="test_convnext", out_indices=[1, 2, 3]))


DETECTORS: dict[str, Callable[[Path], None]] = {
    "owlvit": save_owlvit,
    "owlv2": save_owlv2,
    "grounding_dino": save_grounding_dino,
    "omdet_turbo": save_omdet_turbo,
}


# -- scene VLMs
def _chat(image: str, video: str, answer: str = "") -> str:
    """Return a chat template that writes `image` and `video` for them, and begins the answer with
    `answer`."""
    return (
        "{%- for message in messages -%}<|im_start|>{{ message.role }}\n"
        "{%- for part in message.content -%}"
        "{%- if part.type == 'image' -%}" + image + "{%- elif part.type == 'video' -%}" + video + ""
        "{%- else -%}{{ part.text }}{%- endif -%}{%- endfor -%}<|im_end|>\n{%- endfor -%}"
        "{%- if add_generation_prompt -%}<|im_start|>assistant\n" + answer + "{%- endif -%}"
    )


_QWEN_CHAT = _chat(
    "<|vision_start|><|image_pad|><|vision_end|>", "<|vision_start|><|video_pad|><|vision_end|>"
)
_QWEN_TOKENS = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>"]
_QWEN_TOKENS += ["<|image_pad|>", "<|video_pad|>"]


def chat_tokenizer(special: list[str], **names: str) -> Any:
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    letters = bytes_alphabet()
    raw = Tokenizer(
        models.BPE(vocab={token: index for index, token in enumerate(letters)}, merges=[])
    )
    raw.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    raw.decoder = decoders.ByteLevel()
    raw.add_special_tokens(special)
    return PreTrainedTokenizerFast(
        tokenizer_object=raw, eos_token="<|im_end|>", pad_token="<|endoftext|>", **names
    )


def _save_vlm(model: Any, tokenizer: Any, folder: Path) -> None:
    model.generation_config.eos_token_id = tokenizer.eos_token_id
    model.generation_config.pad_token_id = tokenizer.pad_token_id
    _save(model, folder)


def _qwen_ids(tokenizer: Any) -> dict[str, int]:
    ids = tokenizer.convert_tokens_to_ids
    return {
        "image_token_id": ids("<|image_pad|>"),
        "video_token_id": ids("<|video_pad|>"),
        "vision_start_token_id": ids("<|vision_start|>"),
        "vision_end_token_id": ids("<|vision_end|>"),
    }


def _qwen_text(tokenizer: Any, **more: Any) -> dict[str, Any]:
    rope = {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 3, 3]}
    return _SMALL | {
        "vocab_size": len(tokenizer),
        "num_key_value_heads": 1,
        "head_dim": 16,
        "max_position_embeddings": 4096,
        "rope_parameters": rope,
        **more,
    }


_PATCHES = {"patch_size": 8, "temporal_patch_size": 2, "merge_size": 2}
_PIXELS = {"shortest_edge": 32 * 32, "longest_edge": 64 * 64}
_QWEN_VISION = {
    "depth": 1,
    "hidden_size": 32,
    "intermediate_size": 32,
    "num_heads": 2,
    "patch_size": 8,
    "out_hidden_size": 32,
}


def save_qwen2_5_vl(folder: Path) -> None:
    from transformers import (
        Qwen2_5_VLConfig,
        Qwen2_5_VLForConditionalGeneration,
        Qwen2_5_VLProcessor,
        Qwen2VLImageProcessor,
        Qwen2VLVideoProcessor,
    )

    tokenizer = chat_tokenizer(_QWEN_TOKENS)
    Qwen2_5_VLProcessor(
        image_processor=Qwen2VLImageProcessor(**_PATCHES, size=_PIXELS),
        tokenizer=tokenizer,
        video_processor=Qwen2VLVideoProcessor(**_PATCHES, size=_PIXELS),
        chat_template=_QWEN_CHAT,
    ).save_pretrained(folder)
    config = Qwen2_5_VLConfig(
        text_config=_qwen_text(tokenizer),
        vision_config=_QWEN_VISION
        | {"spatial_patch_size": 8, "window_size": 32, "fullatt_block_indexes": [0]},
        **_qwen_ids(tokenizer),
    )
    _save_vlm(Qwen2_5_VLForConditionalGeneration(config), tokenizer, folder)


def _save_qwen3_processor(folder: Path, chat: str) -> Any:
    from transformers import Qwen2VLImageProcessor, Qwen3VLProcessor, Qwen3VLVideoProcessor

    tokenizer = chat_tokenizer(_QWEN_TOKENS)
    Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(**_PATCHES, size=_PIXELS),
        tokenizer=tokenizer,
        video_processor=Qwen3VLVideoProcessor(**_PATCHES, size=_PIXELS),
        chat_template=chat,
    ).save_pretrained(folder)
    return tokenizer


def save_qwen3_vl(folder: Path) -> None:
    """Save one whose template opens a thought, as the thinking checkpoints' do."""
    from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

    chat = _QWEN_CHAT.replace("assistant\n", "assistant\n<think>\n")
    tokenizer = _save_qwen3_processor(folder, chat)
    config = Qwen3VLConfig(
        text_config=_qwen_text(tokenizer),
        vision_config=_QWEN_VISION
        | {"num_position_embeddings": 64, "deepstack_visual_indexes": [0]},
        **_qwen_ids(tokenizer),
    )
    _save_vlm(Qwen3VLForConditionalGeneration(config), tokenizer, folder)


def save_qwen3_5(folder: Path, **larger: Any) -> None:
    """`larger`: of its language model, where the model is to be larger."""
    from transformers import Qwen3_5Config, Qwen3_5ForConditionalGeneration

    tokenizer = _save_qwen3_processor(folder, _QWEN_CHAT)
    rope = {
        "rope_type": "default",
        "rope_theta": 10000.0,
        "mrope_section": [2, 1, 1],
        "mrope_interleaved": True,
        "partial_rotary_factor": 0.5,
    }
    text = _qwen_text(
        tokenizer,
        num_hidden_layers=2,
        layer_types=["linear_attention", "full_attention"],
        linear_key_head_dim=8,
        linear_value_head_dim=8,
        linear_num_key_heads=2,
        linear_num_value_heads=2,
        rope_parameters=rope,
    )
    text |= larger
    vision = {"num_position_embeddings": 64, "out_hidden_size": text["hidden_size"]}
    config = Qwen3_5Config(
        text_config=text, vision_config=_QWEN_VISION | vision, **_qwen_ids(tokenizer)
    )
    _save_vlm(Qwen3_5ForConditionalGeneration(config), tokenizer, folder)


def save_llava_onevision(folder: Path) -> None:
    from transformers import (
        LlavaOnevisionConfig,
        LlavaOnevisionForConditionalGeneration,
        LlavaOnevisionImageProcessor,
        LlavaOnevisionProcessor,
        LlavaOnevisionVideoProcessor,
    )

    tokenizer = chat_tokenizer(
        ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<image>", "<video>"]
    )
    size = {"height": 32, "width": 32}
    pinpoints = [[32, 32], [32, 64], [64, 32], [64, 64]]
    LlavaOnevisionProcessor(
        image_processor=LlavaOnevisionImageProcessor(size=size, image_grid_pinpoints=pinpoints),
        tokenizer=tokenizer,
        video_processor=LlavaOnevisionVideoProcessor(size=size),
        num_image_tokens=16,
        vision_feature_select_strategy="full",
        chat_template=_chat("<image>", "<video>"),
    ).save_pretrained(folder)
    ids = tokenizer.convert_tokens_to_ids
    config = LlavaOnevisionConfig(
        vision_config={
            "model_type": "siglip_vision_model",
            "image_size": 32,
            "patch_size": 8,
            "vision_use_head": False,
            **_SMALL,
        },
        text_config={
            "model_type": "qwen2",
            "vocab_size": len(tokenizer),
            "num_key_value_heads": 1,
            "max_position_embeddings": 4096,
            **_SMALL,
        },
        image_token_index=ids("<image>"),
        video_token_index=ids("<video>"),
        image_grid_pinpoints=pinpoints,
        vision_feature_select_strategy="full",
        vision_feature_layer=-1,
    )
    _save_vlm(LlavaOnevisionForConditionalGeneration(config), tokenizer, folder)


def save_smolvlm(folder: Path) -> None:
    from transformers import (
        SmolVLMConfig,
        SmolVLMForConditionalGeneration,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    special = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<image>", "<video>"]
    special += ["<fake_token_around_image>", "<global-img>", "<end_of_utterance>"]
    tokenizer = chat_tokenizer(special)
    size = {"longest_edge": 32}
    SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(
            size=size, max_image_size=size, do_image_splitting=False
        ),
        tokenizer=tokenizer,
        video_processor=SmolVLMVideoProcessor(size=size, max_image_size=size),
        image_seq_len=4,
        chat_template=_chat("<image>", "<video>"),
    ).save_pretrained(folder)
    config = SmolVLMConfig(
        vision_config=_SMALL | {"image_size": 32, "patch_size": 8},
        text_config={
            "model_type": "llama",
            "vocab_size": len(tokenizer),
            "num_key_value_heads": 1,
            "max_position_embeddings": 4096,
            "pad_token_id": tokenizer.pad_token_id,
            **_SMALL,
        },
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        scale_factor=2,
    )
    _save_vlm(SmolVLMForConditionalGeneration(config), tokenizer, folder)


VLMS: dict[str, Callable[[Path], None]] = {
    "qwen2_5_vl": save_qwen2_5_vl,
    "qwen3_vl": save_qwen3_vl,
    "qwen3_5": save_qwen3_5,
    "llava_onevision": save_llava_onevision,
    "smolvlm": save_smolvlm,
}
