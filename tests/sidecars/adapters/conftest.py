"""Tiny models with random weights, saved as hub checkpoints are, for the production loading path to
read back."""

import io
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.adapters import families, policies, tiny_vision
from vram_arbiter.schemas.manifest import RSkillManifest, parse_manifest
from vram_arbiter.sidecars.adapters.policy_families import FAMILIES
from vram_arbiter.sidecars.weights import Weights, resolve

SAVERS: dict[str, Callable[[Path], None]] = {
    "owlvit": tiny_vision.save_owlvit,
    "qwen": tiny_vision.save_qwen3_5,
    "act": partial(policies.save_act, n_action_steps=5),
}


@pytest.fixture(scope="session")
def configs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configs folder; models are made when first asked for."""
    return tmp_path_factory.mktemp("configs")


@pytest.fixture(scope="session")
def weights(configs: Path) -> Callable[[str], Weights]:
    def weights(name: str) -> Weights:
        folder = configs / "models" / name
        if not folder.exists():
            folder.mkdir(parents=True)
            SAVERS[name](folder)
        return resolve(f"local://models/{name}", configs)

    return weights


@pytest.fixture(scope="module")
def saved(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str, Callable[[Path], None]], Weights]:
    """Saves a family's checkpoint in float32, once, and returns its weights."""
    root = tmp_path_factory.mktemp("saved")

    def saved(family: str, save: Callable[[Path], None]) -> Weights:
        folder = root / family
        if not folder.exists():
            folder.mkdir()
            save(folder)
        return Weights(str(folder), local=True)

    return saved


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Weights]:
    """Return a checkpoint of a family, or skip the test where a package is missing."""
    folder = tmp_path_factory.mktemp("policies")

    def checkpoint(name: str) -> Weights:
        for package in FAMILIES[families.family_of(name)].packages:
            pytest.importorskip(package)
        place = folder / f"clip {name}"  # multi_task_dit wants `clip` in its encoders' names
        if not place.exists():
            place.mkdir()
            families.SAVERS[name](place)
        return Weights(str(place), local=True)

    return checkpoint


@pytest.fixture(scope="module")
def small_networks() -> Iterator[None]:
    """Small networks in the place of those whose sizes are fixed in lerobot's code."""
    with policies.small_networks():
        yield


def placed(adapter: Any) -> Any:
    """Load an adapter's weights and place them on the CPU."""
    adapter.prepare()
    adapter.load("cpu")
    adapter.place("cpu")
    return adapter


@pytest.fixture
def manifest() -> Callable[[str, str], RSkillManifest]:
    def manifest(kind: str, more: str) -> RSkillManifest:
        return parse_manifest(
            f"name: test/model\nversion: 0.1.0\nkind: {kind}\nembodiment_tags: [any]\nchunk_size: "
            "1\n"
            "weights_uri: local://models/x\ndescription: a tiny model\nlatency_budget: "
            f"{{per_chunk_ms: 100}}\n{more}"
        )

    return manifest


@pytest.fixture
def png() -> Callable[..., bytes]:
    def png(
        width: int = 80, height: int = 60, colour: tuple[int, int, int] = (200, 30, 30)
    ) -> bytes:
        from PIL import Image

        stream = io.BytesIO()
        Image.new("RGB", (width, height), colour).save(stream, "PNG")
        return stream.getvalue()

    return png
