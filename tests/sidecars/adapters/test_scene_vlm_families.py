"""Scene VLMs of several families, saved by the family's own code and loaded as in production:
several pictures, a video, limits."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from pydantic import ValidationError

from tests.sidecars.adapters import tiny_vision
from tests.sidecars.adapters.conftest import placed
from vram_arbiter.schemas.errors import BadRequest, LimitExceeded, ModelError
from vram_arbiter.schemas.sidecar import PICTURES_MAX, QueryOp
from vram_arbiter.sidecars.adapters import scene_vlm
from vram_arbiter.sidecars.adapters.scene_vlm import SceneVlmAdapter
from vram_arbiter.sidecars.images import decode
from vram_arbiter.sidecars.weights import Weights

TOKENS = 4
RED, BLUE = (200, 30, 30), (30, 30, 200)
needs_num2words = pytest.mark.skipif(
    find_spec("num2words") is None, reason="SmolVLM's processor writes numbers in words"
)
BY_DAY = ("qwen3_5", "smolvlm")
"""`make nightly` plays the other families, too."""
FAMILIES = [
    pytest.param(
        family,
        marks=[
            *([] if family in BY_DAY else [pytest.mark.nightly]),
            *([needs_num2words] if family == "smolvlm" else []),
        ],
    )
    for family in tiny_vision.VLMS
]


@pytest.fixture
def loaded(saved, manifest):
    """Loads a family's checkpoint in the manifest's precision."""

    def loaded(family, dtype="fp32"):
        described = manifest(
            "vlm", f"role: s2\nactions: [query]\nquantization: {{dtype: {dtype}}}\n"
        )
        return placed(SceneVlmAdapter(described, saved(family, tiny_vision.VLMS[family])))

    return loaded


def asked(**pictures):
    return QueryOp(op="query", question="Is it held?", max_new_tokens=TOKENS, **pictures)


def by_transformers(adapter, pictures):
    """The answer by the library's own path from messages to tokens."""
    import torch

    content = [{"type": "image", "image": decode(picture)} for picture in pictures]
    inputs = adapter._processor.apply_chat_template(
        [{"role": "user", "content": [*content, {"type": "text", "text": "Is it held?"}]}],
        add_generation_prompt=True,
        tokenize=True,
        return_dict=True,
        return_tensors="pt",
    )
    (network,) = adapter.networks
    inputs = inputs.to(network.dtype)
    with torch.inference_mode():
        output = network.generate(**inputs, max_new_tokens=TOKENS, do_sample=False)
    text = adapter._processor.decode(
        output[0, inputs["input_ids"].shape[1] :], skip_special_tokens=True
    )
    return text.strip()


@pytest.mark.heavy
@pytest.mark.parametrize("family", FAMILIES)
def test_each_family_takes_several_pictures(family, loaded, manifest, png):
    """In 16 bits; LLaVA-OneVision took two pictures for those of two prompts."""
    adapter = loaded(family, dtype := "fp16" if family == "qwen3_5" else "bf16")
    (network,) = adapter.networks
    assert str(network.dtype) == {"fp16": "torch.float16", "bf16": "torch.bfloat16"}[dtype]
    pictures = [png(colour=RED), png(colour=BLUE)]
    expected = by_transformers(adapter, pictures)
    assert expected
    call = asked(image=pictures[0], images=pictures[1:])
    if family == "qwen3_vl":  # its template opens a thought, and so few tokens do not close it
        with pytest.raises(LimitExceeded, match="all tokens for thinking"):
            adapter.run(call)
    else:
        assert adapter.run(call) == {"ok": True, "answer": expected}


@pytest.mark.heavy
@pytest.mark.parametrize("special", [True, False])
def test_thoughts_are_no_part_of_the_answer(special, loaded):
    """Regression: decoding drops special tokens. Where a tokenizer counts `<think>` and `</think>`
    among them, thought and answer were one text: `is it a cubeyes`."""
    adapter = loaded("qwen3_5")
    tokenizer = adapter._processor.tokenizer
    tokenizer.add_tokens(["<think>", "</think>"], special_tokens=special)

    def answer(text, thinks=False):
        return adapter._answer(tokenizer(text)["input_ids"], thinks)

    assert answer("<think>is it a cube</think>\n\nyes<|im_end|>") == "yes"
    assert answer("is it</think>no<think>a cube</think>yes<|im_end|>", thinks=True) == "yes"
    assert answer("yes<|im_end|>") == "yes"
    assert answer("is it a cube</think>", thinks=True) == ""
    for text, thinks in (("<think>is it", False), ("is it", True), ("a</think>b<think>", True)):
        with pytest.raises(LimitExceeded, match="all tokens for thinking"):
            answer(text, thinks)


