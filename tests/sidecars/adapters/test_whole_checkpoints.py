"""A checkpoint that does not hold all of its model is refused before the first answer.

Regression: an ACT without its decoder and action head answered actions, an OWLv2 without its heads
answered detections, and lerobot's pi0.5 loader returned a model of random numbers for a folder
without weights. A robot moves on these answers.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.adapters import policies, tiny_vision
from tests.support.paths import CONFIGS
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.manifest.contracts import Quantization
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.sidecars.checkpoints import load_lerobot, load_transformers
from vram_arbiter.sidecars.quantization import Nf4, nf4_layers, quantize_linear
from vram_arbiter.sidecars.weights import Weights, read_config

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("small_networks")]

DEVICES = ("cpu", "meta")  # a load, and `vram-sidecar --check`
WHOLE = "model.safetensors"


def shipped_copy(name: str) -> Callable[[Path], None]:
    def copy(folder: Path) -> None:
        shutil.copytree(CONFIGS / "models" / name, folder, dirs_exist_ok=True)

    return copy


def load_detector(weights: Weights, device: str) -> Any:
    from transformers import AutoModelForZeroShotObjectDetection

    return load_transformers(AutoModelForZeroShotObjectDetection, weights, device_map={"": device})


def load_vlm(weights: Weights, device: str) -> Any:
    from transformers import AutoModelForImageTextToText

    return load_transformers(AutoModelForImageTextToText, weights, device_map={"": device})


def load_vlm_nf4(weights: Weights, device: str) -> Any:
    """Quantize while loading."""
    from transformers import AutoModelForImageTextToText

    return load_transformers(
        AutoModelForImageTextToText,
        weights,
        device_map={"": device},
        nf4=Nf4(min_params_to_quantize=0),
    )


def load_detector_nf4(weights: Weights, device: str) -> Any:
    from transformers import AutoModelForZeroShotObjectDetection

    return load_transformers(
        AutoModelForZeroShotObjectDetection, weights, device_map={"": device}, nf4=Nf4()
    )


def load_policy(weights: Weights, device: str) -> Any:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    import vram_arbiter.sidecars.models.compact_act  # noqa: F401  registers itself

    config = read_config(PreTrainedConfig, weights)
    config.device = device
    config.pretrained_backbone_weights = None  # no network here
    return load_lerobot(get_policy_class(config.type), weights, config)


def load_reward(weights: Weights, device: str) -> Any:
    from lerobot.configs.rewards import RewardModelConfig
    from lerobot.rewards.factory import get_reward_model_class

    import vram_arbiter.sidecars.models.compact_progress  # noqa: F401  registers itself

    config = read_config(RewardModelConfig, weights)
    config.device = device
    return load_lerobot(get_reward_model_class(config.type), weights, config)


OTHERS: dict[str, Callable[[Path], None]] = {
    "act": policies.save_act,
    "owlv2": tiny_vision.save_owlv2,
    "grounding_dino": tiny_vision.save_grounding_dino,
    "compact_act": shipped_copy("so101-grab"),
    "compact_progress": shipped_copy("so101-progress"),
    "shipped vlm": shipped_copy("so101-scene-vlm"),
}
MODELS: dict[str, tuple[Callable[[Weights, str], Any],
str]] = {  # how it is loaded, and a part that it does not work without
    "act": (load_policy, "model.action_head"),
    "compact_act": (load_policy, "act."),
    "compact_progress": (load_reward, "judge"),
    "owlvit": (load_detector, "box_head"),
    "owlv2": (load_detector, "class_head"),
    "grounding_dino": (load_detector, "bbox_embed"),
    "qwen nf4": (load_vlm_nf4, "mlp.down_proj"),
    "shipped vlm": (load_vlm, "layers.0"),
}  # fmt: skip

BY_DAY = ("act", "compact_act", "owlvit", "qwen nf4")
"""One of each loader; `make nightly` damages the others' checkpoints, too."""


@pytest.fixture(scope="module")
def saved(weights: Any, tmp_path_factory: Any) -> Callable[[str], Path]:
    """A whole checkpoint's folder."""
    folder = tmp_path_factory.mktemp("whole")

    def saved(name: str) -> Path:
        if name not in OTHERS:
            return Path(weights(name.removesuffix(" nf4")).source)
        place: Path = folder / name
        if not place.exists():
            place.mkdir()
            OTHERS[name](place)
        return place

    return saved


