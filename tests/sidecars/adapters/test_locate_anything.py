"""A grounding model that brings its own code, with the interface of LocateAnything."""

import io
import json
import shutil
import sys
import textwrap

import pytest

from tests.sidecars.adapters.tiny_vision import chat_tokenizer
from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.detector import DetectorAdapter
from vram_arbiter.sidecars.adapters.locate_anything import LocateAnythingAdapter
from vram_arbiter.sidecars.weights import Weights, resolve

COMMIT = "7a81d810571dc5f244b2f0b6868128f24b1cbd85"
# the field's own block
QUANTIZATION = (
    "quantization: {{dtype: {dtype}, backend: pytorch, "
    "extra: {{{extra}loader: transformers.AutoModel, trust_remote_code: {consent}}}}}\n"
)
BLOCK = "actions: [detect]\ndetector: {labels: [cube], mode: on_demand, max_side: 512}\n"

MODELING = '''
import torch
from transformers import PreTrainedConfig, PreTrainedModel


class TinyLocatorConfig(PreTrainedConfig):
    model_type = "tiny_locator"


class TinyLocator(PreTrainedModel):
    """Finds what is red, and nothing else."""

    config_class = TinyLocatorConfig

    def __init__(self, config):
        super().__init__(config)
        self.red = torch.nn.Conv2d(3, 1, 1)
        self.gain = torch.nn.Linear(64, 64, bias=False)
        self.post_init()

    def generate(self, pixel_values, input_ids, attention_mask, tokenizer, max_new_tokens,
                 use_cache, generation_mode, do_sample, temperature, repetition_penalty):
        assert not do_sample and temperature == 0.0 and generation_mode == "hybrid"
        red = self.red(pixel_values)[0, 0] * self.gain(pixel_values.new_ones(1, 64)).mean()
        question = tokenizer.decode(input_ids[0])
        answer = ""
        for label in question.partition(": ")[2].rstrip(".").split("</c>"):
            y, x = (red > 0).nonzero(as_tuple=True)
            height, width = pixel_values.shape[-2:]
            if not label.startswith("red") or not len(x):
                answer += f"<ref>{label}</ref><box>None</box>"
                continue
            corners = (x.min() / width, y.min() / height,
                       (x.max() + 1) / width, (y.max() + 1) / height)
            box = "".join(f"<{round(1000 * float(corner))}>" for corner in corners)
            answer += f"<ref>{label}</ref><box>{box}</box><box>{box}</box>"
        return answer[:max_new_tokens], {"tokens": 1}
'''
PROCESSING = """
import numpy as np
import torch
from transformers import BatchFeature, ProcessorMixin


class TinyLocatorProcessor(ProcessorMixin):
    def __init__(self, tokenizer=None, **options):
        super().__init__(tokenizer)

    def py_apply_chat_template(self, messages, tokenize, add_generation_prompt):
        return messages[0]["content"][1]["text"]

    def process_vision_info(self, messages):
        return [messages[0]["content"][0]["image"]], None

    def __call__(self, text, images, videos, return_tensors):
        pixels = torch.from_numpy(np.array(images[0])).permute(2, 0, 1)[None] / 255
        return BatchFeature({**self.tokenizer(text, return_tensors="pt"), "pixel_values": pixels})
"""


@pytest.fixture(scope="module")
def code_cache(tmp_path_factory):
    """transformers copies a checkpoint's code into a cache; this one is the test's."""
    from transformers import dynamic_module_utils

    folder = tmp_path_factory.mktemp("modules")
    patch = pytest.MonkeyPatch()
    patch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(folder))
    patch.setattr(sys, "path", list(sys.path))
    yield folder
    patch.undo()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, code_cache):
    """The checkpoint: weights by `save_pretrained`, and its code beside them."""
    from transformers.dynamic_module_utils import get_class_from_dynamic_module

    folder = tmp_path_factory.mktemp("models") / "tiny_locator"
    folder.mkdir()
    (folder / "modeling_tiny.py").write_text(textwrap.dedent(MODELING))
    (folder / "processing_tiny.py").write_text(textwrap.dedent(PROCESSING))
    chat_tokenizer(["<|endoftext|>", "<|im_start|>", "<|im_end|>"]).save_pretrained(folder)
    cls = get_class_from_dynamic_module("modeling_tiny.TinyLocator", str(folder))
    auto = {
        "AutoConfig": "modeling_tiny.TinyLocatorConfig",
        "AutoModel": "modeling_tiny.TinyLocator",
    }
    model = cls(cls.config_class(auto_map=auto))
    model.red.weight.data.copy_(model.red.weight.new_tensor([1.0, -1.0, -1.0])[None, :, None, None])
    model.gain.weight.data.fill_(1 / 64)
    model.red.bias.data.fill_(-0.25)
    model.save_pretrained(folder)
    processor = {"auto_map": {"AutoProcessor": "processing_tiny.TinyLocatorProcessor"}}
    (folder / "processor_config.json").write_text(json.dumps(processor))
    return folder


@pytest.fixture
def described(manifest):
    def described(consent="true", dtype="bf16", uri="local://models/x"):
        extra = "scheme: nf4, min_params_to_quantize: 4096, " if dtype == "int4" else ""
        text = BLOCK + QUANTIZATION.format(consent=consent, dtype=dtype, extra=extra)
        return manifest("detector", text).model_copy(update={"weights_uri": uri})

    return described