@pytest.mark.heavy
@pytest.mark.parametrize("family", FAMILIES)
def test_each_family_looks_at_all_frames_of_a_video(family, loaded, manifest, png):
    import torch

    adapter = loaded(family)
    red, blue = decode(png(colour=RED)), decode(png(colour=BLUE))
    inputs, _ = adapter._inputs([], [red, red, red], 2.0, "Is it held?")
    changed, _ = adapter._inputs([], [red, red, blue], 2.0, "Is it held?")
    (pixels,) = (name for name in inputs if name.startswith("pixel_values"))
    assert not torch.equal(inputs[pixels], changed[pixels])
    assert torch.equal(inputs["input_ids"], changed["input_ids"])
    text = adapter._processor.decode(inputs["input_ids"][0])
    if family.startswith("qwen3"):  # two frames at a time, the last one twice
        assert "<0.2 seconds>" in text
        assert "<1.0 seconds>" in text
    if family == "qwen2_5_vl":
        assert inputs["second_per_grid_ts"].tolist() == [1.0]
    if family == "smolvlm":
        assert "00:01" in text
    call = asked(video=[png(colour=RED), png(colour=RED), png(colour=BLUE)], fps=2.0)
    both = call.model_copy(update={"image": png(colour=BLUE)})
    if family == "smolvlm":
        assert adapter.run(call) == adapter.run(call)
        with pytest.raises(BadRequest, match="not both"):
            adapter.run(both)
    elif family != "qwen3_vl":
        assert adapter.run(both) == adapter.run(both)


@pytest.mark.heavy
def test_what_the_model_cannot_read_is_refused(loaded, manifest, png, monkeypatch):
    adapter = loaded("qwen3_5")
    with pytest.raises(LimitExceeded, match="send fewer pictures") as refused:
        adapter.run(asked(image=png()).model_copy(update={"max_new_tokens": 4096 - 20}))
    assert refused.value.details["tokens_max"] == 20
    monkeypatch.setattr(scene_vlm, "PROMPT_MAX_TOKENS", 50)
    doubting = asked(image=png()).model_copy(update={"question": "<think>?"})
    assert adapter.run(doubting)["ok"], "the thought is the caller's, not the model's"
    with pytest.raises(LimitExceeded, match="send fewer pictures"):
        adapter.run(asked(images=[png(), png()]))
    with pytest.raises(BadRequest, match="different sizes"):
        adapter.run(asked(video=[png(64, 48), png(48, 64)], fps=1.0))
    with pytest.raises(BadRequest, match="stands for a picture"):
        adapter.run(asked(image=png()).model_copy(update={"question": "<|image_pad|>?"}))
    with pytest.raises(BadRequest, match="cannot read pictures of 900 x 4: "):
        adapter.run(asked(image=png(900, 4)))
    with pytest.raises(BadRequest, match="more than"):
        adapter.run(asked(images=[png(4000, 2100), png(4000, 2100)]))
    adapter._processor.video_processor = None
    with pytest.raises(BadRequest, match="send the frames as `images`"):
        adapter.run(asked(video=[png()], fps=1.0))
    adapter._processor.chat_template = None
    with pytest.raises(ValueError, match="chat template"):
        adapter.run(asked(image=png()))


@pytest.mark.heavy
def test_a_checkpoint_without_chat_template_is_refused_before_it_is_loaded(
    loaded, manifest, tmp_path
):
    adapter = loaded("qwen3_5")
    adapter._processor.save_pretrained(tmp_path)
    (tmp_path / "chat_template.jinja").unlink()
    adapter.networks[0].config.save_pretrained(tmp_path)
    bare = SceneVlmAdapter(
        manifest("vlm", "role: s2\nactions: [query]\n"), Weights(str(tmp_path), local=True)
    )
    with pytest.raises(ModelError, match="chat template cannot be used"):
        bare.prepare()


PNG = bytes(8)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, "give 1 to 32 pictures"),
        ({"image": PNG, "images": [PNG] * PICTURES_MAX}, "give 1 to 32 pictures"),
        ({"images": [PNG] * (PICTURES_MAX + 1)}, "at most 32"),
        ({"video": [PNG]}, "video and fps belong together"),
        ({"image": PNG, "fps": 2.0}, "video and fps belong together"),
        ({"video": [PNG], "fps": 0.0}, "greater than 0"),
    ],
)
def test_pictures_are_counted_before_any_is_looked_at(fields, reason):
    with pytest.raises(ValidationError, match=reason):
        asked(**fields)


@pytest.mark.heavy
def test_an_adapter_beside_a_model_is_refused(loaded):
    """Regression: transformers adds an adapter unasked where PEFT is installed, and ignores it
    where it is not."""
    adapter = loaded("qwen2_5_vl")
    config = Path(adapter._weights.source) / "adapter_config.json"
    config.write_text('{"peft_type": "LORA", "base_model_name_or_path": "other/model"}')
    try:
        with pytest.raises(ModelError, match="holds a PEFT adapter beside a model"):
            adapter.load("cpu")
    finally:
        config.unlink()
