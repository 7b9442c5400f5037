"""Number formats: what a manifest may ask for, and NF4 in host RAM."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.adapters import tiny_vision
from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.schemas.errors import CODES, ConfigError, UnsupportedQuantization
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.contracts import Quantization
from vram_arbiter.schemas.manifest.load import load_manifest
from vram_arbiter.sidecars import quantization
from vram_arbiter.sidecars.checkpoints import load_transformers
from vram_arbiter.sidecars.host_weights import HostWeights
from vram_arbiter.sidecars.quantization import (
    Nf4,
    check_precision,
    check_weights,
    nf4_layers,
    nf4_of,
    quantize_linear,
)
from vram_arbiter.sidecars.weights import Weights, model_options

pytestmark = pytest.mark.heavy

FIELD = {
    "scheme": "nf4",
    "quantizer": "bitsandbytes",
    "compute_dtype": "bfloat16",
    "min_params_to_quantize": 4_000_000,
    "loader": "transformers.AutoModelForImageTextToText",
}


def grab_manifest(dtype: str, **fields: Any) -> RSkillManifest:
    found = load_manifest(configs_folder({}) / "rskills/so101-grab/rskill.yaml")
    asked = Quantization.model_validate({"dtype": dtype, **fields})
    return found.model_copy(update={"quantization": asked})


def int4(**extra: Any) -> RSkillManifest:
    return grab_manifest("int4", extra={"min_params_to_quantize": 0, **extra})


def test_what_the_field_writes_about_nf4_is_read() -> None:
    assert nf4_of(grab_manifest("int4", extra=FIELD)) == Nf4(min_params_to_quantize=4_000_000)
    assert nf4_of(grab_manifest("int4")) == Nf4()
    assert nf4_of(grab_manifest("bf16")) is None
    assert nf4_of(int4(skip_modules=["visual"], compute_dtype="float16")) == Nf4(
        compute_dtype="float16", skip_modules=("visual",), min_params_to_quantize=0
    )


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        ({"skip_modules": "lm_head"}, "skip_modules: must be a list, not 'lm_head'"),
        (
            {"min_params_to_quantize": "4M"},
            "min_params_to_quantize: must be a valid integer, not '4M'",
        ),
        ({"min_params_to_quantize": True}, "must be a valid integer, not True"),
        ({"compute_dtype": "int8"}, "one of 'float32', 'float16' or 'bfloat16'"),
        ({"scheme": "fp4"}, "scheme: 'fp4' is not one of 'nf4'"),
        ({"group_size": 128}, "group_size: unknown key"),
    ],
)
def test_what_cannot_be_honored_is_refused(extra: dict[str, Any], told: str) -> None:
    """A bare text as skip_modules was taken apart into its letters; unknown keys were ignored."""
    for dtype in ("int4", "bf16"):
        with pytest.raises(ConfigError, match=told):
            nf4_of(grab_manifest(dtype, extra=extra))


@pytest.mark.parametrize("dtype", ["int8", "fp8", "fp4_nvfp4"])
def test_a_number_format_that_is_not_served_is_refused_on_every_device(dtype: str) -> None:
    """Regression: such a model ran in bf16 on a GPU and in float32 on the CPU."""
    for device in ("cpu", "cuda:0", "none"):
        with pytest.raises(UnsupportedQuantization, match="supported: fp32, fp16, bf16, int4") as e:
            check_precision(grab_manifest(dtype), device)
    assert e.value.details["dtype"] == dtype
    assert CODES["unsupported_quantization"] is UnsupportedQuantization


def test_int4_without_bitsandbytes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quantization.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UnsupportedQuantization, match="needs bitsandbytes"):
        nf4_of(int4())
    assert nf4_of(grab_manifest("fp16")) is None


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
                self.block = nn.TransformerEncoderLayer(128, 2, 128, batch_first=True)
                self.layers = nn.ModuleList([nn.Linear(128, 256), nn.Linear(256, 128)])
                self.narrow = nn.Linear(128, 6)
                self.lm_head = nn.Linear(128, 64, bias=False)
                self.head_of_embed = nn.Linear(128, 64, bias=False)
                self.head_of_embed.weight = self.embed.weight

            def forward(self, tokens: Any) -> Any:
                # policies ask a layer for its type: packed bytes must not answer uint8
                x = self.embed(tokens).to(self.layers[0].weight.dtype)
                x = self.layers[1](self.layers[0](x).relu())
                return self.narrow(self.block(x + self.attention(x, x, x)[0]))

        return Model().eval().requires_grad_(False)

    def test_near_the_original_in_about_a_quarter_of_fp16(self, model: Any) -> None:
        import torch
        from bitsandbytes.nn import Linear4bit

        tokens = torch.arange(10)[None]
        with torch.inference_mode():
            wanted = model(tokens)
            quantize_linear(model, int4(compute_dtype="float32"))
            found = model(tokens)
            HostWeights([model], "test")
            assert model(tokens).equal(found)
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

    def test_a_model_that_loads_itself_in_another_number_format_is_refused(
        self, model: Any
    ) -> None:
        """Regression: a reward model ran in its code's number format, whatever its manifest."""
        check_weights(model, grab_manifest("fp32"))
        with pytest.raises(UnsupportedQuantization, match=r"weights in fp32 \(write dtype: fp32"):
            check_weights(model, grab_manifest("bf16"))
        model.bfloat16()
        model.embed.float()
        check_weights(model, grab_manifest("bf16"))

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
            quantize_linear(model, grab_manifest("int4"))
        quantize_linear(model, grab_manifest("fp32"))
        assert type(model.layers[0]).__name__ == "Linear"


