"""Policies behind lerobot's classes and processors, loaded as in production from a tiny ACT."""

import io

import pytest

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.policy import PolicyAdapter

pytestmark = pytest.mark.heavy

BLOCK = (
    "model_family: act\nactions: [grasp]\nactuators_required:\n"
    "  - {kind: joint_position, control_mode_semantics: {mode: absolute}}\n"
)
ALIASES = "image_preprocessing: {aliases: {base_cam: front}}\n"


@pytest.fixture(scope="module")
def adapter(weights):
    from vram_arbiter.schemas.manifest import parse_manifest

    head = (
        "name: test/model\nversion: 0.1.0\nkind: vla\nembodiment_tags: [any]\nchunk_size: "
        "5\nweights_uri: local://models/x\n"
        "description: a tiny model\nlatency_budget: {per_chunk_ms: 100}\n"
    )
    adapter = PolicyAdapter(parse_manifest(head + BLOCK + ALIASES), weights("act"))
    adapter.prepare()
    adapter.load("cpu")
    return adapter


@pytest.fixture
def observation():
    import numpy as np

    image = np.full((64, 64, 3), 128, np.uint8)
    return {
        "observation.images.base_cam": image,
        "observation.state": np.zeros(6, np.float32),
        "task": "grab the red cube",
    }


def act(adapter, observation):
    return adapter.run(
        EndpointCall(endpoint="get_action", data={"observation": observation, "options": None})
    )["action"]


def test_a_chunk_in_the_units_of_the_checkpoint(adapter, observation):
    actions = act(adapter, observation)
    assert (actions.shape, str(actions.dtype)) == ((5, 6), "float32")
    assert 2 < actions.mean() < 4, "the postprocessor of the checkpoint ran: its mean is 3"
    assert (act(adapter, observation) == actions).all()


def test_pictures_may_come_as_png_and_with_a_leading_one(adapter, observation):
    from PIL import Image

    expected = act(adapter, observation)
    stream = io.BytesIO()
    Image.fromarray(observation["observation.images.base_cam"]).save(stream, "PNG")
    assert (
        act(adapter, observation | {"observation.images.base_cam": stream.getvalue()}) == expected
    ).all()
    batched = {
        name: value[None] if hasattr(value, "dtype") else [value]
        for name, value in observation.items()
    }
    assert (act(adapter, batched) == expected).all()


def test_what_is_missing_or_misshapen_is_named(adapter, observation):
    import numpy as np

    wrong = [
        ({"observation.state": None}, r"observation\.state has numbers that are not finite"),
        ({"observation.state": np.zeros(5, np.float32)}, r"shape \(6,\), not \(5,\)"),
        ({"observation.state": np.full(6, np.nan, np.float32)}, "not finite"),
        ({"observation.images.base_cam": np.zeros((64, 64), np.uint8)}, "base_cam must be uint8"),
        ({"observation.images.base_cam": b"no picture"}, "cannot be decoded"),
        ({"task": 5}, "task must be a text"),
    ]
    for changes, told in wrong:
        with pytest.raises(BadRequest, match=told):
            act(adapter, observation | changes)
    del observation["observation.images.base_cam"]
    with pytest.raises(BadRequest, match=r"lacks observation\.images\.front"):
        act(adapter, observation)
    with pytest.raises(BadRequest, match=r"data\.observation"):
        adapter.run(EndpointCall(endpoint="get_action"))


def test_reset_and_reload(adapter, observation):
    expected = act(adapter, observation)
    begun = adapter.run(EndpointCall(endpoint="reset"))
    assert begun == {"ok": True, "n_obs_steps": 1, "n_action_steps": 5}
    adapter.load("cpu")
    assert (act(adapter, observation) == expected).all()


def test_actions_that_are_no_numbers_never_leave(adapter, observation):
    parameter = next(adapter._policy.model.action_head.parameters())
    kept = parameter.data.clone()
    parameter.data.fill_(float("nan"))
    with pytest.raises(ModelError, match="not finite"):
        act(adapter, observation)
    parameter.data.copy_(kept)


def test_our_own_policy_type_is_known(manifest, weights):
    from lerobot.configs.policies import PreTrainedConfig

    PolicyAdapter(manifest("vla", BLOCK), weights("act")).prepare()
    assert "compact_act" in PreTrainedConfig.get_known_choices()