def refusal_of(load: Callable[[Weights, str], Any], folder: Path, device: str) -> ModelError:
    with pytest.raises(ModelError) as caught:
        load(Weights(str(folder), local=True), device)
    return caught.value


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=() if one in BY_DAY else pytest.mark.nightly) for one in MODELS],
)
def test_only_a_whole_checkpoint_is_loaded(
    saved: Callable[[str], Path], tmp_path: Path, name: str, device: str
) -> None:
    """Regression: the libraries' loaders fill missing parameters with random numbers and go on."""
    import torch
    from safetensors.torch import load_file, save_file

    load, part = MODELS[name]
    whole = saved(name)
    model = load(Weights(str(whole), local=True), device)
    assert {tensor.device.type for tensor in model.parameters()} == {device}

    tensors = load_file(whole / WHOLE)
    folder = tmp_path / "damaged"
    shutil.copytree(whole, folder)

    def damaged(content: dict[str, Any]) -> ModelError:
        save_file(content, folder / WHOLE, metadata={"format": "pt"})
        return refusal_of(load, folder, device)

    without = {key: tensor for key, tensor in tensors.items() if part not in key}
    assert without.keys() < tensors.keys(), f"no {part} in {sorted(tensors)}"
    error = damaged(without)
    assert error.details["missing"] >= len(tensors) - len(without)
    assert "missing from it" in error.message
    assert part in error.message
    assert damaged({}).details["missing"] >= len(tensors)
    error = damaged(tensors | {"another.models.weight": torch.zeros(3)})
    assert (error.details["missing"], error.details["foreign"]) == (0, 1)
    assert "1 unknown to the model (another.models.weight)" in error.message
    key = next(key for key in tensors if part in key and tensors[key].ndim)
    error = damaged(tensors | {key: torch.zeros([side + 1 for side in tensors[key].shape])})
    assert (error.details["missing"], error.details["misshapen"]) == (0, 1)
    assert str(tuple(tensors[key].shape)) in error.message

    content = (whole / WHOLE).read_bytes()
    (folder / WHOLE).write_bytes(content[: len(content) // 2])
    refusal_of(load, folder, device)
    (folder / WHOLE).unlink()
    refusal_of(load, folder, device)


@pytest.mark.parametrize("device", DEVICES)
def test_a_checkpoint_in_parts_needs_all_of_them(tmp_path: Path, device: str) -> None:
    from transformers import Owlv2ForObjectDetection

    tiny_vision.save_owlv2(tmp_path / "one")
    model = Owlv2ForObjectDetection.from_pretrained(tmp_path / "one")
    model.save_pretrained(tmp_path / "parts", max_shard_size="40KB")
    parts = sorted((tmp_path / "parts").glob("model-*.safetensors"))
    assert len(parts) > 2
    load_detector(Weights(str(tmp_path / "parts"), local=True), device)
    parts[1].unlink()
    refusal_of(load_detector, tmp_path / "parts", device)


@pytest.mark.parametrize("device", DEVICES)
def test_a_quantized_checkpoint_is_compared_with_its_statistics(
    saved: Callable[[str], Path], tmp_path: Path, device: str
) -> None:
    """Regression: `--check` read the whole of such a checkpoint, transformers does not tell wrong
    shapes of quantized models, and a weight without any statistics was loaded as it was."""
    import torch
    from safetensors.torch import load_file, save_file
    from transformers import AutoModelForZeroShotObjectDetection, BitsAndBytesConfig

    nf4 = BitsAndBytesConfig(
        load_in_4bit=True, bnb_4bit_quant_type="nf4", bnb_4bit_use_double_quant=True
    )
    quantized = AutoModelForZeroShotObjectDetection.from_pretrained(
        saved("owlvit"), quantization_config=nf4, device_map={"": "cpu"}
    )
    quantized.save_pretrained(tmp_path)
    model = load_detector_nf4(Weights(str(tmp_path), local=True), device)
    assert {tensor.device.type for tensor in model.parameters()} == {device}
    tensors = load_file(tmp_path / WHOLE)
    names = [key.removesuffix(".absmax") for key in tensors if key.endswith(".weight.absmax")]
    weight = next(name for name in names if "vision_model" in name)
    statistics = [key for key in tensors if key.startswith(f"{weight}.")]
    assert len(statistics) == 5

    def damaged(content: dict[str, Any]) -> ModelError:
        save_file(content, tmp_path / WHOLE, metadata={"format": "pt"})
        return refusal_of(load_detector_nf4, tmp_path, device)

    def without(*dropped: str) -> dict[str, Any]:
        return {key: tensor for key, tensor in tensors.items() if key not in dropped}

    for one in (weight, f"{weight}.absmax", f"{weight}.nested_quant_map"):
        error = damaged(without(one))
        assert (error.details["missing"], error.details["foreign"]) == (1, 0), one
        assert f"1 missing from it ({one})" in error.message
    layer = [key for key in tensors if "text_model.encoder.layers.0" in key]
    parameters = [key for key in layer if key.endswith((".weight", ".bias"))]
    assert damaged(without(*layer)).details["missing"] == len(parameters) > 10
    error = damaged(without(*statistics))
    assert error.details["misshapen"] == 1
    assert weight in error.message
    error = damaged(tensors | {f"{weight}.absmax": torch.zeros(3, dtype=torch.uint8)})
    assert "absmax 3 bytes, not " in error.message
    assert damaged(tensors | {"another.weight": torch.zeros(3)}).details["foreign"] == 1
    bias = f"{weight.removesuffix('.weight')}.bias"
    assert damaged(tensors | {bias: torch.zeros(3)}).details["misshapen"] == 1
    content = (tmp_path / WHOLE).read_bytes()
    (tmp_path / WHOLE).write_bytes(content[: len(content) // 2])
    refusal_of(load_detector_nf4, tmp_path, device)


@pytest.mark.parametrize("device", DEVICES)
def test_a_quantized_policy_is_loaded_as_it_is(
    saved: Callable[[str], Path], tmp_path: Path, device: str
) -> None:
    """The field ships policies whose state dict bitsandbytes wrote."""
    import torch
    from bitsandbytes.functional import dequantize_4bit, quantize_4bit
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class
    from safetensors.torch import load_file, save_file

    nf4 = Nf4(min_params_to_quantize=0)
    shutil.copytree(saved("act"), tmp_path, dirs_exist_ok=True)
    weights = Weights(str(tmp_path), local=True)
    config = read_config(PreTrainedConfig, weights)
    config.device = device
    config.pretrained_backbone_weights = None  # no network here
    cls = get_policy_class(config.type)

    def load(nf4: Nf4 | None = nf4) -> Any:
        return load_lerobot(cls, weights, config, nf4)

    names = [f"{name}.weight" for name in nf4.chosen(load())]
    tensors = load_file(tmp_path / WHOLE)
    packed, values = dict(tensors), {}
    for name in names:
        packed[name], state = quantize_4bit(
            tensors[name], quant_type="nf4", compress_statistics=True
        )
        values[name] = dequantize_4bit(packed[name], state)
        packed |= {f"{name}.{key}": part for key, part in state.as_dict(packed=True).items()}
    file = tmp_path / WHOLE
    save_file(packed, file)
    assert "absmax" in refused_load(load, None).message, "the manifest has to say int4"
    model = load()
    assert {tensor.device.type for tensor in model.parameters()} == {device}
    if device == "cpu":
        model = model.to(torch.bfloat16)  # as an adapter does: packed bytes are no numbers
        skill = load_manifest(CONFIGS / "rskills/so101-grab/rskill.yaml")
        int4 = {"quantization": Quantization(dtype=Dtype.INT4)}
        quantize_linear(model, skill.model_copy(update=int4))
        layers = nf4_layers(model)
        assert {f"{name}.weight" for name in layers} == set(names)
        for name, layer in layers.items():
            assert layer.weight.dtype == layer.compute_dtype == torch.bfloat16
            found = dequantize_4bit(layer.weight.data, layer.weight.quant_state)
            assert found.equal(values[f"{name}.weight"])
        x = torch.randn(1, layer.in_features, dtype=torch.bfloat16)
        with torch.inference_mode():
            assert layer(x).isfinite().all()

    def damaged(content: dict[str, Any]) -> ModelError:
        save_file(content, file)
        return refused_load(load, nf4)

    name = names[0]
    error = damaged({key: part for key, part in packed.items() if key != f"{name}.absmax"})
    assert (error.details["missing"], error.details["misshapen"]) == (1, 0)
    error = damaged({key: part for key, part in packed.items() if not key.startswith(name)})
    assert f"1 missing from it ({name})" in error.message
    assert damaged(packed | {name: packed[name][1:]}).details["misshapen"] == 1


def refused_load(load: Callable[[Nf4 | None], Any], nf4: Nf4 | None) -> ModelError:
    with pytest.raises(ModelError) as caught:
        load(nf4)
    return caught.value


def test_a_loader_that_swallows_what_it_could_not_read_is_found_out(tmp_path: Path) -> None:
    """lerobot's pi0.5: without weights, or with those of another model, it prints a line and
    returns random numbers."""
    import torch
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from safetensors.torch import save_file

    PI05Config(**policies.features(policies.FRONT))._save_pretrained(tmp_path)
    assert "read no weights" in refusal_of(load_policy, tmp_path, "meta").message
    save_file({"another.models.weight": torch.zeros(3)}, tmp_path / WHOLE)
    error = refusal_of(load_policy, tmp_path, "meta")
    assert error.details["foreign"] == 1
    assert error.details["missing"] > 50


def test_check_compares_the_weights_and_ends_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: the libraries' loaders fill missing parameters with random numbers and go on."""
    from safetensors.torch import load_file, save_file

    from vram_arbiter.sidecars.__main__ import main

    for name in ("so101-grab", "so101-detector"):
        shutil.copytree(CONFIGS / "models" / name, tmp_path / "models" / name)
        flags = [
            "--name", "x", "--rskill", str(CONFIGS / f"rskills/{name}/rskill.yaml"), "--device",
            "none",
            "--configs", str(tmp_path), "--footprint", "1GB", "--check",
        ]  # fmt: skip
        assert main(flags) == 0
        out = capsys.readouterr().out
        assert re.search(r"^ok   weights +.* holds the whole model$", out, re.MULTILINE)
        assert {line[:4] for line in out.splitlines()} == {"ok  ", "    ", "ok"}, (
            "what the loaders print is not the answer"
        )
        file = tmp_path / "models" / name / WHOLE
        tensors = load_file(file)
        dropped = sorted(tensors)[:5]
        save_file(
            {key: tensors[key] for key in tensors if key not in dropped}, file, {"format": "pt"}
        )
        assert main(flags) == 2
        assert f"of the parameters 5 missing from it ({dropped[0]}" in capsys.readouterr().out