def red_at(box, size=(80, 60)):
    from PIL import Image

    picture, stream = Image.new("RGB", size, (40, 60, 60)), io.BytesIO()
    picture.paste((220, 30, 30), box)
    picture.save(stream, "PNG")
    return stream.getvalue()


@pytest.mark.heavy
@pytest.mark.parametrize("dtype", ["bf16", "int4"])
def test_it_runs_the_checkpoints_own_code(dtype, folder, described):
    adapter = make_adapter(described(dtype=dtype), Weights(str(folder), local=True))
    assert isinstance(adapter, LocateAnythingAdapter)
    adapter.prepare()
    adapter.load("meta")  # as --check does
    adapter.load("cpu")
    adapter.place("cpu")
    call = DetectOp(op="detect", image=red_at((20, 30, 40, 50)), query="red cube . ball")
    reply = adapter.run(call)
    assert reply == adapter.run(call)
    (one,) = reply["detections"]
    assert (one["label"], one["score"]) == ("red cube", 1.0)
    assert one["box"] == pytest.approx([20, 30, 40, 50], abs=0.1)
    assert reply["answer"].endswith("<ref>ball</ref><box>None</box>")
    absent = adapter.run(call.model_copy(update={"query": "ball"}))
    assert (absent["ok"], absent["detections"]) == (True, [])
    with pytest.raises(BadRequest, match="own tokens"):
        adapter.run(call.model_copy(update={"query": "<image-1>"}))


@pytest.mark.heavy
def test_a_quantized_checkpoint_with_own_code_is_loaded_as_it_is(folder, described, tmp_path):
    """The field ships this model in NF4."""
    from vram_arbiter.sidecars.quantization import nf4_layers

    def loaded(place, device="cpu"):
        adapter = make_adapter(described(dtype="int4"), Weights(str(place), local=True))
        adapter.prepare()
        adapter.load(device)
        return adapter.networks[0]

    model, packed = loaded(folder), tmp_path / "packed"
    shutil.copytree(folder, packed)
    model.save_pretrained(packed)
    assert loaded(packed, "meta").device.type == "meta"
    again = nf4_layers(loaded(packed))
    assert again.keys() == nf4_layers(model).keys()
    assert all(again[name].weight.equal(nf4_layers(model)[name].weight) for name in again)


@pytest.mark.heavy
def test_an_incomplete_checkpoint_with_own_code_is_refused(folder, described, tmp_path):
    import shutil

    from safetensors.torch import save_file

    broken = tmp_path / "broken_locator"
    shutil.copytree(folder, broken)
    save_file({}, broken / "model.safetensors", metadata={"format": "pt"})
    adapter = make_adapter(described(), Weights(str(broken), local=True))
    with pytest.raises(ModelError, match="does not hold this model"):
        adapter.load("cpu")


@pytest.mark.parametrize("consent", ["false", '"yes"'])
def test_code_runs_by_the_manifests_consent_alone(consent, described, tmp_path):
    with pytest.raises(ConfigError, match="trust_remote_code: true"):
        make_adapter(described(consent), Weights(str(tmp_path), local=True))


@pytest.mark.parametrize("revision", ["", "@main", "@v1.0", f"@{COMMIT[:8]}"])
def test_code_of_the_hub_takes_one_commit(revision, described, tmp_path):
    uri = "hf://OpenRAL/rskill-locateanything-3b-nf4"
    with pytest.raises(ConfigError, match=f"write weights_uri: {uri}@COMMIT"):
        make_adapter(described(uri=uri + revision), resolve(uri + revision, tmp_path))
    pinned = f"{uri}@{COMMIT}"
    make_adapter(described(uri=pinned), resolve(pinned, tmp_path))


@pytest.mark.heavy
def test_code_of_another_repository_is_refused(folder, described, tmp_path):
    named = {"auto_map": {"AutoModel": "someone/else--modeling_tiny.TinyLocator"}}
    (tmp_path / "config.json").write_text(json.dumps(named))
    adapter = make_adapter(described(), Weights(str(tmp_path), local=True))
    with pytest.raises(ConfigError, match="someone/else--modeling_tiny"):
        adapter.prepare()


@pytest.mark.heavy
def test_no_other_adapter_runs_code_or_asks_for_it(folder, described, monkeypatch):
    """transformers asks at the terminal unless it is told, and an operator's `y` would have run
    the code."""
    monkeypatch.setattr("builtins.input", lambda _: "y")
    before = set(sys.modules)
    adapter = DetectorAdapter(described("false"), Weights(str(folder), local=True))
    with pytest.raises(ModelError, match="cannot load"):
        adapter.prepare()
    assert not [name for name in set(sys.modules) - before if "processing_tiny" in name]


def test_a_loader_that_is_not_served_is_named(manifest, tmp_path):
    text = BLOCK + "quantization: {extra: {loader: vllm}}\n"
    with pytest.raises(ConfigError, match="'vllm' is not served"):
        make_adapter(manifest("detector", text), Weights(str(tmp_path), local=True))
