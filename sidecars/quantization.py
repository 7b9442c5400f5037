"""Number formats of the weights: what a manifest asks for, and NF4 through bitsandbytes.

A model's precision follows from its manifest alone, never from the device: weights are cast and
quantized in host RAM, then copied. What cannot be done is refused. Must not know leases or bytes.
"""

import importlib.util
import json
import logging
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.errors import ConfigError, UnsupportedQuantization
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype, QuantizationBackend
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.sidecars.device.capacity import visible

if TYPE_CHECKING:
    import torch
    from torch import Tensor
    from torch.nn import Module

_log = logging.getLogger(__name__)

TORCH_NAMES: Final = {Dtype.FP32: "float32", Dtype.FP16: "float16", Dtype.BF16: "bfloat16"}
MIN_PARAMS: Final = 4_000_000
"""The field quantizes linear layers of this many weights and more; small ones cost accuracy."""
KEPT: Final = ("lm_head", "visual")
"""Modules that are not quantized unless the manifest names others."""
_WHOLE_BYTES: Final = 8  # 4-bit weights of a row fill whole elements of any number format
_MIN_CAPABILITY: Final = {Dtype.BF16: (8, 0), Dtype.FP16: (5, 3), Dtype.INT4: (6, 0)}
_LOADERS_KEYS: Final = ("loader", "trust_remote_code")


