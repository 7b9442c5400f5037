"""Tiny policies whose backbone lies beside them, as a folder that their configuration names."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.sidecars.adapters.policies import (
    DIM,
    FRONT,
    SIDE_PX,
    TASK,
    WORDS,
    WRIST,
    features,
    save,
    save_tokenizer,
)

_TEMPLATE = (
    "{% for message in messages %}{% for part in message.content %}"
    "{% if part.type == 'image' %}<|vision_start|><|image_pad|><|vision_end|>"
    "{% else %}{{ part.text }}{% endif %}{% endfor %}{% endfor %}"
)
_VISION_TOKENS = ("<|video_pad|>", "<|vision_start|>", "<|vision_end|>")


def _qwen_tokenizer(folder: Path, *more: str) -> Any:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(save_tokenizer(folder, "<|image_pad|>"))
    tokenizer.add_tokens([*_VISION_TOKENS, *more], special_tokens=True)
    return tokenizer


def _token_ids(tokenizer: Any) -> dict[str, int]:
    names = {"image_token_id": "<|image_pad|>", "video_token_id": "<|video_pad|>"}
    names |= {"vision_start_token_id": "<|vision_start|>", "vision_end_token_id": "<|vision_end|>"}
    return {key: tokenizer.convert_tokens_to_ids(token) for key, token in names.items()}


def _save_qwen3_vl(folder: Path) -> None:
    """Save a Qwen3-VL and its processor."""
    from transformers import (
        Qwen2VLImageProcessor,
        Qwen3VLConfig,
        Qwen3VLForConditionalGeneration,
        Qwen3VLProcessor,
        Qwen3VLVideoProcessor,
    )

    tokenizer = _qwen_tokenizer(folder)
    pixels = {"patch_size": 8, "size": {"shortest_edge": 32 * 32, "longest_edge": SIDE_PX**2}}
    tokenizer.chat_template = _TEMPLATE
    Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(**pixels),
        tokenizer=tokenizer,
        video_processor=Qwen3VLVideoProcessor(**pixels),
        chat_template=_TEMPLATE,
    ).save_pretrained(folder)
    text = {
        "vocab_size": 2 * WORDS, "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 2,
        "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 8,
        "rope_parameters": {
            "rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1],
            "mrope_interleaved": True,
        },
    }  # fmt: skip
    vision = {
        "depth": 1, "hidden_size": 16, "intermediate_size": 16, "num_heads": 2, "patch_size": 8,
        "out_hidden_size": 16, "num_position_embeddings": 16, "deepstack_visual_indexes": [0],
    }  # fmt: skip
    config = Qwen3VLConfig(text_config=text, vision_config=vision, **_token_ids(tokenizer))
    Qwen3VLForConditionalGeneration(config).save_pretrained(folder)


def save_vla_jepa(folder: Path) -> None:
    """Its VLM and the encoder of its world model lie beside it, with weights that the checkpoint
    replaces."""
    from lerobot.policies.vla_jepa.configuration_vla_jepa import VLAJEPAConfig
    from transformers import VJEPA2Config, VJEPA2Model, VJEPA2VideoProcessor

    vlm, encoder = folder / "vlm", folder / "encoder"
    _save_qwen3_vl(vlm)
    VJEPA2Model(
        VJEPA2Config(
            hidden_size=16, num_hidden_layers=1, num_attention_heads=2, crop_size=32, patch_size=16,
            frames_per_clip=4, mlp_ratio=1.0, pred_hidden_size=16, pred_num_attention_heads=2,
            pred_num_hidden_layers=1, pred_num_mask_tokens=1, pred_mlp_ratio=1.0,
        )
    ).save_pretrained(encoder)  # fmt: skip
    VJEPA2VideoProcessor().save_pretrained(encoder)
    config = VLAJEPAConfig(
        **features(FRONT), qwen_model_name=str(vlm), jepa_encoder_name=str(encoder), chunk_size=5,
        n_action_steps=3, action_hidden_size=16, action_num_layers=2, action_num_heads=2,
        action_attention_head_dim=8, num_target_vision_tokens=2, action_max_seq_len=64,
        num_video_frames=4, predictor_depth=1, predictor_num_heads=2, predictor_mlp_ratio=1.0,
        num_action_tokens_per_timestep=1, num_embodied_action_tokens_per_instruction=2,
        num_inference_timesteps=2,
    )  # fmt: skip
    save(folder, config, FRONT)


def save_wall_x(folder: Path) -> None:
    """Its backbone's processor and weights, which the checkpoint replaces, lie beside it."""
    from lerobot.policies.wall_x.configuration_wall_x import WallXConfig
    from lerobot.policies.wall_x.modeling_wall_x import Qwen2_5_VLMoEForAction
    from lerobot.policies.wall_x.qwen_model import Qwen2_5_VLConfig
    from transformers import Qwen2_5_VLProcessor, Qwen2VLImageProcessor, Qwen2VLVideoProcessor

    base = folder / "base"
    tokenizer = _qwen_tokenizer(
        base, "<|action|>", "<|propri|>", "<|action_fast|>", "<|im_start|>", "<|im_end|>"
    )
    processor = Qwen2_5_VLProcessor(
        image_processor=Qwen2VLImageProcessor(),
        tokenizer=tokenizer,
        video_processor=Qwen2VLVideoProcessor(),
        chat_template=_TEMPLATE,
    )
    processor.save_pretrained(base)
    expert = {"hidden_size": 16, "intermediate_size": 16, "hidden_act": "silu"}
    text = {
        "vocab_size": len(tokenizer), "hidden_size": 16, "intermediate_size": 16,
        "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 1,
        "num_experts": 2, "experts": [expert, expert], "dim_inputs": [16, 16], "mlp_moe": True,
        "dof_config": {"arm": 8}, "agent_pos_config": {"arm": 8},
        "noise_scheduler": {"num_inference_timesteps": 2},
        "rope_parameters": {
            "rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1]
        },
    }  # fmt: skip
    vision = {
        "depth": 1, "hidden_size": 16, "intermediate_size": 16, "num_heads": 2,
        "out_hidden_size": 16, "fullatt_block_indexes": [0],
    }  # fmt: skip
    config = Qwen2_5_VLConfig(text_config=text, vision_config=vision, **_token_ids(tokenizer))
    config.dof_config = config.agent_pos_config = {"arm": 8}
    Qwen2_5_VLMoEForAction(config, processor=processor).save_pretrained(base)
    policy = WallXConfig(
        **features(FRONT), pretrained_name_or_path=str(base), chunk_size=5, n_action_steps=3,
        max_state_dim=8, max_action_dim=8,
    )  # fmt: skip
    save(folder, policy, FRONT)


