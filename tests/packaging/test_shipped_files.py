"""Files shipped as data: the manifests load, and the constraints are plain versions."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from vram_arbiter.schemas.manifest import load_manifest

MANIFESTS = sorted((ROOT / "configs").rglob("rskill.yaml"))
CONSTRAINTS = [
    line
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if not line.startswith("#")
]


def test_shipped_manifest_loads_without_a_warning() -> None:
    assert MANIFESTS
    assert [warning for path in MANIFESTS for warning in load_manifest(path).warnings()] == []


def test_constraints_are_plain_versions() -> None:
    odd = [
        line
        for line in CONSTRAINTS
        if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9A-Za-z.]*", line)
    ]
    assert not odd, "no addresses, no local paths, no local version labels"


def test_every_version_has_hashes() -> None:
    lines = (ROOT / "constraints-hashed.txt").read_text(encoding="utf-8").splitlines()
    form = r"([\w.-]+==[\w.]+)(?: ; [^#]+?)?(?: --hash=sha256:[0-9a-f]{64})+"
    matches = {line[:80]: re.fullmatch(form, line) for line in lines}
    assert [line for line, match in matches.items() if match is None] == []
    assert sorted(match[1] for match in matches.values() if match) == sorted(CONSTRAINTS)


def test_every_dependency_is_constrained() -> None:
    page = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    sets = [
        page["project"]["dependencies"],
        *page["project"]["optional-dependencies"].values(),
        *page["dependency-groups"].values(),
    ]
    # exact versions are those of `.venv-worlds` and `.venv-vllm`: constraints.txt is `.venv`'s
    wanted = [name for names in sets for name in names if "==" not in name]
    names = {
        re.split(r"[\[<>=!~; ]", text, maxsplit=1)[0].lower().replace("_", "-") for text in wanted
    } - {"vram-arbiter"}
    assert names <= {line.partition("==")[0].lower().replace("_", "-") for line in CONSTRAINTS}


@pytest.mark.heavy
@pytest.mark.nightly
def test_the_list_of_packages_has_them_all_with_their_hashes(tmp_path: Path) -> None:
    """As `make sbom` makes it."""
    made = tmp_path / "sbom.json"
    options = ["--pyproject", "pyproject.toml", "--output-file", str(made)]
    command = [f"{Path(sys.executable).parent}/cyclonedx-py", "requirements", *options]
    subprocess.run([*command, "constraints-hashed.txt"], cwd=ROOT, check=True, capture_output=True)
    listed = json.loads(made.read_text(encoding="utf-8"))["components"]
    assert sorted(f"{one['name']}=={one['version']}" for one in listed) == sorted(CONSTRAINTS)
    assert [one["name"] for one in listed if "SHA-256" not in json.dumps(one)] == []


@pytest.mark.parametrize("script", [".ci/setup", ".ci/run", ".ci/lock"])
def test_scripts_can_be_run(script: str) -> None:
    path = ROOT / script
    assert path.stat().st_mode & 0o111
    assert path.read_text(encoding="utf-8").startswith("#!/usr/bin/env bash\n")