@dataclass(frozen=True, slots=True)
class Nf4:
    """What a manifest's `quantization.extra` says about NF4."""

    compute_dtype: Dtype = Dtype.BF16
    skip_modules: tuple[str, ...] | None = None
    min_params: int = MIN_PARAMS

    @property
    def compute_type(self) -> "torch.dtype":
        return torch_type(self.compute_dtype)

    def chosen(self, model: "Module") -> list[str]:
        """Return the names of the linear layers to quantize.

        Left alone: modules that the manifest skips, by any part of their path; layers with fewer
        than `min_params` weights, or rows that do not fill whole bytes; weights that another module
        shares; subclasses of `Linear`, whose owners read the weight themselves.

        Raises: ConfigError if the manifest skips a module that the model does not have,
        UnsupportedQuantization if no layer is left.
        """
        import torch

        names = [name for name, _ in model.named_modules()]
        for skipped in self.skip_modules or ():
            if not any(_within(name, skipped) for name in names):
                raise ConfigError(
                    f"quantization.extra.skip_modules names {skipped!r}, and "
                    f"{type(model).__name__} has no such module",
                    hint=f"its modules are {', '.join(dict(model.named_children()))}, and theirs",
                )
        kept = KEPT if self.skip_modules is None else self.skip_modules
        uses = Counter(
            id(parameter) for _, parameter in model.named_parameters(remove_duplicate=False)
        )
        found = [
            name
            for name, module in model.named_modules()
            if type(module) is torch.nn.Linear
            and module.weight.numel() >= self.min_params
            and module.in_features % _WHOLE_BYTES == 0
            and uses[id(module.weight)] == 1
            and not any(_within(name, skipped) for skipped in kept)
        ]
        if not found:
            raise UnsupportedQuantization(
                f"{type(model).__name__} has no linear layer to quantize: none with at least "
                f"{self.min_params} weights outside of {', '.join(kept) or 'no module'}",
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
            f"{manifest.name}: quantization.dtype 'int4' needs bitsandbytes, which is not installed",
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
    extra = dict(manifest.quantization.extra)

    def refuse(key: str, expected: str) -> ConfigError:
        value = manifest.quantization.extra[key]
        return ConfigError(f"quantization.extra.{key} is {value!r}", hint=f"write {expected}")

    for key, only in (("scheme", "nf4"), ("quantizer", "bitsandbytes")):
        if extra.pop(key, only) != only:
            raise refuse(key, only)
    types = {name: dtype for dtype, name in TORCH_NAMES.items()}
    compute = types.get(str(extra.pop("compute_dtype", "bfloat16")))
    if compute is None:
        raise refuse("compute_dtype", f"one of {', '.join(types)}")
    least = extra.pop("min_params_to_quantize", MIN_PARAMS)
    if not isinstance(least, int) or isinstance(least, bool) or least < 0:
        raise refuse("min_params_to_quantize", "a number of weights, e.g. 4000000")
    names = extra.pop("skip_modules", None)
    if names is not None and not (
        isinstance(names, list) and all(isinstance(name, str) and name for name in names)
    ):
        raise refuse("skip_modules", "a list of module names, e.g. [lm_head, visual]")
    for key in _LOADERS_KEYS:
        extra.pop(key, None)
    if extra:
        known = "scheme, quantizer, compute_dtype, min_params_to_quantize, skip_modules"
        raise ConfigError(
            f"quantization.extra has {', '.join(extra)}, which no loader honors",
            hint=f"known: {known}, {', '.join(_LOADERS_KEYS)}",
        )
    return Nf4(compute, None if names is None else tuple(map(str, names)), least)


def quantize_linear(module: "Module", manifest: RSkillManifest) -> None:
    """Quantize the linear layers of a model in host RAM to NF4, in place, one after the other.

    For models that transformers does not load. Cast the rest of the model before: what is quantized
    must never be cast. Each weight keeps the `dtype` that its model's code may ask it for.

    Raises: ConfigError, UnsupportedQuantization.
    """
    nf4 = nf4_of(manifest)
    if nf4 is None:
        return
    bnb = load_bitsandbytes()
    chosen = nf4.chosen(module)
    for name in chosen:
        linear = module.get_submodule(name)
        assert isinstance(linear, _torch().nn.Linear)
        storage = linear.weight.dtype
        quantized = bnb.nn.Linear4bit(
            linear.in_features,
            linear.out_features,
            bias=False,
            compute_dtype=nf4.compute_type,
            compress_statistics=False,
            quant_type="nf4",
            quant_storage=storage,
            device="meta",
        )
        quantized.weight = bnb.nn.Params4bit(
            linear.weight.data,
            compress_statistics=False,
            quant_type="nf4",
            quant_storage=storage,
            module=quantized,
        ).to("cpu")
        quantized.bias = linear.bias
        if linear.bias is not None:
            quantized.bias.data = linear.bias.data.to(nf4.compute_type)
        module.set_submodule(name, quantized.train(linear.training))
        del linear  # its weight is freed before the next one is quantized
    settle(module)
    _log.info("quantized %d linear layers to NF4", len(chosen))


def settle(model: "Module") -> None:
    """Keep NF4 weights as they were quantized.

    On a CPU with AVX512-BF16, bitsandbytes otherwise repacks them at the first call: into private
    memory, with coarser statistics, and only for rows that are multiples of 32.
    """
    for layer in nf4_layers(model).values():
        layer.support_avx512bf16_for_cpu = False


def nf4_layers(model: "Module") -> dict[str, Any]:
    """Return the quantized linear layers of a model by name."""
    kind = load_bitsandbytes().nn.Linear4bit
    return {name: layer for name, layer in model.named_modules() if isinstance(layer, kind)}


@dataclass(slots=True)
class PackedHeader:
    """Names and shapes of a checkpoint with NF4 weights, as if it were not quantized.

    `tensors` are on `meta`; `quantized` are the names among them that the checkpoint holds packed.
    """

    tensors: "dict[str, Tensor]" = field(default_factory=dict)
    quantized: list[str] = field(default_factory=list)
    missing: set[str] = field(default_factory=set)
    misshapen: dict[str, str] = field(default_factory=dict)


_BLOB: Final = ".quant_state.bitsandbytes__nf4"  # JSON: shape, block size
_NESTED: Final = ("nested_absmax", "nested_quant_map")  # statistics of the statistics
_STATISTICS: Final = ("absmax", "quant_map", *_NESTED)
_BYTES: Final = {"U8": 1, "F16": 2, "BF16": 2, "F32": 4}  # of an element, as safetensors names it
_CODES: Final = 16
_NESTED_CODES: Final = 256


def read_packed(files: Iterable[Path]) -> PackedHeader:
    """Read the headers of safetensors files, and of each packed weight the bytes that tell its
    shape. Raises what safetensors and JSON raise for a file that is not whole."""
    import torch
    from safetensors import safe_open

    shapes: dict[str, list[int]] = {}
    types: dict[str, str] = {}
    states: dict[str, JsonMap] = {}
    for path in files:
        with safe_open(path, "pt") as file:
            for name in file.keys():  # noqa: SIM118  not a mapping
                part = file.get_slice(name)
                shapes[name], types[name] = part.get_shape(), part.get_dtype()
                if name.endswith(_BLOB):
                    blob = bytes(file.get_tensor(name).tolist())
                    states[name.removesuffix(_BLOB)] = json.loads(blob)
    found = PackedHeader()
    for name, shape in shapes.items():
        weight, _, last = name.rpartition(".")
        if last in _STATISTICS and (weight in shapes or weight in states):
            if weight not in states:
                found.missing.add(weight + _BLOB)
        elif not name.endswith(_BLOB) and name not in states:
            found.tensors[name] = torch.empty(shape, device="meta")
    for weight, state in states.items():
        expected = _sizes_of(weight, state)
        found.missing |= expected.keys() - shapes.keys() - {weight}
        for name in expected.keys() & shapes.keys():
            size = math.prod(shapes[name]) * _BYTES.get(types[name], 0)
            if size != expected[name]:
                found.misshapen[name] = f"{size} bytes, not {expected[name]}"
        if weight in shapes:
            found.tensors[weight] = torch.empty(state["shape"], device="meta")
            found.quantized.append(weight)
    return found


def _sizes_of(weight: str, state: JsonMap) -> dict[str, int]:
    """Return the bytes of a packed weight and of its statistics, by name."""
    count = math.prod(state["shape"])
    blocks = -(-count // state["blocksize"])
    sizes = {weight: -(-count // 2), f"{weight}.quant_map": 4 * _CODES}
    if "nested_blocksize" not in state:
        return sizes | {f"{weight}.absmax": 4 * blocks}
    return sizes | {
        f"{weight}.absmax": blocks,
        f"{weight}.nested_absmax": 4 * -(-blocks // state["nested_blocksize"]),
        f"{weight}.nested_quant_map": 4 * _NESTED_CODES,
    }


def load_bitsandbytes() -> Any:
    """Import bitsandbytes without initializing CUDA, which must be done after the fork only.

    Its import asks each GPU for its compute capability, and torch answers through CUDA.
    """
    with _capability_without_cuda():
        import bitsandbytes
    return bitsandbytes


def _torch() -> Any:
    import torch

    return torch


@contextmanager
def _capability_without_cuda() -> Iterator[None]:
    cuda = _torch().cuda
    own = cuda.get_device_capability
    cuda.get_device_capability = lambda device=None: max(capabilities("cuda"), default=(0, 0))
    try:
        yield
    finally:
        cuda.get_device_capability = own


def capabilities(device: str) -> list[tuple[int, int]]:
    """Return the compute capabilities of the GPUs that `cuda` or `cuda:N` may mean, without
    initializing CUDA; none where NVML does not tell."""
    import pynvml

    try:
        pynvml.nvmlInit()
        try:
            return [
                tuple(pynvml.nvmlDeviceGetCudaComputeCapability(handle))
                for handle in visible(device, os.environ, pynvml)
            ]
        finally:
            pynvml.nvmlShutdown()
    except pynvml.NVMLError:
        return []


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
    needed = max(
        _MIN_CAPABILITY.get(dtype, (0, 0))
        for dtype in ([asked] if nf4 is None else [asked, nf4.compute_dtype])
    )
    if found and max(found) < needed:
        has, needs = (".".join(map(str, version)) for version in (max(found), needed))
        computed = "" if nf4 is None else f" computed in {nf4.compute_dtype.value}"
        raise UnsupportedQuantization(
            f"{manifest.name}: quantization.dtype {asked.value!r}{computed} needs compute "
            f"capability {needs}, and {device} has {has}",
            hint="write compute_dtype: float16 in quantization.extra"
            if nf4 is not None and nf4.compute_dtype is Dtype.BF16
            else "write dtype: fp16"
            if asked is Dtype.BF16
            else "write dtype: fp32",
            details={"dtype": asked.value, "needs": needs, "has": has},
        )