def save_groot(folder: Path) -> None:
    """Its VLM's configuration and processor lie beside it, and a base model with weights that the
    checkpoint replaces."""
    from lerobot.policies.groot.configuration_groot import GrootConfig
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config

    vlm, base = folder / "vlm", folder / "base"
    _save_qwen3_vl(vlm)
    attention = {"num_layers": 2, "num_attention_heads": 2, "attention_head_dim": 8}
    config = GR00TN17Config(
        model_name=str(vlm), backbone_embedding_dim=16, select_layer=1, hidden_size=16,
        input_embedding_dim=16, max_state_dim=8, max_action_dim=8, action_horizon=5,
        max_seq_len=64, num_inference_timesteps=2, max_num_embodiments=11, dtype="float32",
        diffusion_model_cfg=attention | {
            "positional_embeddings": None, "norm_type": "ada_norm", "dropout": 0.2,
            "final_dropout": True, "output_dim": 16, "interleave_self_attention": True,
        },
        vl_self_attention_cfg=attention | {"positional_embeddings": None, "final_dropout": True},
    )  # fmt: skip
    GR00TN17(config, load_backbone_weights=False).save_pretrained(base)
    policy = GrootConfig(
        **features(FRONT), base_model_path=str(base), chunk_size=5, n_action_steps=3,
        max_state_dim=8, max_action_dim=8, use_bf16=False,
    )  # fmt: skip
    save(folder, policy, FRONT)
    pipeline = folder / "policy_preprocessor.json"
    steps = json.loads(pipeline.read_text())
    for step in steps["steps"]:
        if step["registry_name"] == "groot_n1_7_vlm_encode_v1":
            step["config"]["model_name"] = str(vlm)  # the hub's name is fixed where it is made
            step["config"] |= {"image_target_size": [32, 32], "image_crop_size": [28, 28]}
    pipeline.write_text(json.dumps(steps))


