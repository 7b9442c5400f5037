"""Source of weights, and the one call that loads them: hub id and local folder alike.

`local://models/x` is CONFIGS/models/x; `hf://owner/repo[@revision]` is a repository of the hub.
Must not know devices' bytes or leases.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.configs import CONFIGS_VARIABLE
from vram_arbiter.schemas.errors import ConfigError, ModelError, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.schemas.plain import Message

CONFIG_FILE: Final = "config.json"


@dataclass(frozen=True, slots=True)
class Weights:
    """Source of weights; `source` is what `from_pretrained` takes: a folder or `owner/repo`."""

    source: str
    revision: str | None = None
    local: bool = False


def resolve(uri: str, configs: Path) -> Weights:
    """Parse a manifest's `weights_uri`.

    Raises ConfigError if it leads nowhere or out of the configs folder.
    """
    scheme, _, rest = uri.partition("://")
    if scheme == "hf":
        source, _, revision = rest.partition("@")
        return Weights(source, revision or None)
    folder = (configs / rest).resolve()
    if scheme != "local" or not folder.is_relative_to(configs.resolve()):
        raise ConfigError(
            f"weights_uri {uri!r} is not a source of weights",
            hint="write hf://OWNER/REPO or local://models/NAME",
        )
    if not folder.is_dir():
        raise ConfigError(
            f"no weights in {folder}",
            hint=f"{uri} is looked up below {configs}; see {CONFIGS_VARIABLE}",
        )
    return Weights(str(folder), local=True)


def model_type(weights: Weights, key: str) -> str:
    """Return a text of a local checkpoint's `config.json`, such as `model_type`; "" if it has none
    that a module could be named by."""
    try:
        found = json.loads((Path(weights.source) / "config.json").read_text(encoding="utf-8"))
        named = found.get(key)
    except (OSError, ValueError, AttributeError):
        return ""
    return named if isinstance(named, str) and named.isidentifier() else ""


def transformers_modules(weights: Weights) -> tuple[str, ...]:
    """Return the modules of a transformers model."""
    kind = model_type(weights, "model_type")
    return ("torch", "transformers", "PIL.Image", f"transformers.models.{kind}.modeling_{kind}")


def cached(weights: Weights) -> Weights | None:
    """Return the local folder of a hub repository in the hub's cache; None if never fetched."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        folder = Path(
            snapshot_download(weights.source, revision=weights.revision, local_files_only=True)
        )
    except LocalEntryNotFoundError:
        return None
    return Weights(str(folder), local=True) if any(folder.glob("*.safetensors")) else None


def from_pretrained(cls: Any, weights: Weights, **options: Any) -> Any:
    """Call `cls.from_pretrained` of any class of transformers or lerobot.

    Raises ModelError if the checkpoint does not fit the class.
    """
    if weights.local:
        options["local_files_only"] = True
    elif weights.revision:
        options["revision"] = weights.revision
    try:
        return cls.from_pretrained(weights.source, **options)
    except VramError:
        raise
    except Exception as error:
        if (
            type(error).__name__ == "OutOfMemoryError"
        ):  # torch's error, which says more than that the weights are bad
            raise
        raise _unfit(cls, weights, error) from error


def read_config(cls: Any, weights: Weights) -> Any:
    """Return a checkpoint's configuration, decoded by a configuration class of lerobot.

    `cls.from_pretrained` does the same through a temporary file that it leaves behind. Raises
    ModelError.
    """
    import draccus
    from huggingface_hub import hf_hub_download

    try:
        if weights.local:
            path = Path(weights.source) / CONFIG_FILE
        else:
            path = Path(hf_hub_download(weights.source, CONFIG_FILE, revision=weights.revision))
        fields = json.loads(path.read_text(encoding="utf-8"))
        kind = cls.get_choice_class(fields.pop("type"))
        with draccus.config_type("json"):
            return draccus.decode(kind, fields)
    except Exception as error:
        raise _unfit(cls, weights, error) from error


def _unfit(cls: Any, weights: Weights, error: Exception) -> ModelError:
    return ModelError(
        f"{cls.__name__} cannot load {weights.source}: {type(error).__name__}: {error}",
        hint="check that it is complete and of the manifest's kind",
    )


def model_options(manifest: RSkillManifest, weights: Weights, device: str) -> Message:
    """Return options for loading a transformers model onto `device` as in production.

    On the CPU: none, float32 as saved. On CUDA: shards go straight to the GPU, one after the other
    (never the whole model twice), in the manifest's number format; `int4` is NF4 through
    bitsandbytes, unless the checkpoint is quantized already.
    """
    os.environ.setdefault(
        "HF_DEACTIVATE_ASYNC_LOAD", "1"
    )  # transformers then loads shard by shard: a lower peak
    if device == "meta":
        return {"device_map": {"": device}}
    if not device.startswith("cuda"):
        return {}
    import torch

    dtype = manifest.quantization.dtype
    options: Message = {"device_map": {"": device}, "low_cpu_mem_usage": True}
    options["dtype"] = {Dtype.FP32: torch.float32, Dtype.FP16: torch.float16}.get(
        dtype, torch.bfloat16
    )
    if dtype is Dtype.INT4 and not is_quantized(weights):
        from transformers import BitsAndBytesConfig

        options["quantization_config"] = BitsAndBytesConfig(
            load_in_4bit=True,
            bnb_4bit_quant_type="nf4",
            bnb_4bit_compute_dtype=torch.bfloat16,
            llm_int8_skip_modules=unquantized_modules(manifest),
        )
    return options


def unquantized_modules(manifest: RSkillManifest) -> list[str]:
    """Return the modules that keep their precision: `quantization.extra.skip_modules`.

    Raises ConfigError for anything but a list of names.
    """
    names = manifest.quantization.extra.get("skip_modules", ["lm_head", "visual"])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(
            f"quantization.extra.skip_modules is {names!r}",
            hint="give a list of module names, e.g. [lm_head, visual]",
        )
    return [str(name) for name in names]


def is_quantized(weights: Weights) -> bool:
    """Return whether the checkpoint's own configuration says how it is quantized."""
    from transformers import AutoConfig

    return getattr(from_pretrained(AutoConfig, weights), "quantization_config", None) is not None
