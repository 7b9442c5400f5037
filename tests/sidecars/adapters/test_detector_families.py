"""Detectors of every family, saved by the family's own code and loaded as in production, in each
precision."""

import json
import math

import pytest

from tests.sidecars.adapters import tiny_vision
from tests.sidecars.adapters.conftest import placed
from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.detector import DetectorAdapter
from vram_arbiter.sidecars.weights import Weights

pytestmark = pytest.mark.heavy

BLOCK = "actions: [detect]\ndetector: {labels: [cube], score_threshold: 0.0}\n"
LABELS = ["red cube", "ball"]
WIDTH, HEIGHT = 80, 60


@pytest.fixture
def loaded(saved, manifest):
    """Loads a family's checkpoint in the manifest's precision."""

    def loaded(family, dtype="fp32", save=None):
        described = manifest("detector", BLOCK + f"quantization: {{dtype: {dtype}}}\n")
        weights = saved(family, save or tiny_vision.DETECTORS[family])
        return placed(DetectorAdapter(described, weights))

    return loaded


def detect(adapter, picture):
    reply = adapter.run(DetectOp(op="detect", image=picture, query=LABELS))
    for one in reply["detections"]:
        assert one["label"] in LABELS
        assert 0 < one["score"] <= 1
        x0, y0, x1, y1 = one["box"]
        assert 0 <= x0 < x1 <= WIDTH
        assert 0 <= y0 < y1 <= HEIGHT
    return reply["detections"]


@pytest.mark.parametrize("dtype", ["fp32", "bf16", "fp16"])
@pytest.mark.parametrize("family", tiny_vision.DETECTORS)
def test_each_family_detects_in_each_precision(family, dtype, loaded, manifest, png):
    """Grounding DINO raised in 16 bits: its inputs and its own tables are float32."""
    adapter = loaded(family, dtype)
    kept = {"fp32": "torch.float32", "bf16": "torch.bfloat16", "fp16": "torch.float16"}[dtype]
    (network,) = adapter.networks
    assert {str(one.dtype) for one in network.parameters()} == {kept}
    found = detect(adapter, png(WIDTH, HEIGHT))
    assert found
    assert all(math.isfinite(number) for one in found for number in (one["score"], *one["box"]))
    if dtype == "fp16":
        assert detect(adapter, png(WIDTH, HEIGHT)) == found, "deterministic"


def test_omdet_turbo_with_a_backbone_of_timm(loaded, manifest, png):
    pytest.importorskip("timm", reason="OmDet-Turbo's published backbone comes from timm")
    adapter = loaded("omdet_timm", "fp16", tiny_vision.save_omdet_turbo_timm)
    assert detect(adapter, png(WIDTH, HEIGHT))


def test_the_name_of_a_backbone_is_not_looked_up_on_the_hub(manifest, monkeypatch, tmp_path):
    """OmDet-Turbo's published config names timm's backbone in the old form. transformers asks the
    hub about the name at every load: a cached model could not be loaded without a network."""
    import huggingface_hub
    from transformers import backbone_utils

    tiny_vision.save_omdet_turbo(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text()) | {
        "backbone": "swin_tiny_patch4_window7_224",
        "backbone_config": None,
        "backbone_kwargs": {"out_indices": [1, 2, 3], "img_size": 640},
        "use_timm_backbone": True,
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    monkeypatch.setattr(backbone_utils, "repo_exists", huggingface_hub.repo_exists)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    adapter = DetectorAdapter(manifest("detector", BLOCK), Weights(str(tmp_path), local=True))
    adapter.prepare()


@pytest.mark.parametrize("family", ["owlvit", "grounding_dino"])
def test_numbers_that_overflow_are_not_nothing_found(family, loaded, manifest, png):
    """A score that is not a number is above no threshold: the answer was an empty list, which
    means that the object is not in view."""
    adapter = loaded(family)
    (network,) = adapter.networks
    for parameter in network.parameters():
        parameter.data.fill_(math.nan)
    with pytest.raises(ModelError, match="not a number"):
        detect(adapter, png(WIDTH, HEIGHT))


def test_grounding_dino_answers_with_whole_texts(loaded, manifest, png):
    """The library's reading joins the tokens above 0.25: half a text, or an empty one."""
    adapter = loaded("grounding_dino")
    tokens = adapter._processor(images=None, text=[LABELS])["input_ids"][0]
    spans = adapter._spans(tokens, LABELS)
    decode = adapter._processor.tokenizer.decode
    assert [decode(tokens[span]).replace(" ##", "") for span in spans] == [
        decode(adapter._processor.tokenizer(label, add_special_tokens=False)["input_ids"])
        for label in LABELS
    ]
    assert {one["label"] for one in detect(adapter, png(WIDTH, HEIGHT))} <= set(LABELS)


@pytest.mark.parametrize("family", ["owlvit", "grounding_dino"])
def test_a_query_that_would_be_cut_off_is_refused(family, loaded, manifest, png):
    """Objects beyond the model's tokens were dropped, and answered as not in view."""
    adapter = loaded(family)
    query = ["a small red cube with rounded edges", "a green ball on the left"]
    query.append("a mug without a handle")
    with pytest.raises(BadRequest, match="tokens; this model reads"):
        adapter.run(DetectOp(op="detect", image=png(WIDTH, HEIGHT), query=query))