def save_molmoact2(folder: Path) -> None:
    """A whole model of the published format lies beside it, with weights that the checkpoint
    replaces."""
    from lerobot.policies.molmoact2.configuration_molmoact2 import MolmoAct2Config
    from lerobot.policies.molmoact2.molmoact2_hf_model import configuration_molmoact2 as parts
    from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import (
        MolmoAct2ForConditionalGeneration,
    )
    from lerobot.policies.molmoact2.molmoact2_hf_model.processing_molmoact2 import IMAGE_TOKENS
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import Qwen2Tokenizer

    base = folder / "base"
    tokenizer = Qwen2Tokenizer(
        vocab={sign: place for place, sign in enumerate(sorted(ByteLevel.alphabet()))}, merges=[]
    )
    names = ("action", "state", "setup", "control")
    spoken = [f"<{name}_{end}>" for name in names for end in ("start", "end")]
    spoken += [f"<state_{place}>" for place in range(16)] + ["<action_output>", "<|image|>"]
    tokenizer.add_tokens(
        [*IMAGE_TOKENS, *spoken, "<|im_start|>", "<|im_end|>"], special_tokens=True
    )
    tokenizer.save_pretrained(base)
    ids = tokenizer.convert_tokens_to_ids
    small = {
        "hidden_size": 16, "intermediate_size": 16, "num_attention_heads": 2,
        "num_key_value_heads": 2, "head_dim": 8,
    }  # fmt: skip
    config = parts.MolmoAct2Config(
        vit_config=small | {
            "num_hidden_layers": 2, "image_default_input_size": [32, 32], "image_patch_size": 8,
            "image_num_pos": 16,
        },
        adapter_config=small | {"vit_layers": [-1], "text_hidden_size": 16},
        text_config=small | {
            "vocab_size": len(tokenizer), "additional_vocab_size": 1, "num_hidden_layers": 2,
        },
        action_expert_config={
            "hidden_size": 16, "num_layers": 2, "num_heads": 2, "timestep_embed_dim": 16,
            "ffn_multiple_of": 8,
        },
        image_start_token_id=ids("<im_start>"), image_end_token_id=ids("<im_end>"),
        low_res_image_start_token_id=ids("<low_res_im_start>"), image_col_id=ids("<im_col>"),
        image_low_res_id=ids("<im_low>"), image_patch_id=ids("<im_patch>"),
        frame_start_token_id=ids("<frame_start>"), frame_end_token_id=ids("<frame_end>"),
        max_action_horizon=5, action_mode="continuous", flow_matching_num_steps=2,
    )  # fmt: skip
    MolmoAct2ForConditionalGeneration(config).save_pretrained(base)
    pictures = {"size": {"height": 32, "width": 32}, "patch_size": 8, "max_crops": 1}
    (base / "processor_config.json").write_text(json.dumps({"image_processor": pictures}))
    policy = MolmoAct2Config(
        **features(FRONT), checkpoint_path=str(base), action_mode="continuous", chunk_size=5,
        n_action_steps=3, model_dtype="float32", num_state_tokens=16,
        inference_action_mode="continuous",
    )  # fmt: skip
    save(folder, policy, FRONT)


def save_lingbot_va(folder: Path) -> None:
    """Its encoders lie beside it: they are in no checkpoint."""
    import torch
    from diffusers import AutoencoderKLWan
    from lerobot.policies.lingbot_va.configuration_lingbot_va import LingBotVAConfig
    from transformers import UMT5Config, UMT5EncoderModel

    torch.manual_seed(1)
    wan = folder / "wan"
    AutoencoderKLWan(
        base_dim=4, decoder_base_dim=4, z_dim=48, dim_mult=[1, 1, 1, 1], num_res_blocks=1,
        is_residual=True, in_channels=12, out_channels=12, patch_size=2, scale_factor_spatial=16,
        latents_mean=[0.1] * 48, latents_std=[0.5] * 48,
    ).save_pretrained(wan / "vae")  # fmt: skip
    UMT5EncoderModel(
        UMT5Config(
            vocab_size=2 * WORDS, d_model=16, d_kv=8, d_ff=16, num_layers=1, num_heads=2,
        )
    ).save_pretrained(wan / "text_encoder")  # fmt: skip
    _save_t5_tokenizer(wan / "tokenizer")
    config = LingBotVAConfig(
        **features(FRONT, WRIST), wan_pretrained_path=str(wan), dtype="float32", num_layers=2,
        num_attention_heads=2, attention_head_dim=24, action_dim=DIM + 2, text_dim=16, freq_dim=16,
        ffn_dim=16, obs_cam_keys=[FRONT, WRIST], height=32, width=32, frame_chunk_size=2,
        num_inference_steps=2, action_num_inference_steps=2, max_sequence_length=8,
        used_action_channel_ids=list(range(DIM)),
    )  # fmt: skip
    save(folder, config, FRONT, WRIST)


def _save_t5_tokenizer(folder: Path) -> None:
    from tokenizers import Tokenizer, models
    from transformers import T5TokenizerFast

    words = ["<pad>", "</s>", "<unk>", *(f"\u2581{word}" for word in TASK.split())]
    raw = Tokenizer(models.Unigram([(word, -1.0) for word in words], unk_id=2))
    T5TokenizerFast(tokenizer_object=raw, extra_ids=0).save_pretrained(folder)


SAVERS: dict[str, Callable[[Path], None]] = {
    "vla_jepa": save_vla_jepa,
    "wall_x": save_wall_x,
    "gr00t": save_groot,
    "molmoact2": save_molmoact2,
    "lingbot_va": save_lingbot_va,
}
