"""Environments of manifests: made once, by uv, from a wheel that the test makes; no network."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.sidecars.conftest import MANIFEST
from tests.support.paths import ROOT
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable
from vram_arbiter.schemas.manifest import ManifestError, parse_manifest
from vram_arbiter.sidecars.environment import cache_folder, environment

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(
        shutil.which("uv", path=f"{os.environ.get('PATH')}:{Path(sys.executable).parent}") is None,
        reason="uv is not installed",
    ),
]

TINY = ["tiny-vram==1.0"]
ABOUT = "Metadata-Version: 2.1\nName: tiny-vram\nVersion: 1.0\n"
WHEEL = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of one wheel instead of an index, and a cache folder; `uv.log` has uv's calls."""
    with zipfile.ZipFile(tmp_path / "tiny_vram-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("sitecustomize.py", "import sys\nprint('entered', file=sys.stderr)\n")
        wheel.writestr("zmq.py", "HERE = True\n")  # this installation has one, too
        wheel.writestr("tiny_vram-1.0.dist-info/METADATA", ABOUT)
        wheel.writestr("tiny_vram-1.0.dist-info/WHEEL", WHEEL)
        wheel.writestr("tiny_vram-1.0.dist-info/RECORD", "")
    beside = f"{os.environ['PATH']}:{Path(sys.executable).parent}"
    uv = tmp_path / "bin/uv"
    uv.parent.mkdir()
    uv.write_text(
        f'#!/bin/sh\necho "$1" >>{tmp_path}/uv.log\nexec {shutil.which("uv", path=beside)} "$@"\n'
    )
    uv.chmod(0o755)
    for name, value in {
        "PATH": f"{uv.parent}:{os.environ['PATH']}",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "UV_CACHE_DIR": str(tmp_path / "uv-cache"),
        "UV_NO_INDEX": "1",
        "UV_FIND_LINKS": str(tmp_path),
        "UV_OFFLINE": "1",
    }.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    return tmp_path


def uv_calls(index: Path) -> list[str]:
    return (index / "uv.log").read_text().split()


def test_an_environment_is_made_once_and_anew_where_it_is_broken(index: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        made, same = pool.map(lambda _: environment(TINY, os.environ), range(2))
    assert made == same
    assert made.parent == index / "cache/vram-arbiter/environments"
    assert uv_calls(index) == ["venv", "pip"]
    ask = "import zmq, msgpack, vram_arbiter; print(zmq.HERE)"
    told = subprocess.run([made / "bin/python", "-P", "-c", ask], capture_output=True, text=True)
    assert told.stdout == "True\n", told.stderr  # its own first, this installation's behind
    assert environment([], os.environ) != made
    assert uv_calls(index) == ["venv", "pip", "venv"]
    for broken in ("bin/python", "requirements.txt"):
        (made / broken).unlink()
        assert environment(TINY, os.environ) == made
        assert (made / broken).exists()
    assert uv_calls(index)[3:] == ["venv", "pip"] * 2


@pytest.mark.heavy
def test_a_sidecar_enters_the_environment_of_its_manifest(index: Path) -> None:
    file = index / "rskill.yaml"
    file.write_text(MANIFEST.format(name="eye") + f"environment: {TINY}\n")
    arguments = ["--name", "eye", "--rskill", str(file), "--device", "none", "--check", "--json"]
    checked = subprocess.run(
        [sys.executable, "-m", "vram_arbiter.sidecars", *arguments, "--footprint", "1GB"],
        env=os.environ | {"PYTHONPATH": f"{ROOT}/src", "HF_HOME": str(index)},
        capture_output=True,
        text=True,
    )
    assert checked.returncode == 2, checked.stderr  # its weights are not here
    assert checked.stderr.count("entered") == 1
    found = {finding["what"]: finding["ok"] for finding in json.loads(checked.stdout)}
    assert (found["packages"], found["weights"]) == (True, False)


def test_packages_that_are_nowhere_are_an_error(
    index: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SidecarUnavailable, match=r"was not made.*uv's reason is on stderr"):
        environment(["no-such-package==1.0"], os.environ)
    assert "no-such-package" in capfd.readouterr().err
    assert environment(TINY, os.environ).exists()


def test_without_uv_the_error_names_it(index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(index))
    monkeypatch.setattr(sys, "executable", str(index / "python"))
    with pytest.raises(ConfigError, match=r"needs uv.*pip install uv"):
        environment(TINY, os.environ)


def test_a_cache_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file/vram-arbiter/environments: .*set XDG_CACHE_HOME"):
        environment(TINY, {"XDG_CACHE_HOME": str(tmp_path / "file")})


def test_requirements_are_no_options_of_uv_and_no_skill_without_a_sidecar_has_them() -> None:
    with pytest.raises(ManifestError, match="environment"):
        parse_manifest(MANIFEST.format(name="eye") + "environment: ['--index-url=http://x']\n")
    assert parse_manifest(MANIFEST.format(name="eye")).environment is None


def test_where_environments_are() -> None:
    assert str(cache_folder({"CACHE_DIRECTORY": "/var/cache/a:/b"})) == "/var/cache/a"
    assert str(cache_folder({"HOME": "/home/u"})) == "/home/u/.cache/vram-arbiter"
