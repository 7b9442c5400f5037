"""The wheel holds the product and its data: no test, no training code, nothing of the test
tools."""

import ast
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.paths import ROOT

TEST_TOOLS = {"hypothesis", "pytest", "tests"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="the dependency group `dev`")
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (made,) = folder.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def names(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


def test_everything_has_one_import_name(names: list[str]) -> None:
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"vram_arbiter"}


@pytest.mark.parametrize(
    "wanted",
    [
        "vram_arbiter/__init__.py",
        "vram_arbiter/py.typed",
        "vram_arbiter/arbiter/offline/__main__.py",
        "vram_arbiter/configs/arbiter.yaml",
        "vram_arbiter/schemas/json/arbiter.json",
    ],
)
def test_the_product_and_its_data_are_there(names: list[str], wanted: str) -> None:
    assert wanted in names


def test_no_tests_and_no_training_code(names: list[str]) -> None:
    odd = [
        name
        for name in names
        if {"tests", "testing", "training"} & set(name.split("/"))
        or name.rsplit("/", 1)[-1].startswith(("test_", "conftest"))
    ]
    assert not odd


def test_the_licenses_are_there(names: list[str]) -> None:
    assert {name.rsplit("/", 1)[-1] for name in names if "/licenses/" in name} == {
        "LICENSE",
        "NOTICE",
    }


def test_the_product_imports_no_test_tool(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        importing = [
            f"{name}: {module}"
            for name in archive.namelist()
            if name.endswith(".py")
            for module in _imported(archive.read(name))
            if module in TEST_TOOLS
        ]
    assert not importing


def _imported(source: bytes) -> set[str]:
    """Return the top-level names that a module imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(str(node.module).split(".")[0])
    return found
