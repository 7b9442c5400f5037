"""Number formats of the weights: what a manifest asks for, and NF4 through bitsandbytes.

A model's precision follows from its manifest alone, never from the device: weights are cast and
quantized in host RAM, then copied. What cannot be done is refused. Must not know leases or bytes.
"""

import importlib.util
import logging
import re
import sys
from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vram_arbiter.schemas.errors import ConfigError, UnsupportedQuantization
from vram_arbiter.schemas.findings import problems_of
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype, QuantizationBackend
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.sidecars.device.capacity import capabilities
from vram_arbiter.sidecars.replaced import replaced

if TYPE_CHECKING:
    import torch
    from bitsandbytes.nn import Linear4bit
    from torch.nn import Module

_log = logging.getLogger(__name__)

TORCH_NAMES: Final = {Dtype.FP32: "float32", Dtype.FP16: "float16", Dtype.BF16: "bfloat16"}
MIN_PARAMS: Final = 4_000_000
"""The field quantizes linear layers of this many weights and more; small ones cost accuracy."""
KEPT: Final = ("lm_head", "visual")
"""Modules that are not quantized unless the manifest names others."""
_WHOLE_BYTES: Final = 8  # 4-bit weights of a row fill whole elements of any number format
_MIN_CAPABILITY: Final = {Dtype.BF16: (8, 0), Dtype.FP16: (5, 3), Dtype.INT4: (6, 0)}
_NARROWER: Final = {
    (Dtype.INT4, Dtype.BF16): "write compute_dtype: float16 in quantization.extra",
    (Dtype.BF16, Dtype.BF16): "write dtype: fp16",
}
_LOADERS_KEYS: Final = ("loader", "trust_remote_code")


class Nf4(BaseModel):
    """What a manifest's `quantization.extra` says about NF4, in the field's words."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    scheme: Literal["nf4"] = "nf4"
    quantizer: Literal["bitsandbytes"] = "bitsandbytes"
    compute_dtype: Literal["float32", "float16", "bfloat16"] = "bfloat16"
    skip_modules: tuple[Annotated[str, Field(min_length=1)], ...] | None = None
    min_params_to_quantize: Annotated[int, Field(strict=True, ge=0)] = MIN_PARAMS

    @property
    def computes_in(self) -> Dtype:
        return next(dtype for dtype, name in TORCH_NAMES.items() if name == self.compute_dtype)

    @property
    def compute_type(self) -> "torch.dtype":
        return torch_type(self.computes_in)

    def chosen(self, model: "Module") -> list[str]:
        """Return the names of the linear layers to quantize.

        Left alone: modules that the manifest skips, by any part of their path; layers with fewer
        than `min_params_to_quantize` weights, or rows that do not fill whole bytes; weights that
        another module shares; subclasses of `Linear`, and layers of torch's own transformer: their
        owners read the weight themselves.

        Raises: ConfigError if the manifest skips a module that the model does not have,
        UnsupportedQuantization if no layer is left.
        """
        import torch
        from accelerate.utils import find_tied_parameters

        names = [name for name, _ in model.named_modules()]
        for skipped in self.skip_modules or ():
            if not any(_within(name, skipped) for name in names):
                raise ConfigError(
                    f"quantization.extra.skip_modules names {skipped!r}, and "
                    f"{type(model).__name__} has no such module",
                    hint=f"its modules are {', '.join(dict(model.named_children()))}, and theirs",
                )
        kept = self.skip_modules
        if kept is None:
            kept = (*KEPT, *_vision_towers(model))
        shared = {name for group in find_tied_parameters(model) for name in group}
        readers = [
            name
            for name, module in model.named_modules()
            if isinstance(module, torch.nn.TransformerEncoderLayer)
        ]
        found = [
            name
            for name, module in model.named_modules()
            if type(module) is torch.nn.Linear
            and module.weight.numel() >= self.min_params_to_quantize
            and module.in_features % _WHOLE_BYTES == 0
            and f"{name}.weight" not in shared
            and not any(_within(name, part) for part in (*kept, *readers))
        ]
        if not found:
            raise UnsupportedQuantization(
                f"{type(model).__name__} has no linear layer to quantize: none with at least "
                f"{self.min_params_to_quantize} weights outside of {', '.join(kept) or 'none'}",
                hint="lower quantization.extra.min_params_to_quantize, or write dtype: bf16",
            )
        return found

    def for_transformers(self, chosen: Iterable[str]) -> Any:
        """Return transformers' configuration for quantizing exactly the `chosen` layers."""
        from transformers import BitsAndBytesConfig

        return BitsAndBytesConfig(
            load_in_4bit=True,
            bnb_4bit_quant_type="nf4",
            bnb_4bit_compute_dtype=self.compute_type,
            llm_int8_skip_modules=all_but(chosen),
        )


def _vision_towers(model: "Module") -> list[str]:
    """Return the vision towers of a model of transformers, whose names differ by family."""
    vision = getattr(getattr(model, "config", None), "vision_config", None)
    found: list[str] = []
    if vision is None or not type(model).__module__.startswith("transformers."):
        return found
    for name, module in model.named_modules():
        sees = type(getattr(module, "config", None)) is type(vision)
        if sees and not any(_within(name, outer) for outer in found):
            found.append(name)
    return found


