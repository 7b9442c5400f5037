"""Tiny policies with random weights, one of each family, saved as lerobot saves them."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

STATE, FRONT, WRIST = "observation.state", "observation.images.front", "observation.images.wrist"
ONLY_CAMERA = "observation.image"  # TDMPC's code knows no other name
SIDE_PX, DIM, WORDS = 64, 6, 64
TASK = "grab the red cube"


def features(*cameras: str) -> dict[str, Any]:
    from lerobot.configs.types import FeatureType, PolicyFeature

    visual = {name: PolicyFeature(FeatureType.VISUAL, (3, SIDE_PX, SIDE_PX)) for name in cameras}
    return {
        "input_features": {**visual, STATE: PolicyFeature(FeatureType.STATE, (DIM,))},
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (DIM,))},
        "device": "cpu",
    }


def statistics(*cameras: str) -> dict[str, dict[str, Any]]:
    """Statistics under which normalizing changes every number."""
    import torch

    def numbers(mean: float) -> dict[str, Any]:
        middle = torch.full((DIM,), mean)
        return {
            "mean": middle, "std": torch.full((DIM,), 2.0), "min": middle - 4, "max": middle + 4,
            "q01": middle - 4, "q99": middle + 4, "q10": middle - 3, "q90": middle + 3,
        }  # fmt: skip

    whole = torch.ones(3, 1, 1)
    pixels = {"mean": 0.4 * whole, "std": 0.2 * whole, "min": 0 * whole, "max": whole}
    return {STATE: numbers(0.5), "action": numbers(3.0)} | dict.fromkeys(cameras, pixels)


def save(
    folder: Path, config: Any, *cameras: str, change: Callable[[Any], None] | None = None
) -> None:
    """Save a policy of `config` with random weights, and its processors."""
    import torch
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    torch.manual_seed(0)
    policy = get_policy_class(config.type)(config)
    if change is not None:
        change(policy)
    policy.save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=statistics(*cameras)):
        pipeline.save_pretrained(folder)


def save_tokenizer(folder: Path, image_token: str = "<image_token>") -> str:
    """Save a tokenizer of a few words. Returns its folder."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    names = ("fake_image_token", "global_image_token", "end_of_utterance_token")
    tokens = {name: f"<{name}>" for name in names} | {"image_token": image_token}
    special = ["<pad>", "<unknown>", "<bos>", "<eos>", *tokens.values()]
    words = [*special, "Action", ":", "|", *TASK.split()]
    words += [f"word{place}" for place in range(len(words), WORDS)]
    raw = Tokenizer(
        models.WordLevel({word: place for place, word in enumerate(words)}, unk_token="<unknown>")
    )
    raw.pre_tokenizer = pre_tokenizers.Whitespace()
    PreTrainedTokenizerFast(
        tokenizer_object=raw, pad_token="<pad>", bos_token="<bos>", eos_token="<eos>",
        unk_token="<unknown>", extra_special_tokens=tokens,
    ).save_pretrained(folder)  # fmt: skip
    return str(folder)


def save_act(folder: Path, **options: Any) -> None:
    from lerobot.policies.act.configuration_act import ACTConfig

    small = {
        "dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "n_encoder_layers": 1,
        "n_vae_encoder_layers": 1, "chunk_size": 5, "n_action_steps": 3, "latent_dim": 4,
    }  # fmt: skip
    config = ACTConfig(**features(FRONT), pretrained_backbone_weights=None, **(small | options))
    save(folder, config, FRONT)
    text = json.loads((folder / "config.json").read_text())
    text["pretrained_backbone_weights"] = "ResNet18_Weights.IMAGENET1K_V1"  # as on the hub
    (folder / "config.json").write_text(json.dumps(text))


def save_ensembling_act(folder: Path) -> None:
    save_act(folder, temporal_ensemble_coeff=0.01, n_action_steps=1)


