"""Number formats: what a manifest may ask for, and NF4 in host RAM."""

from typing import Any

import pytest

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.schemas.errors import CODES, ConfigError, UnsupportedQuantization
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.contracts import Quantization
from vram_arbiter.schemas.manifest.load import load_manifest
from vram_arbiter.sidecars import quantization
from vram_arbiter.sidecars.quantization import Nf4, check_precision, nf4_of, quantize_linear

FIELD = {
    "scheme": "nf4",
    "quantizer": "bitsandbytes",
    "compute_dtype": "bfloat16",
    "min_params_to_quantize": 4_000_000,
    "loader": "transformers.AutoModelForImageTextToText",
}


def manifest(dtype: str, **fields: Any) -> RSkillManifest:
    found = load_manifest(configs_folder({}) / "rskills/so101-grab/rskill.yaml")
    asked = Quantization.model_validate({"dtype": dtype, **fields})
    return found.model_copy(update={"quantization": asked})


def int4(**extra: Any) -> RSkillManifest:
    return manifest("int4", extra={"min_params_to_quantize": 0, **extra})


def test_what_the_field_writes_about_nf4_is_read() -> None:
    assert nf4_of(manifest("int4", extra=FIELD)) == Nf4(min_params=4_000_000)
    assert nf4_of(manifest("int4")) == Nf4()
    assert nf4_of(manifest("bf16")) is None
    assert nf4_of(int4(skip_modules=["visual"], compute_dtype="float16")) == Nf4(
        quantization.Dtype.FP16, ("visual",), 0
    )


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        ({"skip_modules": "lm_head"}, "a list of module names"),
        ({"min_params_to_quantize": "4M"}, "a number of weights"),
        ({"compute_dtype": "int8"}, "one of float32, float16, bfloat16"),
        ({"scheme": "fp4"}, "write nf4"),
        ({"group_size": 128}, "group_size, which no loader honors"),
    ],
)
def test_what_cannot_be_honored_is_refused(extra: dict[str, Any], told: str) -> None:
    """A bare text as skip_modules was taken apart into its letters; unknown keys were ignored."""
    for dtype in ("int4", "bf16"):
        with pytest.raises(ConfigError, match=told):
            nf4_of(manifest(dtype, extra=extra))


@pytest.mark.parametrize("dtype", ["int8", "fp8", "fp4_nvfp4"])
def test_a_number_format_that_is_not_served_is_refused_on_every_device(dtype: str) -> None:
    """Regression: such a model ran in bf16 on a GPU and in float32 on the CPU."""
    for device in ("cpu", "cuda:0", "none"):
        with pytest.raises(UnsupportedQuantization, match="supported: fp32, fp16, bf16, int4") as e:
            check_precision(manifest(dtype), device)
    assert e.value.details["dtype"] == dtype
    assert CODES["unsupported_quantization"] is UnsupportedQuantization


def test_int4_without_bitsandbytes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quantization.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UnsupportedQuantization, match="needs bitsandbytes"):
        nf4_of(int4())
    assert nf4_of(manifest("fp16")) is None


@pytest.mark.heavy
class TestQuantizedLinear:
    @pytest.fixture
    def model(self) -> Any:
        import torch
        from torch import nn

        torch.manual_seed(0)

        class Model(nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.embed = nn.Embedding(64, 128)
                self.visual = nn.ModuleDict({"proj": nn.Linear(128, 128)})
                self.attention = nn.MultiheadAttention(128, 2)
                self.layers = nn.ModuleList([nn.Linear(128, 256), nn.Linear(256, 128)])
                self.narrow = nn.Linear(128, 6)
                self.lm_head = nn.Linear(128, 64, bias=False)
                self.head_of_embed = nn.Linear(128, 64, bias=False)
                self.head_of_embed.weight = self.embed.weight

            def forward(self, tokens: Any) -> Any:
                # policies ask a layer for its type: packed bytes must not answer uint8
                x = self.embed(tokens).to(self.layers[0].weight.dtype)
                x = self.layers[1](self.layers[0](x).relu())
                return self.narrow(x + self.attention(x, x, x)[0])

        return Model().eval().requires_grad_(False)

    def test_near_the_original_in_about_a_quarter_of_fp16(self, model: Any) -> None:
        import torch
        from bitsandbytes.nn import Linear4bit

        tokens = torch.arange(10)[None]
        with torch.inference_mode():
            wanted = model(tokens)
            quantize_linear(model, int4(compute_dtype="float32"))
            found = model(tokens)
        quantized = {name for name, part in model.named_modules() if isinstance(part, Linear4bit)}
        assert quantized == {"layers.0", "layers.1", "narrow"}
        assert model.head_of_embed.weight is model.embed.weight
        assert model.layers[0].weight.dtype == torch.float32
        error = torch.linalg.vector_norm(found - wanted) / torch.linalg.vector_norm(wanted)
        assert 0.001 < error < 0.2
        layer = model.layers[0]
        state = layer.weight.quant_state
        size = layer.weight.nbytes + state.absmax.nbytes
        assert 0.25 <= size / (256 * 128 * 2) < 0.29

    def test_skipped_modules_and_small_layers_stay(self, model: Any) -> None:
        from bitsandbytes.nn import Linear4bit

        skipped = ["layers.1", "lm_head"]
        quantize_linear(model, int4(skip_modules=skipped, min_params_to_quantize=128 * 100))
        quantized = {name for name, part in model.named_modules() if isinstance(part, Linear4bit)}
        assert quantized == {"visual.proj", "layers.0"}

    def test_a_skip_list_that_matches_nothing_is_refused(self, model: Any) -> None:
        """Regression: `visual` matched none of transformers' names, and all was quantized."""
        with pytest.raises(ConfigError, match="'vision_tower', and Model has no such module"):
            quantize_linear(model, int4(skip_modules=["vision_tower"]))
        with pytest.raises(UnsupportedQuantization, match="no linear layer to quantize"):
            quantize_linear(model, manifest("int4"))
        quantize_linear(model, manifest("fp32"))
        assert type(model.layers[0]).__name__ == "Linear"
