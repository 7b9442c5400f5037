"""The six import names are common words: they must mean this tree, and the base install must stay light.

Everything runs in a fresh interpreter in an empty folder: inside pytest the tree itself lies on the path and the answer
would always be the wished one.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TREE = Path(__file__).parents[2]
PACKAGES = ("arbiter", "clients", "sidecars", "runner", "reasoner", "schemas")
HEAVY = (
    "torch",
    "torchvision",
    "transformers",
    "lerobot",
    "numpy",
    "cv2",
    "mujoco",
    "cyclonedds",
    "matplotlib",
    "pynvml",
    "opentelemetry.sdk",
    "opentelemetry.exporter",
    "prometheus_client",
)

BASE_MODULES = [
    ".".join(path.relative_to(TREE).with_suffix("").parts)
    for package in ("arbiter", "clients", "schemas")
    for path in sorted((TREE / package).rglob("*.py"))
    if path.name not in ("__init__.py", "__main__.py")
]


def in_a_fresh_interpreter(code: str, folder: Path) -> str:
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=folder, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_all_import_names_come_from_this_tree(tmp_path: Path) -> None:
    code = f"""
import importlib.util, json
specs = {{name: importlib.util.find_spec(name) for name in {PACKAGES!r}}}
print(json.dumps({{name: spec and list(spec.submodule_search_locations or []) for name, spec in specs.items()}}))
"""
    origins = json.loads(in_a_fresh_interpreter(code, tmp_path))
    assert origins == {name: [str(TREE / name)] for name in PACKAGES}, (
        "another installed package uses one of our names"
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_say_that_they_are_typed(package: str) -> None:
    assert (TREE / package / "py.typed").is_file()


def test_the_base_packages_import_nothing_heavy(tmp_path: Path) -> None:
    code = f"""
import importlib, json, sys
culprits = {{}}
for name in {BASE_MODULES!r}:
    importlib.import_module(name)
    for heavy in {HEAVY!r}:
        if heavy in sys.modules:
            culprits.setdefault(heavy, name)
print(json.dumps(culprits))
"""
    assert json.loads(in_a_fresh_interpreter(code, tmp_path)) == {}, (
        "import it inside the function that needs it"
    )


@pytest.mark.parametrize("package", ["sidecars", "runner", "reasoner"])
def test_the_programs_start_without_their_models(package: str, tmp_path: Path) -> None:
    code = f"""
import importlib, json, sys
importlib.import_module("{package}.__main__")
print(json.dumps([heavy for heavy in {HEAVY!r} if heavy in sys.modules]))
"""
    assert json.loads(in_a_fresh_interpreter(code, tmp_path)) == []
