"""Frames through the GPU: nothing moves, nothing is made up, no GPU is an error at the start."""

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest

from tests.support import prepared
from tests.support.paths import CONFIGS
from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.errors import BadRequest, ConfigError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.__main__ import main
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.gpu_passthrough import GpuPassthroughAdapter
from vram_arbiter.sidecars.weights import resolve

pytestmark = pytest.mark.heavy  # torch

RSKILL = CONFIGS / "diagnostics/gpu-passthrough/rskill.yaml"
FRONT = "observation.images.front"


def call(endpoint: str, observation: Any = None) -> EndpointCall:
    return EndpointCall(
        endpoint=endpoint, data=None if observation is None else {"observation": observation}
    )


def arm_observation(**changes: Any) -> dict[str, Any]:
    import numpy as np

    picture = np.zeros((128, 256, 3), dtype=np.uint8)
    picture[:, 128:] = 255
    picture[::2, ::2, 2] = 255  # a picture that is thinned by two would be all blue
    return {
        "observation.state": np.array([0.1, -0.2, 0.3]),
        FRONT: picture,
        "task": "look",
    } | changes


@pytest.fixture
def adapter() -> GpuPassthroughAdapter:
    manifest = load_manifest(RSKILL)
    made = make_adapter(manifest, resolve(str(manifest.weights_uri), CONFIGS))
    assert isinstance(made, GpuPassthroughAdapter)
    made.prepare()
    made.place("cpu")  # what a simulated GPU computes on
    return made


def test_the_arm_keeps_the_pose_it_had_at_first(adapter: GpuPassthroughAdapter) -> None:
    import numpy as np

    first = adapter.run(call("get_action", arm_observation()))
    assert first["action"].tolist() == [pytest.approx([0.1, -0.2, 0.3])]
    assert first["confidence"].tolist() == pytest.approx([0.5, 0.5, 0.625])
    sagged = arm_observation(**{"observation.state": np.array([0.1, -0.25, 0.3])})
    assert adapter.run(call("get_action", sagged))["action"][0, 1] == pytest.approx(-0.2)
    adapter.run(call("reset"))
    assert adapter.run(call("get_action", sagged))["action"][0, 1] == pytest.approx(-0.25)


def test_a_white_picture_is_one_and_no_more(adapter: GpuPassthroughAdapter) -> None:
    """In float32 a mean of many pixels may exceed them, and no confidence is above 1."""
    import numpy as np

    white = np.full((1440, 2561, 3), 255, dtype=np.uint8)
    answer = adapter.run(call("get_action", arm_observation(**{FRONT: white})))
    assert answer["confidence"].tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({FRONT: None}, f"lacks {FRONT}"),
        ({FRONT: b"\x89PNG"}, "neither PNG nor JPEG"),
        ({FRONT: "float"}, "uint8"),
        ({FRONT: (100, 200)}, "uint8"),
        ({FRONT: (100, 200, 4)}, "uint8"),
        ({FRONT: (63, 200, 3)}, "at least"),
        ({FRONT: (0, 0, 3)}, "at least"),
        ({"observation.state": [0.1, float("nan")]}, "finite"),
        ({"observation.state": [[0.1], [0.2]]}, "a row"),
        ({"observation.state": []}, "a row"),
        ({"observation.state": "left"}, "numbers"),
    ],
)
def test_what_is_missing_or_misshapen_is_refused(
    adapter: GpuPassthroughAdapter, changes: dict[str, Any], said: str
) -> None:
    import numpy as np

    for name, value in changes.items():
        if isinstance(value, tuple):
            changes[name] = np.zeros(value, dtype=np.uint8)
        elif value == "float":
            changes[name] = np.zeros((100, 200, 3), dtype=np.float32)
    with pytest.raises(BadRequest, match=said):
        adapter.run(call("get_action", arm_observation(**changes)))


def test_an_observation_that_is_none_and_a_state_that_is_missing(
    adapter: GpuPassthroughAdapter,
) -> None:
    with pytest.raises(BadRequest, match="a map"):
        adapter.run(call("get_action", "look"))
    with pytest.raises(BadRequest, match="lacks observation"):
        adapter.run(call("get_action", {FRONT: arm_observation()[FRONT]}))


def test_without_cameras_there_is_nothing_to_pass_on() -> None:
    manifest = load_manifest(RSKILL).model_copy(update={"sensors_required": ()})
    with pytest.raises(ConfigError, match="names no camera"):
        GpuPassthroughAdapter(manifest)


FLAGS = ("--name", "passthrough", "--rskill", str(RSKILL), "--no-arbiter")


@pytest.mark.parametrize("device", ["none", "cuda"])
def test_without_a_gpu_it_does_not_start(device: str, tmp_path: Path) -> None:
    import torch

    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    flags = [*FLAGS, "--device", device, "--endpoint", f"ipc://{tmp_path}/passthrough.sock"]
    done = prepared.run("vram-sidecar", flags, os.environ, PATIENCE_S)
    assert done.returncode == 1
    assert "GPU" in done.stderr
    assert "fake:FOLDER" in done.stderr


def test_a_program_that_calls_main_keeps_its_temporary_folder(tmp_path: Path) -> None:
    """Regression: the sidecar's folder stayed that of the program."""
    (tmp_path / "taken").mkdir()
    before = tempfile.gettempdir()
    assert main([*FLAGS, "--device", "cuda", "--endpoint", f"ipc://{tmp_path}/taken"]) != 0
    assert tempfile.gettempdir() == before