def save_diffusion(folder: Path) -> None:
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

    config = DiffusionConfig(
        **features(FRONT, WRIST), pretrained_backbone_weights=None, horizon=8, n_action_steps=4,
        down_dims=(8, 16), n_groups=2, diffusion_step_embed_dim=8, num_train_timesteps=4,
        spatial_softmax_num_keypoints=4, use_separate_rgb_encoder_per_camera=False,
    )  # fmt: skip
    save(folder, config, FRONT, WRIST)


def save_vqbet(folder: Path) -> None:
    from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig

    config = VQBeTConfig(
        **features(FRONT), pretrained_backbone_weights=None, crop_shape=None, gpt_n_layer=1,
        gpt_n_head=2, gpt_hidden_dim=16, gpt_input_dim=16, gpt_output_dim=16, n_obs_steps=3,
        vqvae_embedding_dim=8, vqvae_enc_hidden_dim=8, vqvae_n_embed=4, action_chunk_size=4,
        n_action_pred_token=2, spatial_softmax_num_keypoints=4, use_group_norm=True,
        gpt_block_size=50,
    )  # fmt: skip

    def discretized(policy: Any) -> None:
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)

    save(folder, config, FRONT, change=discretized)


def save_tdmpc(folder: Path, **options: Any) -> None:
    from lerobot.policies.tdmpc.configuration_tdmpc import TDMPCConfig

    config = TDMPCConfig(
        **features(ONLY_CAMERA), image_encoder_hidden_dim=4, state_encoder_hidden_dim=8,
        latent_dim=8, mlp_dim=16, q_ensemble_size=2, cem_iterations=2, n_gaussian_samples=8,
        n_pi_samples=2, n_elites=4, **options,
    )  # fmt: skip
    save(folder, config, ONLY_CAMERA)


def save_gaussian_actor(folder: Path) -> None:
    from lerobot.policies.gaussian_actor.configuration_gaussian_actor import (
        ActorNetworkConfig,
        GaussianActorConfig,
    )

    config = GaussianActorConfig(
        **features(FRONT), image_encoder_hidden_dim=4, state_encoder_hidden_dim=8, latent_dim=8,
        image_embedding_pooling_dim=2, dataset_stats=None,
        actor_network_kwargs=ActorNetworkConfig(hidden_dims=[8]),
    )  # fmt: skip
    save(folder, config, FRONT)


def save_multi_task_dit(folder: Path) -> None:
    from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
    from transformers import CLIPConfig, CLIPModel

    clip = folder / "clip"
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    small |= {"num_attention_heads": 2}
    CLIPModel(
        CLIPConfig(
            text_config=small | {"vocab_size": WORDS, "max_position_embeddings": 8},
            vision_config=small | {"image_size": SIDE_PX, "patch_size": 16},
            projection_dim=16,
        )
    ).save_pretrained(clip)
    save_tokenizer(clip)
    config = MultiTaskDiTConfig(
        **features(FRONT, WRIST), horizon=8, n_action_steps=4, num_train_timesteps=4,
        hidden_dim=16, num_layers=1, num_heads=2, timestep_embed_dim=8, tokenizer_max_length=8,
        vision_encoder_name=str(clip), text_encoder_name=str(clip), image_crop_shape=None,
    )  # fmt: skip
    save(folder, config, FRONT, WRIST)


