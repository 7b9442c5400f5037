"""The wheel holds the product and its data: no test of ours, no training code. It is built from
what the images copy, and installed as they do."""

import os
import shlex
import shutil
import zipfile
from pathlib import Path

import pytest

from tests.packaging.test_containers import text_of
from tests.packaging.wheels import built, pip
from tests.support.paths import ROOT

IMAGE = text_of("Containerfile")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the image's COPY lines, without weights."""
    folder = tmp_path_factory.mktemp("source")
    unneeded = shutil.ignore_patterns("__pycache__", "*.safetensors")
    for name in IMAGE.copies:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=unneeded)
        else:
            shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="the dependency group `dev`")
    return built(source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def names(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


def test_the_product_and_its_data_are_there_under_one_name(names: list[str]) -> None:
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"vram_arbiter"}
    assert set(names) >= {
        "vram_arbiter/__init__.py",
        "vram_arbiter/py.typed",
        "vram_arbiter/arbiter/offline/__main__.py",
        "vram_arbiter/configs/arbiter.yaml",
        "vram_arbiter/schemas/json/arbiter.json",
        "vram_arbiter/testing/plugin.py",
    }
    licenses = {name.rsplit("/", 1)[-1] for name in names if "/licenses/" in name}
    assert licenses == {"LICENSE", "NOTICE"}


def test_no_tests_and_no_training_code(names: list[str]) -> None:
    odd = [
        name
        for name in names
        if {"tests", "training"} & set(name.split("/"))
        or name.rsplit("/", 1)[-1].startswith(("test_", "conftest"))
    ]
    assert not odd


def test_the_same_bytes_are_built_in_another_place_at_another_time(
    source: Path, wheel: Path, tmp_path: Path
) -> None:
    other = tmp_path / "elsewhere"
    shutil.copytree(source, other, symlinks=True)
    for path in other.rglob("*"):
        os.utime(path, (1e9, 1e9), follow_symlinks=False)
        if not path.is_symlink():
            path.chmod(path.stat().st_mode & 0o700)
    made = built(other, tmp_path / "dist", TZ="Asia/Tokyo", PYTHONHASHSEED="1", LC_ALL="C")
    assert made.name == wheel.name
    assert made.read_bytes() == wheel.read_bytes()


def test_an_image_builds_from_what_it_copies(source: Path, wheel: Path, tmp_path: Path) -> None:
    """Both images copy the same; the wheel is installed by pip's line, without an index."""
    assert text_of("Containerfile.sidecar").copies == IMAGE.copies
    (line,) = [run for run in IMAGE.runs if "pip install" in run]
    options = shlex.split(line.split("pip install ")[1])
    assert options[-1] == "/source"
    options = [word.replace("/source", str(source)) for word in options[:-1]]
    offline = ["--no-index", "--no-deps", "--no-compile", "--target", str(tmp_path / "target")]
    pip("install", *options, *offline, str(wheel), PIP_ROOT_USER_ACTION="ignore")
    assert (tmp_path / "target/vram_arbiter/configs/containers/compose.yaml").exists()
    (entry_points,) = (tmp_path / "target").glob("*.dist-info/entry_points.txt")
    assert "vram-arbiter = vram_arbiter.arbiter" in entry_points.read_text()
    assert "[pytest11]\nvram_arbiter.testing.plugin = " in entry_points.read_text()
