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
BY_DAY = ("owlvit", "grounding_dino")
"""`make nightly` plays the other families of each sweep, too."""


def swept(*families):
    night = pytest.mark.nightly
    return [pytest.param(one, marks=() if one in BY_DAY else night) for one in families]


@pytest.fixture
def load_detector(saved, manifest):
    """Loads a family's checkpoint in the manifest's precision."""

    def load_detector(family, dtype="fp32", save=None):
        described = manifest("detector", BLOCK + f"quantization: {{dtype: {dtype}}}\n")
        weights = saved(family, save or tiny_vision.DETECTORS[family])
        return placed(DetectorAdapter(described, weights))

    return load_detector


def test_grounding_dino_takes_texts_with_a_dot(load_detector, png):
    """Its processor joins texts by dots, and hands a list with a dot in it to the tokenizer as it
    is: a TypeError, told as the model's failure."""
    adapter, image = load_detector("grounding_dino"), png(WIDTH, HEIGHT)
    for query, labels in (
        ("1.5 l bottle", {"1.5 l bottle"}),
        (["1.5 l bottle", "Ball"], {"1.5 l bottle", "Ball"}),
        ("red cube. blue ball.", {"red cube", "blue ball"}),
    ):
        reply = adapter.run(DetectOp(op="detect", image=image, query=query))
        assert {one["label"] for one in reply["detections"]} <= labels
        assert reply["detections"]


def test_grounding_dino_reads_the_text_that_its_processor_would_write(load_detector, png):
    """Joining the texts here must not change what the model reads."""
    adapter = load_detector("grounding_dino")
    ours = adapter._processor(text=["red cube. ball."])["input_ids"]
    assert ours == adapter._processor(text=[["Red cube", "ball"]])["input_ids"]


def test_a_text_without_a_letter_is_refused(load_detector, png):
    """Characters that the tokenizer drops left no token to score: an IndexError."""
    call = DetectOp(op="detect", image=png(WIDTH, HEIGHT), query="\u200b")
    with pytest.raises(BadRequest, match="has no characters that this model reads"):
        load_detector("grounding_dino").run(call)


def test_a_picture_of_which_resizing_leaves_nothing_is_refused(load_detector, png):
    """Resizing by the longer side leaves no pixel of the shorter one: the processor's ValueError
    was told as the model's failure."""
    adapter = load_detector("grounding_dino")
    for size, shrunk in (((2000, 3), "1024 x 2"), ((3, 2000), "2 x 1024")):
        call = DetectOp(op="detect", image=png(*size), query=LABELS)
        with pytest.raises(BadRequest, match=f"Processor cannot read pictures of {shrunk}: "):
            adapter.run(call)


@pytest.mark.parametrize("family", swept("owlvit", "owlv2", "omdet_turbo"))
def test_a_picture_that_no_processor_resizes_is_not_passed_on(family, load_detector, png):
    """A checkpoint whose processor does not resize handed any size to a model of one size."""
    adapter = load_detector(family)
    adapter._processor.image_processor.do_resize = False
    with pytest.raises(BadRequest, match="a picture of 80 x 60; this model reads 64 x 64"):
        adapter.run(DetectOp(op="detect", image=png(WIDTH, HEIGHT), query=LABELS))


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
@pytest.mark.parametrize("family", swept(*tiny_vision.DETECTORS))
def test_each_family_detects_in_each_precision(family, dtype, load_detector, manifest, png):
    """Grounding DINO raised in 16 bits: its inputs and its own tables are float32."""
    adapter = load_detector(family, dtype)
    kept = {"fp32": "torch.float32", "bf16": "torch.bfloat16", "fp16": "torch.float16"}[dtype]
    (network,) = adapter.networks
    assert {str(one.dtype) for one in network.parameters()} == {kept}
    found = detect(adapter, png(WIDTH, HEIGHT))
    assert found
    assert all(math.isfinite(number) for one in found for number in (one["score"], *one["box"]))
    if dtype == "fp16":
        assert detect(adapter, png(WIDTH, HEIGHT)) == found, "deterministic"


@pytest.mark.nightly
def test_omdet_turbo_with_a_backbone_of_timm(load_detector, manifest, png):
    pytest.importorskip("timm", reason="OmDet-Turbo's published backbone comes from timm")
    adapter = load_detector("omdet_timm", "fp16", tiny_vision.save_omdet_turbo_timm)
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
def test_numbers_that_overflow_are_not_nothing_found(family, load_detector, manifest, png):
    """A score that is not a number is above no threshold: the answer was an empty list, which
    means that the object is not in view."""
    adapter = load_detector(family)
    (network,) = adapter.networks
    for parameter in network.parameters():
        parameter.data.fill_(math.nan)
    with pytest.raises(ModelError, match="not a number"):
        detect(adapter, png(WIDTH, HEIGHT))


def test_grounding_dino_answers_with_whole_texts(load_detector, manifest, png):
    """The library's reading joins the tokens above 0.25: half a text, or an empty one."""
    adapter = load_detector("grounding_dino")
    tokens = adapter._processor(images=None, text=[LABELS])["input_ids"][0]
    spans = adapter._spans(tokens, LABELS)
    decode = adapter._processor.tokenizer.decode
    assert [decode(tokens[span]).replace(" ##", "") for span in spans] == [
        decode(adapter._processor.tokenizer(label, add_special_tokens=False)["input_ids"])
        for label in LABELS
    ]
    assert {one["label"] for one in detect(adapter, png(WIDTH, HEIGHT))} <= set(LABELS)


@pytest.mark.parametrize("family", ["owlvit", "grounding_dino"])
def test_a_query_that_would_be_cut_off_is_refused(family, load_detector, manifest, png):
    """Objects beyond the model's tokens were dropped, and answered as not in view."""
    adapter = load_detector(family)
    query = ["a small red cube with rounded edges", "a green ball on the left"]
    query.append("a mug without a handle")
    with pytest.raises(BadRequest, match="tokens; this model reads"):
        adapter.run(DetectOp(op="detect", image=png(WIDTH, HEIGHT), query=query))
