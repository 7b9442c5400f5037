"""The scripted pick: a policy's endpoints without a model."""

from typing import Any

import pytest

from tests.support.paths import CONFIGS

pytest.importorskip("cv2")
import numpy as np
import yaml

from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.scripted_pick import ScriptedPickAdapter
from vram_arbiter.sidecars.weights import resolve

pytestmark = pytest.mark.heavy


@pytest.fixture
def panda_grab() -> RSkillManifest:
    return load_manifest(CONFIGS / "rskills/panda-grab/rskill.yaml")


def observation(**more: Any) -> dict[str, Any]:
    """Hand at (0.5, 0, 1.1), base at the origin, a red square on the grasp spot, a blue one
    beside it.
    """
    picture = np.full((360, 480, 3), 120, dtype=np.uint8)
    picture[120:140, 190:210] = (200, 20, 20)
    picture[120:140, 300:320] = (20, 50, 210)
    state = [0.5, 0.0, 1.1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0.04, -0.04]
    return {
        "observation.state": np.array(state),
        "observation.images.front": picture,
        "task": "grab the red cube",
    } | more


def chunk(adapter: ScriptedPickAdapter, **more: Any) -> Any:
    data = {"observation": observation(**more)}
    return adapter.run(EndpointCall(endpoint="get_action", data=data))["action"]


def test_its_camera_is_that_of_the_scene(panda_grab: RSkillManifest) -> None:
    scene = yaml.safe_load((CONFIGS / "scenes/counter.yaml").read_text())
    told, camera = panda_grab.policy_extras["scripted_pick"], scene["cameras"]["front"]
    assert {name: told[name] for name in ("fovy_deg", "pos_m", "look_at_m")} == {
        name: camera[name] for name in ("fovy_deg", "pos_m", "look_at_m")
    }
    assert told["spot_m"] == scene["grasp_spot_in_base_m"]


def test_it_drives_the_base_towards_the_color_of_the_task(panda_grab: RSkillManifest) -> None:
    adapter = make_adapter(panda_grab, resolve(str(panda_grab.weights_uri), CONFIGS))
    assert isinstance(adapter, ScriptedPickAdapter)
    red = chunk(adapter)
    assert red.shape == (10, 12)
    assert (red[:, 11] == 1).all(), "navigate"
    assert (red[:, 6] == -1).all(), "open"
    assert not red[:, :6].any()
    adapter.run(EndpointCall(endpoint="reset", data={}))
    blue = chunk(adapter, task="grab the blue ball")
    assert blue[0, 8] < red[0, 8], "blue lies to the right of red"


@pytest.mark.parametrize(
    ("more", "error", "said"),
    [
        ({"task": "grab it"}, BadRequest, "names no color"),
        ({"task": "grab the green cube"}, ModelError, "nothing green is in the picture"),
        ({"observation.state": np.zeros(6)}, BadRequest, "16 numbers"),
        ({"observation.images.front": None}, BadRequest, "observation.images.front must be"),
    ],
)
def test_it_refuses_what_it_cannot_act_on(
    panda_grab: RSkillManifest, more: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        chunk(ScriptedPickAdapter(panda_grab), **more)


def test_a_wrong_setup_and_an_unknown_adapter_are_told(panda_grab: RSkillManifest) -> None:
    for extras, said in (
        ({"adapter": "scripted_pick"}, "scripted_pick"),
        ({"adapter": "magic"}, "'magic' is not served"),
    ):
        wrong = panda_grab.model_copy(update={"policy_extras": extras})
        with pytest.raises(ConfigError, match=said):
            make_adapter(wrong, resolve(str(panda_grab.weights_uri), CONFIGS))
