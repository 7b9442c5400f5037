"""The detector behind transformers' zero-shot classes, loaded as in production from a tiny
checkpoint."""

import math

import pytest

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.detector import (
    DetectorAdapter,
    detection,
    grounding_answer,
    split_query,
)

BLOCK = "actions: [detect]\ndetector: {labels: [cube], score_threshold: 0.0, max_side: 512}\n"


@pytest.mark.parametrize(
    ("query", "labels"),
    [
        ("red cube", ["red cube"]),
        ("red cube . blue ball", ["red cube", "blue ball"]),
        ("red cube. blue ball.", ["red cube", "blue ball"]),
        ("1.5 l bottle. blue ball. ", ["1.5 l bottle", "blue ball"]),
        (["red cube. blue ball.", "a no. 5 bolt"], ["red cube", "blue ball", "a no. 5 bolt"]),
        ("red cube, blue ball,red cube", ["red cube", "blue ball"]),
        ("a no. 5 bolt .", ["a no. 5 bolt"]),
        ("red cube</c>blue ball</c> mug </c>", ["red cube", "blue ball", "mug"]),
        (["red cube</c>mug", "blue ball , mug"], ["red cube", "mug", "blue ball"]),
    ],
)
def test_a_query_names_one_or_several_things(query, labels):
    assert split_query(query) == labels


@pytest.mark.parametrize("query", [" . ", ",", ",".join(f"thing {n}" for n in range(65))])
def test_none_and_too_many_are_refused(query):
    with pytest.raises(BadRequest):
        split_query(query)


def test_the_fields_grounding_format():
    found = [{"label": "red cube", "score": 0.9, "box": [10.0, 30.0, 40.0, 60.0]}]
    assert grounding_answer(found, 80, 60) == "<ref>red cube</ref><box><125><500><500><1000></box>"
    assert grounding_answer([], 80, 60) == ""


def test_a_box_that_is_no_number_is_not_made_one():
    """Regression: cutting it to the picture put the picture's edge in its place."""
    assert detection("cube", 0.9, [-5.0, 3.0, 90.0, 9.0], (60, 80)) == {
        "label": "cube", "score": 0.9, "box": [0.0, 3.0, 80.0, 9.0],
    }  # fmt: skip
    for score, left in ((0.9, math.nan), (math.nan, 1.0)):
        with pytest.raises(ModelError, match="not a number"):
            detection("cube", score, [left, 3.0, 9.0, 9.0], (60, 80))


@pytest.mark.heavy
def test_it_detects_in_the_pixels_of_the_picture_sent(manifest, weights, png):
    adapter = DetectorAdapter(manifest("detector", BLOCK), weights("owlvit"))
    adapter.prepare()
    adapter.load("cpu")
    call = DetectOp(op="detect", image=png(800, 600), query="red cube . ball", max_side=64)
    reply = adapter.run(call)
    assert reply == adapter.run(call), "the same picture gets the same answer"
    assert reply["detections"], "the threshold is 0"
    assert {one["label"] for one in reply["detections"]} <= {"red cube", "ball"}
    scores = [one["score"] for one in reply["detections"]]
    assert scores == sorted(scores, reverse=True)
    x0, y0, x1, y1 = zip(*(one["box"] for one in reply["detections"]), strict=True)
    assert min(x0) >= 0
    assert min(y0) >= 0
    assert 100 < max(x1) <= 800, (
        "boxes are in the pixels of the sent picture, not of the shrunk one"
    )
    assert 100 < max(y1) <= 600
    assert reply["answer"].startswith("<ref>")
    assert reply["norm"] == 1000
    nothing = adapter.run(call.model_copy(update={"score_threshold": 1.0}))
    assert (nothing["ok"], nothing["detections"], nothing["answer"]) == (True, [], "")
    adapter.load("cpu")
    assert adapter.run(call) == reply, "loading again gives the same model"


@pytest.mark.heavy
def test_a_checkpoint_of_another_kind_is_named(manifest, weights):
    adapter = DetectorAdapter(manifest("detector", BLOCK), weights("act"))
    with pytest.raises(ModelError, match="cannot load"):
        adapter.prepare()


@pytest.mark.heavy
def test_the_fields_default_query_finds_what_is_in_view():
    """Regression: the field joins a manifest's labels by `</c>`. They were taken as one label, and
    the answer was "nothing found" with the object in view."""
    import io
    from pathlib import Path

    from PIL import Image

    from vram_arbiter.runner.sim.env import SimEnv
    from vram_arbiter.schemas.manifest import load_manifest
    from vram_arbiter.sidecars.weights import resolve

    configs = Path(__file__).parents[3] / "configs"
    manifest = load_manifest(configs / "rskills/so101-detector/rskill.yaml")
    adapter = DetectorAdapter(manifest, resolve(str(manifest.weights_uri), configs))
    adapter.prepare()
    adapter.load("cpu")
    stream = io.BytesIO()
    with SimEnv() as env:
        env.reset(4711, names=("red cube", "blue ball", "green cylinder"))
        Image.fromarray(env.render("front")).save(stream, "PNG")
    joined = "</c>".join(manifest.detector.labels)
    for query in (joined, [joined], list(manifest.detector.labels)):
        reply = adapter.run(DetectOp(op="detect", image=stream.getvalue(), query=query))
        assert "red cube" in {one["label"] for one in reply["detections"]}
        assert all("</c>" not in one["label"] for one in reply["detections"])
