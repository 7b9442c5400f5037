"""Everything is imported as `vram_arbiter`, and the base install must stay light.

Everything runs in a fresh interpreter in an empty folder: inside pytest the tree itself lies on the
path and the answer would always be the wished one.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PACKAGES = ("arbiter", "clients", "sidecars", "runner", "reasoner", "schemas", "testing")
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
    ".".join(("vram_arbiter", *path.relative_to(ROOT).with_suffix("").parts))
    for package in ("arbiter", "clients", "schemas", "testing")
    for path in sorted((ROOT / package).rglob("*.py"))
    if path.name not in ("__init__.py", "__main__.py")
    if {"observer", "top"}.isdisjoint(path.parts)  # these need an extra
]


def in_a_fresh_interpreter(code: str, folder: Path) -> str:
    result = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_product_has_one_import_name(tmp_path: Path) -> None:
    code = f"""
import importlib.util, json
import vram_arbiter
specs = {{name: importlib.util.find_spec(name) for name in {PACKAGES!r}}}
bare = [name for name, spec in specs.items() if spec is not None]
print(json.dumps([list(vram_arbiter.__path__), bare]))
"""
    assert json.loads(in_a_fresh_interpreter(code, tmp_path)) == [
        [str(ROOT / "src/vram_arbiter")],
        [],
    ]


def test_no_code_imports_the_bare_names() -> None:
    """A project with its own `schemas/` or `clients/` would hide ours."""
    found = subprocess.run(
        ["git", "grep", "-nE", rf"^ *(from|import) ({'|'.join(PACKAGES)})(\\.| )", "--", "*.py"],
        cwd=ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert (found.returncode, found.stdout) == (1, ""), found.stdout + found.stderr


def test_a_project_with_its_own_schemas_and_clients_can_use_ours(tmp_path: Path) -> None:
    for name in PACKAGES:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('of another project')\n")
    code = (
        "import sys, vram_arbiter.arbiter.daemon\n"
        "from vram_arbiter.clients.cli.main import run_main\n"
        "sys.exit(run_main(['doctor']))"
    )
    doctor = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert "units" in doctor.stdout, doctor.stderr


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_reached_through_links(package: str) -> None:
    link = ROOT / "src/vram_arbiter" / package
    assert link.is_symlink()
    assert link.resolve() == ROOT / package


def test_the_package_is_typed() -> None:
    assert (ROOT / "src/vram_arbiter/py.typed").is_file()


def test_base_packages_and_programs_import_nothing_heavy(tmp_path: Path) -> None:
    """A program imports its models when it is asked for one."""
    programs = [f"vram_arbiter.{name}.__main__" for name in ("sidecars", "runner", "reasoner")]
    code = f"""
import importlib, json, sys
culprits = {{}}
for name in {[*BASE_MODULES, *programs]!r}:
    importlib.import_module(name)
    for heavy in {HEAVY!r}:
        if heavy in sys.modules:
            culprits.setdefault(heavy, name)
print(json.dumps(culprits))
"""
    assert json.loads(in_a_fresh_interpreter(code, tmp_path)) == {}, (
        "import it inside the function that needs it"
    )


ASK_A_RUNNER = (
    ["goal", "test/skill", "--wait", "0.01"],
    ["state", "--wait", "0.01"],
    ["frame", "--wait", "0.01", "--out", "frame.jpg"],
    ["reset", "--wait", "0.01"],
    ["mark", "success", "--wait", "0.01"],
    ["estop", "--endpoint", "ipc:///nowhere/runner.sock"],
)


def test_a_command_that_asks_a_runner_imports_no_runner(tmp_path: Path) -> None:
    """Regression: `mark` took 2 s of a core, most of it for manifests and models of robots."""
    code = f"""
import json, sys
from vram_arbiter.runner.__main__ import main
assert [main(command) for command in {ASK_A_RUNNER!r}] == [1] * {len(ASK_A_RUNNER)}
parts = ("runner.control", "runner.robots", "runner.sim", "schemas.manifest", "schemas.config")
unwanted = {(*HEAVY, "pydantic", "yaml", "opentelemetry")!r}
print(json.dumps([
    *(name for name in unwanted if name in sys.modules),
    *(part for part in parts if f"vram_arbiter.{{part}}" in sys.modules),
]))
"""
    assert json.loads(in_a_fresh_interpreter(code, tmp_path)) == []


@pytest.mark.parametrize(
    ("program", "arguments", "code"),
    [
        pytest.param(
            "runner", ["deploy", "--config", "so101-twin", "--dry-run"], 0, marks=pytest.mark.heavy
        ),
        ("sidecars", ["--rskill", "owlv2-base", "--name", "eye", "--device", "none", "--check"], 2),
    ],
)
def test_a_check_imports_no_library_of_models_that_it_does_not_compare(
    program: str, arguments: list[str], code: int, tmp_path: Path
) -> None:
    """A robot of lerobot is made by lerobot, and weights that are here are compared with their
    model: only those checks import torch, which takes seconds of a core."""
    source = f"""
import json, os, sys
os.environ.update(VRAM_ARBITER_RUNTIME={str(tmp_path)!r}, HF_HUB_CACHE={str(tmp_path)!r})
from vram_arbiter.{program}.__main__ import main
output, sys.stdout = sys.stdout, sys.stderr
try:
    ended = main({arguments!r})
except SystemExit as end:
    ended = end.code
assert ended == {code}, ended
print(json.dumps([name for name in ("torch", "lerobot", "transformers") if name in sys.modules]),
      file=output)
"""
    assert json.loads(in_a_fresh_interpreter(source, tmp_path)) == []
