"""The scene VLM behind AutoModelForImageTextToText, loaded as in production from a tiny Qwen3.5."""

import pytest

from vram_arbiter.schemas.errors import BadRequest, LimitExceeded
from vram_arbiter.schemas.sidecar import QueryOp
from vram_arbiter.sidecars.adapters.scene_vlm import SceneVlmAdapter, after_thinking


def test_only_what_follows_the_last_thought_is_the_answer():
    assert after_thinking("hm</think> no, wait</think>\n\nyes ") == "yes"
    assert after_thinking("yes") == "yes"
    for unclosed in ("<think>hm", "<think>hm</think> well <think>"):
        with pytest.raises(LimitExceeded, match="raise max_new_tokens"):
            after_thinking(unclosed)


@pytest.mark.heavy
def test_it_answers_greedily_and_reloads(manifest, weights, png):
    adapter = SceneVlmAdapter(manifest("vlm", "role: s2\nactions: [query]\n"), weights("qwen"))
    adapter.prepare()
    adapter.load("cpu")
    call = QueryOp(op="query", image=png(), question="Is the red cube held?", max_new_tokens=8)
    reply = adapter.run(call)
    assert reply["ok"] is True
    assert isinstance(reply["answer"], str)
    assert adapter.run(call) == reply
    with pytest.raises(BadRequest, match="cannot be decoded"):
        adapter.run(call.model_copy(update={"image": b"no picture"}))
    adapter.load("cpu")
    assert adapter.run(call) == reply