@pytest.mark.parametrize(
    ("dtype", "extra", "needs"),
    [
        ("bf16", {}, (8, 0)),
        ("fp16", {}, (5, 3)),
        ("int4", {}, (8, 0)),
        ("int4", {"compute_dtype": "float16"}, (6, 0)),
    ],
)
def test_a_gpu_without_the_number_format_is_refused(
    monkeypatch: pytest.MonkeyPatch, dtype: str, extra: dict[str, Any], needs: tuple[int, int]
) -> None:
    """Regression: torch emulates bf16 on such a GPU, many times slower."""
    asked = grab_manifest(dtype, extra=extra)
    has = [(5, 2)]
    monkeypatch.setattr(quantization, "capabilities", lambda device: has)
    for device in ("cuda", "cuda:1"):
        with pytest.raises(UnsupportedQuantization, match=f"capability {needs[0]}.{needs[1]}"):
            check_precision(asked, device)
    check_precision(asked, "cpu")
    check_precision(grab_manifest("fp32"), "cuda")
    has.append(needs)
    check_precision(asked, "cuda")


CUDA_ASKED = """
import torch

torch.cuda.is_available, torch.cuda.device_count = (lambda: True), (lambda: 1)
asked = []
torch.cuda.get_device_capability = lambda device=None: asked.append(device) or (8, 0)
from vram_arbiter.sidecars.quantization import load_bitsandbytes
bnb = load_bitsandbytes()
assert not asked, "its import would initialize CUDA"
assert torch.cuda.get_device_capability() == (8, 0)
assert type(bnb.cextension.lib).__name__ == "CudaBNBNativeLibrary"
assert bnb.cuda_ops
"""


@pytest.mark.nightly  # it imports torch once more, in a fresh interpreter
def test_bitsandbytes_is_imported_without_initializing_cuda() -> None:
    """Its import asks torch for the GPUs' capabilities, which initializes CUDA: no process forked
    from this one could use a GPU."""
    torch = pytest.importorskip("torch")
    if torch.version.cuda is None:
        pytest.skip("this build of torch has no CUDA libraries")
    subprocess.run([sys.executable, "-c", CUDA_ASKED], check=True, timeout=120)


def small_vlm(name: str) -> Any:
    import torch
    import transformers

    torch.manual_seed(0)
    text = {
        "vocab_size": 64, "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2,
        "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 32,
        "rope_scaling": {"rope_type": "default", "mrope_section": [6, 5, 5]},
    }  # fmt: skip
    vision = {"depth": 1, "hidden_size": 64, "intermediate_size": 128, "num_heads": 2,
              "patch_size": 8, "out_hidden_size": 64}  # fmt: skip
    config = getattr(transformers, f"{name}Config")(text_config=text, vision_config=vision)
    return getattr(transformers, f"{name}ForConditionalGeneration")(config)


