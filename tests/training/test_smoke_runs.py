"""Each trainer from a recording to an answer of the sidecar's adapter, in toy sizes: a minute each.

Nothing is learned: it shows that a checkpoint can still be made, and by the seed alone.
"""

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("lerobot")
import numpy as np

from tests.support.paths import CONFIGS
from tests.support.pictures import encoded
from training.__main__ import main
from training.datasets import INFO, LABELS
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.sidecar import DetectOp, EndpointCall, QueryOp, ScoreOp
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.weights import Weights

pytestmark = [pytest.mark.heavy, pytest.mark.nightly, pytest.mark.timeout(900)]


def run(*words: object) -> dict[str, Any]:
    """Run a command of `python -m training`. Returns its figures."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main([str(word) for word in words]) == 0
    text = said.getvalue()
    figures: dict[str, Any] = json.loads(text[text.index("{") :])
    return figures


def scenes(folder: Path) -> None:
    run("record", "scenes", "--count", 40, "--seed", 4, "--out", folder)
    labels = [json.loads(line) for line in (folder / LABELS).read_text().splitlines()]
    assert len(labels) == 40
    assert {label["camera"] for label in labels} == {"front", "wrist"}
    for label in labels:
        assert label["held"] in [None, *(thing["name"] for thing in label["objects"])]


def grabs(folder: Path) -> None:
    """With a policy at the wheel; it is the shipped one."""
    policy = CONFIGS / "models/so101-grab"
    run("record", "grabs", "--count", 2, "--seed", 4, "--out", folder, "--policy", policy)
    lengths = json.loads((folder / INFO).read_text())["lengths"]
    assert len(lengths) == 2
    assert np.load(folder / "wrist.npy").shape == (sum(lengths), 80, 96, 3)
    assert np.load(folder / "action.npy").shape == (sum(lengths), 6)


def progress(folder: Path) -> None:
    run("record", "progress", "--count", 5, "--seed", 3, "--out", folder)
    labels = json.loads((folder / INFO).read_text())["labels"]
    assert len(np.load(folder / "images.npy")) == len(labels)
    assert any(label["held"] for label in labels), "some grabs succeed"


def blank_observation() -> dict[str, Any]:
    pixels = {"front": (360, 480, 3), "wrist": (240, 320, 3)}
    images = {f"observation.images.{key}": np.zeros(pixels[key], np.uint8) for key in pixels}
    return images | {"observation.state": np.zeros(6, np.float32), "task": "grab the red cube"}


def look() -> bytes:
    return encoded(size=(320, 240))


@dataclass(frozen=True)
class Case:
    """One trainer: its data, a figure that falls, the skill it is for, and a request."""

    trainer: str
    record: Callable[[Path], None]
    falls: str
    skill: str
    request: Callable[[], Any]


CASES = (
    Case(
        "detector", scenes, "loss", "so101-detector",
        lambda: DetectOp(op="detect", image=look(), query="red cube"),
    ),
    Case(
        "scene-vlm", scenes, "loss", "so101-scene-vlm",
        lambda: QueryOp(op="query", image=look(), question="Is the gripper empty?"),
    ),
    Case(
        "policy", grabs, "action", "so101-grab",
        lambda: EndpointCall(
            endpoint="get_action", data={"observation": blank_observation(), "options": None}
        ),
    ),
    Case(
        "progress", progress, "progress", "so101-progress",
        lambda: ScoreOp(op="score", task="grab the red cube", images=[look()]),
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.trainer)
def test_a_checkpoint_is_made_and_served(case: Case, tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    case.record(data)

    def train(name: str, *more: object) -> dict[str, Any]:
        where = ("--data", data, "--out", out / name, "--smoke", "--threads", 1)
        return run(case.trainer, *where, *more)

    def weights(name: str) -> bytes:
        return (out / name / "model.safetensors").read_bytes()

    figures, short = train("whole"), train("short", "--steps", 2)
    assert figures[case.falls] < short[case.falls]
    train("again", "--steps", 2)
    assert weights("again") == weights("short"), "the seed decides"
    train("other", "--steps", 2, "--seed", 9)
    assert weights("other") != weights("short")
    train("on", "--steps", 2, "--start-from", out / "whole")
    assert weights("on") != weights("short")
    card = (out / "whole/README.md").read_text()
    assert f"| {case.falls} | {figures[case.falls]} |" in card
    assert f"| parameters | {figures['parameters']} |" in card

    manifest = load_manifest(CONFIGS / "rskills" / case.skill / "rskill.yaml")
    adapter = make_adapter(manifest, Weights(str(out / "whole"), local=True))
    adapter.prepare()
    adapter.load("cpu")
    assert adapter.run(case.request())