def all_but(chosen: Iterable[str]) -> list[str]:
    """Return transformers' `llm_int8_skip_modules` that leaves exactly the `chosen` modules.

    transformers takes an entry as a pattern from a name's beginning, or as its end: `visual` skips
    nothing of `model.visual.blocks.0`, and `layers.1` skips `layers.10`.
    """
    return [f"(?!(?:{'|'.join(map(re.escape, chosen))})$)"]


def _within(name: str, part: str) -> bool:
    """Return whether a module is `part` or inside of it: whole words of its dotted path."""
    return f".{part}." in f".{name}."


def torch_type(dtype: Dtype) -> "torch.dtype":
    """Return torch's type of a floating-point number format."""
    import torch

    found: torch.dtype = getattr(torch, TORCH_NAMES[dtype])
    return found


def nf4_of(manifest: RSkillManifest) -> Nf4 | None:
    """Return how a manifest's weights are quantized; None if they are not.

    Raises: UnsupportedQuantization for a number format that is not served, ConfigError for an
    `extra` that is not understood.
    """
    asked = manifest.quantization
    supported = ", ".join([*map(str, TORCH_NAMES), f"{Dtype.INT4} (NF4 through bitsandbytes)"])
    if asked.backend is not QuantizationBackend.PYTORCH:
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.backend {asked.backend.value!r} is not served",
            hint="write backend: pytorch",
        )
    if asked.dtype not in TORCH_NAMES and asked.dtype is not Dtype.INT4:
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.dtype {asked.dtype.value!r} is not served; supported: "
            f"{supported}",
            hint="write dtype: int4, or bf16 where the GPU has room",
            details={"dtype": asked.dtype.value, "supported": [*map(str, TORCH_NAMES), "int4"]},
        )
    nf4 = _read(manifest)
    if asked.dtype is not Dtype.INT4:
        return None
    if asked.per_channel:
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.per_channel with int4: NF4 is quantized in blocks",
            hint="write per_channel: false",
        )
    if importlib.util.find_spec("bitsandbytes") is None:
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.dtype 'int4' needs bitsandbytes, not installed here",
            hint="pip install bitsandbytes, or write dtype: bf16 where the GPU has room",
            details={"dtype": "int4", "supported": [*map(str, TORCH_NAMES)]},
        )
    return nf4


def check_checkpoint(manifest: RSkillManifest, config: JsonMap | None) -> None:
    """Refuse a checkpoint that is quantized in another way than its manifest says.

    `config` is the checkpoint's own `quantization_config`. Raises: UnsupportedQuantization.
    """
    if config is None:
        return
    dtype = manifest.quantization.dtype
    is_nf4 = (
        config.get("quant_method") == "bitsandbytes"
        and config.get("load_in_4bit") is True
        and config.get("bnb_4bit_quant_type") == "nf4"
    )
    if not is_nf4 or dtype is not Dtype.INT4:
        method = "NF4 of bitsandbytes" if is_nf4 else config.get("quant_method", "unknown")
        raise UnsupportedQuantization(
            f"{manifest.name}: the checkpoint is quantized ({method}), and quantization.dtype is "
            f"{dtype.value!r}",
            hint="write dtype: int4" if is_nf4 else "use the checkpoint before quantization",
            details={"dtype": dtype.value, "checkpoint": str(method)},
        )


def _read(manifest: RSkillManifest) -> Nf4:
    """Read `quantization.extra`. Raises ConfigError."""
    extra = {
        key: value for key, value in manifest.quantization.extra.items() if key not in _LOADERS_KEYS
    }
    try:
        return Nf4.model_validate(extra)
    except ValidationError as error:
        problems = problems_of(error, Nf4, extra)
        raise ConfigError(
            "; ".join(f"quantization.extra.{problem}" for problem in problems),
            hint=f"known: {', '.join((*Nf4.model_fields, *_LOADERS_KEYS))}",
        ) from None


def quantize_linear(module: "Module", manifest: RSkillManifest, device: str = "cpu") -> None:
    """Quantize the linear layers of a model in host RAM to NF4, in place, one after the other.

    Only where its manifest says int4; for the device `meta` they are only chosen.

    For models that transformers does not load. Cast the rest of the model before: what is quantized
    must never be cast. Each weight keeps the `dtype` that its model's code may ask it for. A model
    of a quantized checkpoint (`packed_weights`) keeps its layers as they are.

    Raises: ConfigError, UnsupportedQuantization.
    """
    nf4 = nf4_of(manifest)
    if nf4 is None or device == "meta":
        if nf4 is not None:
            nf4.chosen(module)
        return
    if layers := nf4_layers(module):
        for layer in layers.values():
            _store_as(layer, nf4.compute_type)
    else:
        kind = load_bitsandbytes().nn.Params4bit
        chosen = nf4.chosen(module)
        for name in chosen:
            linear = module.get_submodule(name)
            storage = linear.weight.dtype
            weight = kind(
                linear.weight.data,
                compress_statistics=False,
                quant_type="nf4",
                quant_storage=storage,
            ).to("cpu")
            module.set_submodule(name, linear4bit(linear, weight, nf4))
            del linear  # its weight is freed before the next one is quantized
    settle(module)
    _log.info("%d linear layers are NF4", len(layers) or len(chosen))