def save_smolvla(folder: Path) -> None:
    """Its VLM's config and processor lie beside it; SmolVLM's own processor needs num2words."""
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from transformers import AutoTokenizer, Idefics3ImageProcessor, Idefics3Processor, SmolVLMConfig

    small = {"hidden_size": 32, "intermediate_size": 32, "num_attention_heads": 2}
    text = small | {
        "model_type": "llama", "vocab_size": WORDS, "num_hidden_layers": 2,
        "num_key_value_heads": 2,
        "head_dim": 16,
    }  # fmt: skip
    vision = small | {"num_hidden_layers": 1, "image_size": 32, "patch_size": 8}
    vlm = folder / "vlm"
    SmolVLMConfig(text_config=text, vision_config=vision, scale_factor=2).save_pretrained(vlm)
    tokenizer = AutoTokenizer.from_pretrained(save_tokenizer(vlm))
    Idefics3Processor(Idefics3ImageProcessor(), tokenizer).save_pretrained(vlm)
    config = SmolVLAConfig(
        **features(FRONT), vlm_model_name=str(vlm), load_vlm_weights=False, num_vlm_layers=2,
        chunk_size=5, n_action_steps=3, max_state_dim=8, max_action_dim=8, num_steps=2,
        resize_imgs_with_padding=(32, 32), empty_cameras=1,
    )  # fmt: skip
    save(folder, config, FRONT)


def save_eo1(folder: Path) -> None:
    """Its VLM's config and processor lie beside it."""
    from lerobot.policies.eo1.configuration_eo1 import EO1Config
    from transformers import (
        AutoTokenizer,
        Qwen2_5_VLConfig,
        Qwen2_5_VLProcessor,
        Qwen2VLImageProcessor,
        Qwen2VLVideoProcessor,
    )

    vlm = folder / "vlm"
    tokenizer = AutoTokenizer.from_pretrained(save_tokenizer(vlm, "<|image_pad|>"))
    tokenizer.add_tokens(
        ["<|video_pad|>", "<|vision_start|>", "<|vision_end|>"], special_tokens=True
    )
    template = (
        "{% for message in messages %}{% for part in message.content %}"
        "{% if part.type == 'image' %}<|vision_start|><|image_pad|><|vision_end|>"
        "{% else %}{{ part.text }}{% endif %}{% endfor %}{% endfor %}"
    )
    Qwen2_5_VLProcessor(
        image_processor=Qwen2VLImageProcessor(patch_size=8),
        tokenizer=tokenizer,
        video_processor=Qwen2VLVideoProcessor(patch_size=8),
        chat_template=template,
    ).save_pretrained(vlm)
    ids = tokenizer.convert_tokens_to_ids
    text = {
        "vocab_size": 2 * WORDS, "hidden_size": 16, "intermediate_size": 16,
        "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 1,
        "rope_parameters": {
            "rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1]
        },
    }  # fmt: skip
    vision = {
        "depth": 1, "hidden_size": 16, "intermediate_size": 16, "num_heads": 2, "patch_size": 8,
        "out_hidden_size": 16, "window_size": 32, "fullatt_block_indexes": [0],
    }  # fmt: skip
    vlm_config = Qwen2_5_VLConfig(
        text_config=text, vision_config=vision, image_token_id=ids("<|image_pad|>"),
        video_token_id=ids("<|video_pad|>"), vision_start_token_id=ids("<|vision_start|>"),
        vision_end_token_id=ids("<|vision_end|>"),
    )  # fmt: skip
    config = EO1Config(
        **features(FRONT), vlm_base=str(vlm), vlm_config=vlm_config.to_dict(), chunk_size=5,
        n_action_steps=3, max_state_dim=8, max_action_dim=8, num_denoise_steps=2,
        image_min_pixels=32 * 32, image_max_pixels=SIDE_PX * SIDE_PX, dtype="float32",
    )  # fmt: skip
    config.pretrained_path = folder  # its VLM is made from the config
    save(folder, config, FRONT)


