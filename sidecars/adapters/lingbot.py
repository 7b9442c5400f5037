"""LingBot-VA beyond lerobot's common policy: encoders in no checkpoint, and a cache of an episode.

lerobot reads its image encoder (Wan VAE) and text encoder (UMT5) at the first action, in whatever
revision of a hub repository. Here they are a local folder, read and compared with the rest.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.sidecars.adapters.base import Inputs
from vram_arbiter.sidecars.checkpoints import META, Differences, load_transformers
from vram_arbiter.sidecars.weights import Weights

if TYPE_CHECKING:
    from torch import Tensor

STEPS_MAX: Final = 16
"""Control steps in one observation: their pictures have to fit into one message."""
_PARTS: Final = ("vae", "text_encoder", "tokenizer")
_WORD_FILES: Final = ("tokenizer.json", "spiece.model")
_VAE_FILE: Final = "diffusion_pytorch_model.safetensors"


def settle(config: Any, source: str) -> None:
    """Set what the sidecar decides in a LingBot-VA configuration.

    Raises: ModelError for a configuration whose actions would not be lerobot's.
    """
    folder = Path(source) / config.wan_pretrained_path  # an absolute path stays as it is
    if lacking := [part for part in _PARTS if not (folder / part).is_dir()]:
        raise ModelError(
            f"{source}: its encoders are in no checkpoint, and wan_pretrained_path "
            f"{config.wan_pretrained_path!r} is not a local folder with {', '.join(lacking)}",
            hint="download that repository and write the folder into the checkpoint's config.json",
        )
    words = folder / "tokenizer"
    if not any((words / name).is_file() for name in _WORD_FILES):
        raise ModelError(  # transformers makes up a tokenizer of no words
            f"{words} has none of {', '.join(_WORD_FILES)}", hint="get the whole folder"
        )
    if unknown := [key for key in config.obs_cam_keys if key not in config.image_features]:
        raise ModelError(
            f"{source}: obs_cam_keys names {', '.join(unknown)}, which are none of its inputs",
            hint="correct obs_cam_keys in the checkpoint's config.json",
        )
    if config.frame_chunk_size < 2 or config.chunk_size > STEPS_MAX:
        raise ModelError(
            f"{source}: a lingbot_va of {config.frame_chunk_size} frames and {config.chunk_size} "
            "actions a chunk is not served: its cache takes the observation after every action, "
            f"and an observation has at most {STEPS_MAX} control steps",
            hint=f"use a checkpoint with 2 frames or more and at most {STEPS_MAX} actions a chunk",
        )
    config.wan_pretrained_path = str(folder)
    config.text_encoder_device = "cpu"  # `place` moves it with the rest
    config.attn_mode = "torch"  # the other modes are for training, or need flash-attn
    config.save_predicted_video = False


def load_encoders(policy: Any) -> tuple[Any, Any]:
    """Load the image and text encoder that `policy` will compute with, and return both.

    On `meta` they are built without bytes. Raises: ModelError if their files do not hold all of
    them.
    """
    config = policy.config
    folder = Path(config.wan_pretrained_path)
    from transformers import UMT5EncoderModel

    text_files = Weights(str(folder / "text_encoder"), local=True)
    text_outline = load_transformers(
        UMT5EncoderModel, text_files, dtype=policy.dtype, device_map={"": META}
    )
    vae_outline = _vae_outline(folder / "vae").to(policy.dtype)
    if config.device == META:
        return vae_outline, text_outline
    try:
        policy._ensure_frozen_modules()  # lerobot's own loader, which has nothing to do later
    except (OSError, ValueError, ImportError) as error:
        raise ModelError(
            f"{folder}: its encoders cannot be read: {type(error).__name__}: {error}",
            hint="check that the folder is complete",
        ) from error
    return policy._frozen["vae"], policy._frozen["text_encoder"]


def _vae_outline(folder: Path) -> Any:
    """Return the image encoder without bytes. Raises ModelError if its file does not hold it."""
    import torch
    from diffusers import AutoencoderKLWan
    from safetensors import SafetensorError, safe_open

    wan: Any = AutoencoderKLWan
    try:
        with torch.device(META):
            outline = wan.from_config(wan.load_config(folder))
        with safe_open(folder / _VAE_FILE, "pt") as file:
            names = file.keys()
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in names}
    except (OSError, ValueError, TypeError, SafetensorError) as error:
        raise ModelError(
            f"{folder}: its image encoder cannot be read: {type(error).__name__}: {error}",
            hint=f"it needs config.json and {_VAE_FILE}",
        ) from error
    own = {name: tuple(tensor.shape) for name, tensor in outline.state_dict().items()}
    Differences(
        missing=own.keys() - shapes.keys(),
        foreign=shapes.keys() - own.keys(),
        misshapen={
            name: f"{shapes[name]}, not {own[name]}"
            for name in own.keys() & shapes.keys()
            if shapes[name] != own[name]
        },
    ).refuse(str(folder))
    return outline.eval()


def act(policy: Any, steps: Sequence[Inputs]) -> "Tensor":
    """Return the actions (B, T, D) that `select_action` plays until it would predict again.

    They stay in the policy's queue: the next call replays the episode's control steps through
    `select_action`, one an action, and the last of them predicts. `steps` may be as many as the
    longest answer has actions: then the last ones are those. After a failure the episode begins
    anew. Raises BadRequest for another number of steps.
    """
    import torch

    queue = policy._action_queue
    needed = len(queue) + 1 if policy._started else 1
    if len(steps) == policy.config.chunk_size:
        steps = steps[-needed:]
    if len(steps) != needed:
        raise BadRequest(
            f"the observation has {len(steps)} control steps, but this policy's cache needs "
            f"{needed}: one after each action of its last answer",
            hint="play whole answers, or reset",
            details={"needed": needed},
        )
    try:
        for step in steps:
            row = policy.select_action(dict(step))
    except BaseException:
        policy.reset()  # half of an answer is in its cache
        raise
    return torch.stack([row, *queue], dim=1)