@pytest.fixture(scope="module", params=["Qwen3VL", "Qwen2_5_VL"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: Any) -> Path:
    place: Path = tmp_path_factory.mktemp(request.param)
    small_vlm(request.param).save_pretrained(place)
    return place


def test_transformers_skips_all_but_the_chosen_layers() -> None:
    """transformers takes `layers.1` as the beginning of `layers.10`, too."""
    quantizers = pytest.importorskip("transformers.quantizers.quantizers_utils")
    names = ["", "layers", "layers.1.fc", "layers.10.fc", "layers.1.fcs", "model.layers.1.fc", "fc"]
    patterns = quantization.all_but(["layers.1.fc", "fc"])
    assert [name for name in names if quantizers.should_convert_module(name, patterns)] == [
        "layers.1.fc",
        "fc",
    ]


class TestTransformers:
    def load(self, folder: Path, device: str = "cpu", **extra: Any) -> Any:
        from transformers import AutoModelForImageTextToText

        weights = Weights(str(folder), local=True)
        options = model_options(int4(**extra), weights, device)
        return load_transformers(AutoModelForImageTextToText, weights, **options)

    def logits(self, model: Any) -> Any:
        import torch

        with torch.inference_mode():
            return model(input_ids=torch.arange(12)[None]).logits

    def test_the_skip_list_names_transformers_modules(self, folder: Path) -> None:
        """Regression: `model.visual…` was quantized although `visual` was in the skip list."""
        text = "model.language_model.layers."
        quantized = nf4_layers(self.load(folder))
        assert len(quantized) == 2 * 7
        assert all(name.startswith(text) for name in quantized)
        quantized = nf4_layers(self.load(folder, skip_modules=["lm_head", "visual", "layers.1"]))
        assert len(quantized) == 7
        assert all(name.startswith(f"{text}0.") for name in quantized)
        everything = nf4_layers(self.load(folder, skip_modules=[]))
        assert any(name.startswith("model.visual") for name in everything)
        assert "lm_head" in everything
        quantized = nf4_layers(self.load(folder, min_params_to_quantize=64 * 128))
        assert {name.rpartition(".")[2] for name in quantized} == {
            "gate_proj",
            "up_proj",
            "down_proj",
        }
        with pytest.raises(ConfigError, match="no such module"):
            self.load(folder, "meta", skip_modules=["vision_tower"])

    @pytest.mark.parametrize("save", [tiny_vision.save_smolvlm, tiny_vision.save_llava_onevision])
    def test_a_vision_tower_of_any_name_stays(self, tmp_path: Path, save: Any) -> None:
        """Regression: SmolVLM's is called `vision_model`, which the default did not name."""
        save(tmp_path)
        quantized = nf4_layers(self.load(tmp_path))
        assert any("language_model" in name or "text_model" in name for name in quantized)
        assert not any("vision" in name for name in quantized)
        everything = nf4_layers(self.load(tmp_path, skip_modules=[]))
        assert any("vision" in name for name in everything)

    def test_the_manifests_compute_dtype_is_that_of_the_whole_model(self, folder: Path) -> None:
        import torch

        for name in ("float16", "bfloat16"):
            model = self.load(folder, compute_dtype=name)
            wanted = getattr(torch, name)
            assert {layer.compute_dtype for layer in nf4_layers(model).values()} == {wanted}
            kept = {tensor.dtype for tensor in model.parameters() if tensor.is_floating_point()}
            assert kept == {wanted}

    def test_a_quantized_checkpoint_is_loaded_as_it_is(self, folder: Path, tmp_path: Path) -> None:
        """What transformers 4 saved with the skip list `visual` holds a vision tower that
        transformers 5 takes as quantized, and casts to uint8."""
        model = self.load(folder)
        model.config.quantization_config.llm_int8_skip_modules = ["visual", "lm_head"]
        model.save_pretrained(tmp_path)
        again = self.load(tmp_path, min_params_to_quantize=10**9)
        assert nf4_layers(again).keys() == nf4_layers(model).keys()
        for name, layer in nf4_layers(again).items():
            assert layer.weight.equal(nf4_layers(model)[name].weight)
        assert self.logits(again).equal(self.logits(model))
        checked = self.load(tmp_path, "meta")
        assert {tensor.device.type for tensor in checked.parameters()} == {"meta"}

    def test_answers_are_the_same_after_the_weights_were_moved(self, folder: Path) -> None:
        """The keeper moves weights into shared memory, a residency copies and places them."""
        model = self.load(folder)
        wanted = self.logits(model)
        layer = next(iter(nf4_layers(model).values()))
        before = layer.weight.data_ptr()
        weights = HostWeights([model], "test")
        assert weights.size_bytes >= sum(tensor.nbytes for tensor in model.parameters())
        shared = layer.weight.data_ptr()
        assert shared != before, "the first answer must not have repacked it either"
        assert self.logits(model).equal(wanted)
        assert layer.weight.data_ptr() == shared, "an answer leaves the weights shared"
        weights.own()
        assert self.logits(model.to("cpu")).equal(wanted)