def save_evo1(folder: Path) -> None:
    """Its VLM lies beside it, with weights that the checkpoint replaces."""
    from lerobot.policies.evo1.configuration_evo1 import Evo1Config
    from transformers import AutoTokenizer, InternVLConfig, InternVLModel

    vlm = folder / "vlm"
    image_token = "<IMG_CONTEXT>"
    tokenizer = AutoTokenizer.from_pretrained(save_tokenizer(vlm, image_token))
    tokenizer.add_tokens(["<img>", "</img>"], special_tokens=True)
    tokenizer.save_pretrained(vlm)
    small = {
        "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1,
        "num_attention_heads": 2,
    }  # fmt: skip
    vision = small | {"image_size": [SIDE_PX, SIDE_PX], "patch_size": [16, 16]}
    text = small | {
        "model_type": "qwen2", "vocab_size": 2 * WORDS, "num_key_value_heads": 1,
    }  # fmt: skip
    InternVLModel(
        InternVLConfig(
            vision_config=vision, text_config=text, image_seq_length=4,
            image_token_id=tokenizer.convert_tokens_to_ids(image_token),
        )
    ).save_pretrained(vlm)  # fmt: skip
    config = Evo1Config(
        **features(FRONT), vlm_model_name=str(vlm), vlm_num_layers=1, vlm_dtype="float32",
        image_resolution=(SIDE_PX, SIDE_PX), max_views=2, embed_dim=16, hidden_dim=16,
        state_hidden_dim=16, num_heads=2, num_layers=1, num_inference_timesteps=2, chunk_size=5,
        n_action_steps=3, max_state_dim=8, max_action_dim=8, use_flash_attn=False,
    )  # fmt: skip
    save(folder, config, FRONT)


def save_xvla(folder: Path) -> None:
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig

    text = {
        "vocab_size": WORDS, "d_model": 16, "encoder_layers": 1, "decoder_layers": 1,
        "encoder_attention_heads": 2, "decoder_attention_heads": 2, "encoder_ffn_dim": 16,
        "decoder_ffn_dim": 16, "max_position_embeddings": 64,
    }  # fmt: skip
    vision = {
        "embed_dim": [8, 8, 8, 16], "depths": [1, 1, 1, 1], "num_heads": [1, 1, 1, 2],
        "num_groups": [1, 1, 1, 2], "window_size": 2, "projection_dim": 16,
    }  # fmt: skip
    config = XVLAConfig(
        **features(FRONT), florence_config={"text_config": text, "vision_config": vision},
        tokenizer_name=save_tokenizer(folder / "words"), tokenizer_max_length=8, hidden_size=16,
        depth=1, num_heads=2, num_domains=2, len_soft_prompts=2, dim_time=8, chunk_size=5,
        n_action_steps=3, num_denoising_steps=2, max_state_dim=8, max_action_dim=8,
        action_mode="auto", max_len_seq=64,
    )  # fmt: skip
    save(folder, config, FRONT)


