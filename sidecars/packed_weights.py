"""Checkpoints with NF4 weights, as bitsandbytes writes them: packed bytes and their statistics.

Must not know which library loads the model.
"""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.sidecars.quantization import Nf4, linear4bit, load_bitsandbytes

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

_BLOB: Final = ".quant_state.bitsandbytes__nf4"  # JSON: shape, block size
_NESTED: Final = ("nested_absmax", "nested_quant_map")  # statistics of the statistics
_STATISTICS: Final = ("absmax", "quant_map", *_NESTED)
_CODES: Final = 16
_NESTED_CODES: Final = 256


@dataclass(slots=True)
class PackedHeader:
    """Names and shapes of a checkpoint with NF4 weights, as if it were not quantized.

    `tensors` are on `meta`; `quantized` are the names among them that the checkpoint holds packed.
    """

    tensors: "dict[str, Tensor]" = field(default_factory=dict)
    quantized: list[str] = field(default_factory=list)
    missing: set[str] = field(default_factory=set)
    misshapen: dict[str, str] = field(default_factory=dict)


def read_packed(files: Iterable[Path]) -> PackedHeader:
    """Return the header of safetensors files, of which only names and shapes are read, and of each
    packed weight the bytes that tell its shape. Raises what safetensors and JSON raise for a file
    that is not whole."""
    import torch
    from safetensors import safe_open
    from transformers.modeling_utils import str_to_torch_dtype

    tensors: dict[str, Tensor] = {}
    for path in files:
        with safe_open(path, "pt") as file:
            for name in file.keys():  # noqa: SIM118  not a mapping
                part = file.get_slice(name)
                dtype = str_to_torch_dtype[part.get_dtype()]
                tensors[name] = (
                    file.get_tensor(name)
                    if name.endswith(_BLOB)
                    else torch.empty(part.get_shape(), dtype=dtype, device="meta")
                )
    return packed_in(tensors)


def packed_in(state_dict: "Mapping[str, Tensor]") -> PackedHeader:
    """Return the header of a state dict."""
    import torch

    found = PackedHeader()
    states: dict[str, JsonMap] = {
        name.removesuffix(_BLOB): json.loads(bytes(blob.tolist()))
        for name, blob in state_dict.items()
        if name.endswith(_BLOB)
    }
    for name, tensor in state_dict.items():
        weight, _, last = name.rpartition(".")
        if last in _STATISTICS and (weight in state_dict or weight in states):
            if weight not in states:
                found.missing.add(weight + _BLOB)
        elif not name.endswith(_BLOB) and name not in states:
            found.tensors[name] = torch.empty(tensor.shape, device="meta")
    for weight, state in states.items():
        expected = _sizes_of(weight, state)
        found.missing |= expected.keys() - state_dict.keys() - {weight}
        for name in expected.keys() & state_dict.keys():
            if (size := state_dict[name].nbytes) != expected[name]:
                found.misshapen[name] = f"{size} bytes, not {expected[name]}"
        if weight in state_dict:
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


def install(
    model: "Module", state_dict: "Mapping[str, Tensor]", header: PackedHeader, nf4: Nf4
) -> "dict[str, Tensor]":
    """Put the packed weights of a state dict into the linear layers of a model, and return what
    the model's `load_state_dict` then takes.

    Their bytes stay integers: a model that is cast afterwards (`quantize_linear` comes last) leaves
    them alone. A model on `meta` stays without bytes. Raises: ModelError for a packed weight of
    anything but a linear layer.
    """
    import torch

    rest = {name: state_dict[name] for name in header.tensors}
    for weight in header.quantized:
        path = weight.removesuffix(".weight")
        linear = model.get_submodule(path)
        if type(linear) is not torch.nn.Linear:
            raise ModelError(
                f"{weight} is quantized, and {path} is no linear layer",
                hint="use the checkpoint before quantization",
            )
        if linear.weight.device.type == "meta":
            rest[weight] = header.tensors[weight]
            continue
        parameter = load_bitsandbytes().nn.Params4bit.from_prequantized(
            data=state_dict[weight].reshape(-1).view(torch.uint8).unsqueeze(1),
            quantized_stats={
                name: tensor for name, tensor in state_dict.items() if name.startswith(f"{weight}.")
            },
            device="cpu",
        )
        model.set_submodule(path, linear4bit(linear, parameter, nf4))
        rest[weight] = parameter.data
    return rest