def linear4bit(linear: Any, weight: Any, nf4: Nf4) -> Any:
    """Return a layer like `linear` with the quantized `weight`."""
    layer = load_bitsandbytes().nn.Linear4bit(
        linear.in_features,
        linear.out_features,
        bias=False,
        compute_dtype=nf4.compute_type,
        compress_statistics=weight.compress_statistics,
        quant_type="nf4",
        quant_storage=weight.quant_storage,
        device="meta",
    )
    layer.register_forward_pre_hook(_autocast)
    weight.module, layer.weight, layer.quant_state = layer, weight, weight.quant_state
    layer.bias = linear.bias
    if linear.bias is not None:
        layer.bias.data = linear.bias.data.to(nf4.compute_type)
    return layer.train(linear.training)


def _autocast(layer: Any, inputs: Any) -> Any:
    """Cast a layer's input as torch's autocast does for linear layers; bitsandbytes leaves it."""
    import torch

    return tuple(
        values.to(layer.compute_dtype) if torch.is_autocast_enabled(values.device.type) else values
        for values in inputs
    )


def _store_as(layer: Any, dtype: "torch.dtype") -> None:
    """Show the bytes of a quantized weight as numbers of `dtype`, which its model's code reads."""
    weight = layer.weight
    weight.data = weight.data.reshape(-1).view(dtype).unsqueeze(1)
    weight.quant_storage = layer.quant_storage = dtype


def check_weights(model: "Module", manifest: RSkillManifest) -> None:
    """Refuse a model whose own code loads most of its weights in another number format than its
    manifest's. Raises: UnsupportedQuantization."""
    dtype = manifest.quantization.dtype
    if dtype not in TORCH_NAMES:
        return
    sizes: Counter[torch.dtype] = Counter()
    for parameter in model.parameters():
        if parameter.is_floating_point():
            sizes[parameter.dtype] += parameter.numel()
    ((found, _),) = sizes.most_common(1) or [(torch_type(dtype), 0)]
    if found != torch_type(dtype):
        names = {torch_type(one): one.value for one in TORCH_NAMES}
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.dtype is {dtype.value!r}, and "
            f"{type(model).__name__} loads its weights in {names.get(found, found)}",
            hint=f"write dtype: {names.get(found, 'fp32')}",
            details={"dtype": dtype.value, "supported": [names.get(found, str(found))]},
        )


def settle(model: "Module") -> None:
    """Keep NF4 weights as they were quantized.

    On a CPU with AVX512-BF16, bitsandbytes otherwise repacks them at the first call: into private
    memory, with coarser statistics, and only for rows that are multiples of 32.
    """
    for layer in nf4_layers(model).values():
        layer.support_avx512bf16_for_cpu = False


def nf4_layers(model: "Module") -> dict[str, "Linear4bit"]:
    """Return the quantized linear layers of a model by name."""
    kind = load_bitsandbytes().nn.Linear4bit
    return {name: layer for name, layer in model.named_modules() if isinstance(layer, kind)}


def load_bitsandbytes() -> Any:
    """Import bitsandbytes without initializing CUDA, which must be done after the fork only.

    Its import asks each GPU for its compute capability, and torch answers through CUDA.
    """
    # it warns of a kernel for repacked weights, which are not used (`settle`)
    logging.getLogger("bitsandbytes.backends.cpu.ops").setLevel(logging.ERROR)
    import torch

    def capability(device: object = None) -> tuple[int, int]:
        return max(capabilities("cuda"), default=(0, 0))

    with replaced(torch.cuda, get_device_capability=capability):
        import bitsandbytes
    return bitsandbytes


def check_precision(manifest: RSkillManifest, device: str) -> None:
    """Refuse a number format that is not served, or that `device` cannot compute in.

    `device` is `cuda` (any GPU will do), `cuda:N`, or else the CPU, which computes in all of them.

    Raises: UnsupportedQuantization, ConfigError.
    """
    nf4 = nf4_of(manifest)
    if device.partition(":")[0] != "cuda":
        return
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        found = [torch.cuda.get_device_capability(device)]
    else:
        found = capabilities(device)
    asked = manifest.quantization.dtype
    computes = asked if nf4 is None else nf4.computes_in
    needed = max(_MIN_CAPABILITY.get(dtype, (0, 0)) for dtype in (asked, computes))
    if found and max(found) < needed:
        has, needs = (".".join(map(str, version)) for version in (max(found), needed))
        computed = "" if nf4 is None else f" computed in {computes.value}"
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.dtype {asked.value!r}{computed} needs compute "
            f"capability {needs}, and {device} has {has}",
            hint=_NARROWER.get((asked, computes), "write dtype: fp32"),
            details={"dtype": asked.value, "needs": needs, "has": has},
        )