@contextmanager
def small_networks() -> Iterator[None]:
    """Shrink the networks whose sizes are fixed in lerobot's code: ResNet, and PaliGemma and Gemma
    of the pi0 families."""
    import importlib

    from lerobot.policies import pi_gemma
    from lerobot.processor import ActionTokenizerProcessorStep

    modules = [
        importlib.import_module(f"lerobot.policies.{name}.modeling_{name}")
        for name in ("pi0", "pi05", "pi0_fast")
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchvision.models.resnet18", _small_resnet)
        # made for the training of pi0-FAST; its configuration loses the text tokenizer's name
        patch.setattr(ActionTokenizerProcessorStep, "__post_init__", lambda self: None)
        for module in modules:

            def size(_: str, module: Any = module) -> Any:
                return module.GemmaConfig(
                    width=16, depth=1, mlp_dim=16, num_heads=2, num_kv_heads=1, head_dim=8
                )

            patch.setattr(module, "get_gemma_config", size)
            patch.setattr(
                module, "PaliGemmaForConditionalGenerationWithPiGemma", _small_paligemma(pi_gemma)
            )
            if hasattr(module, "AutoProcessor"):
                patch.setattr(module, "AutoProcessor", FastTokenizer)
            if hasattr(module, "PiGemmaForCausalLM"):
                patch.setattr(module, "PiGemmaForCausalLM", _small_gemma(pi_gemma))
        yield


class FastTokenizer:
    """Stands for FAST's tokenizer of actions, which is remote code on the hub."""

    scale, min_token = 10.0, -20
    bpe_tokenizer: "FastTokenizer"

    def __init__(self) -> None:
        self.bpe_tokenizer = self

    @classmethod
    def from_pretrained(cls, *_: Any, **__: Any) -> "FastTokenizer":
        return cls()

    def decode(self, tokens: Any) -> str:
        return "".join(chr(abs(int(token))) for token in tokens)


def _small_resnet(weights: Any = None, **_: Any) -> Any:
    from torch import nn

    assert weights is None, "a download"
    layers = {
        "conv1": nn.Conv2d(3, 8, 8, stride=8), "relu": nn.ReLU(),
        "layer4": nn.Conv2d(8, 16, 4, stride=4), "avgpool": nn.AdaptiveAvgPool2d(1),
        "fc": nn.Linear(16, 4),
    }  # fmt: skip
    network = nn.Sequential()
    for name, layer in layers.items():
        network.add_module(name, layer)
    return network


def _small_paligemma(pi_gemma: Any) -> Any:
    def make(config: Any) -> Any:
        config.text_config.vocab_size = WORDS
        config.image_token_index = WORDS - 1
        vision = config.vision_config
        vision.hidden_size = vision.intermediate_size = vision.projection_dim = 16
        vision.num_hidden_layers, vision.num_attention_heads, vision.image_size = 1, 2, SIDE_PX
        vision.patch_size = 16
        return pi_gemma.PaliGemmaForConditionalGenerationWithPiGemma(config=config)

    return make


def _small_gemma(pi_gemma: Any) -> Any:
    def make(config: Any) -> Any:
        config.vocab_size = WORDS
        return pi_gemma.PiGemmaForCausalLM(config=config)

    return make


@contextmanager
def _own_tokenizer(family: str, folder: str) -> Iterator[None]:
    """Save a processor with our tokenizer: PaliGemma's is named in lerobot's code."""
    import importlib

    module: Any = importlib.import_module(f"lerobot.policies.{family}.processor_{family}")
    step = module.TokenizerProcessorStep
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            module,
            "TokenizerProcessorStep",
            lambda **options: step(**(options | {"tokenizer_name": folder})),
        )
        yield


def _save_pi(family: str, folder: Path, **options: Any) -> None:
    from lerobot.policies.factory import make_policy_config

    config = make_policy_config(
        family, **features(FRONT), chunk_size=5, n_action_steps=3, max_state_dim=8,
        max_action_dim=8, image_resolution=(SIDE_PX, SIDE_PX), empty_cameras=1,
        tokenizer_max_length=16, **options,
    )  # fmt: skip
    with _own_tokenizer(family, save_tokenizer(folder / "words")), small_networks():
        save(folder, config, FRONT)


def save_pi0(folder: Path) -> None:
    _save_pi("pi0", folder, num_inference_steps=2)


def save_pi0_fast(folder: Path) -> None:
    _save_pi(
        "pi0_fast", folder, fast_skip_tokens=0, validate_action_token_prefix=False,
        max_decoding_steps=12, text_tokenizer_name=save_tokenizer(folder / "words"),
    )  # fmt: skip


def save_pi05(folder: Path) -> None:
    _save_pi("pi05", folder, num_inference_steps=2)


SAVERS: dict[str, Callable[[Path], None]] = {
    "act": save_act,
    "act ensembling": save_ensembling_act,
    "diffusion": save_diffusion,
    "vqbet": save_vqbet,
    "tdmpc": save_tdmpc,
    "gaussian_actor": save_gaussian_actor,
    "multi_task_dit": save_multi_task_dit,
    "smolvla": save_smolvla,
    "pi0": save_pi0,
    "pi05": save_pi05,
    "pi0_fast": save_pi0_fast,
    "xvla": save_xvla,
    "eo1": save_eo1,
    "evo1": save_evo1,
}
