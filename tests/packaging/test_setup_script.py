"""The set-up script finds an interpreter that works, and says what to do when there is none."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

TOOLS = ("bash", "cat", "cksum", "dirname", "env", "grep", "rm", "uname")


HASHED = "constraints-hashed.txt"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of what the script reads, in a folder without environments, and a PATH with nothing
    but the basic tools."""
    folder = tmp_path / "project"
    (folder / ".ci").mkdir(parents=True)
    for name in (".ci/setup", "pyproject.toml", HASHED):
        shutil.copy(ROOT / name, folder / name)
    (folder / "bin").mkdir()
    for tool in TOOLS:
        found = shutil.which(tool)
        assert found is not None
        (folder / "bin" / tool).symlink_to(found)
    return folder


def script(folder: Path, name: str, body: str) -> None:
    path = folder / "bin" / name
    path.write_text(f"#!{folder}/bin/bash\n{body}\n", encoding="utf-8")
    path.chmod(0o755)


def set_up(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(folder / ".ci/setup"), *arguments],
        env={"PATH": str(folder / "bin"), "HOME": str(folder)} | environment,
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("arguments", [[], ["everything"]])
def test_usage(project: Path, arguments: list[str]) -> None:
    result = set_up(project, *arguments)
    assert result.returncode == 2
    assert result.stderr == "usage: .ci/setup full|core|worlds|vllm\n"


def test_without_uv_and_python_it_says_what_to_install(project: Path) -> None:
    # a shim that refuses
    script(project, "python3.12", "echo 'pyenv: python3.12: command not found' >&2; exit 127")
    result = set_up(project, "core")
    assert result.returncode == 1
    assert "neither uv nor a working Python was found" in result.stderr
    assert "apt-get install python3" in result.stderr


def test_with_uv_but_no_python_it_asks_uv_and_names_the_remedy(project: Path) -> None:
    script(project, "uv", '[ "$1" = --version ] && exit 0; echo "uv $*" >&2; exit 1')
    result = set_up(project, "core")
    assert result.returncode == 1
    assert "uv python install 3.12" in result.stderr
    assert "pyenv install 3.12" in result.stderr


def test_it_takes_the_first_interpreter_that_works_and_works_once(project: Path) -> None:
    log = project / "log"
    script(project, "python3.12", "exit 127")
    (project / "bin" / "python3.13").symlink_to(sys.executable)
    script(
        project,
        "uv",
        f'[ "$1" = --version ] && exit 0; echo "$*" >>{log}; [ "$1" != venv ] || '
        f'{{ mkdir -p "${{@: -1}}/bin"; ln -s {sys.executable} "${{@: -1}}/bin/python"; }}',
    )
    (project / "bin" / "mkdir").symlink_to(str(shutil.which("mkdir")))
    (project / "bin" / "ln").symlink_to(str(shutil.which("ln")))
    first = set_up(project, "core")
    assert first.returncode == 0, first.stderr
    made, *installed = log.read_text(encoding="utf-8").splitlines()
    assert made == f"venv --quiet --clear --python {project}/bin/python3.13 .venv-core"
    pinned = f"--python .venv-core/bin/python -c {HASHED} -b {HASHED}"
    listed = ".venv-core/requirements.txt"
    assert installed == [
        f"pip compile --quiet {pinned} --group dev -o {listed} pyproject.toml",
        f"pip install {pinned} --require-hashes -r {listed}",
        f"pip install {pinned} --no-deps -e .",
    ]

    assert set_up(project, "core").returncode == 0
    assert len(log.read_text(encoding="utf-8").splitlines()) == 4, "nothing changed, nothing to do"

    with open(project / HASHED, "a", encoding="utf-8") as file:
        file.write("# changed\n")
    assert set_up(project, "core").returncode == 0
    assert log.read_text(encoding="utf-8").splitlines()[4:] == installed, (
        "only the packages are installed anew"
    )


def test_python_can_be_chosen(project: Path) -> None:
    script(project, "uv", '[ "$1" = --version ] && exit 0; echo "uv $*" >&2; exit 1')
    (project / "bin" / "python3.13").symlink_to(sys.executable)
    result = set_up(project, "core", PYTHON=os.path.realpath(sys.executable))
    assert f"making .venv-core with {os.path.realpath(sys.executable)}" in result.stderr


@pytest.fixture
def full(project: Path) -> Path:
    """`.ci/setup full` gets as far as the packages here: its uv makes an environment and keeps a
    log, nothing is installed."""
    log = project / "log"
    script(
        project,
        "uv",
        f'[ "$1" = --version ] && exit 0; echo "uv $*" >>{log}; '
        f'case "$*" in *"--extra gstreamer"*) [ ! -e {project}/unbuildable ] || exit 1 ;; esac; '
        '[ "$1" != venv ] || { mkdir -p "${@: -1}/bin"; '
        f'ln -s {sys.executable} "${{@: -1}}/bin/python"; }}',
    )
    for tool in ("mkdir", "ln", "touch"):
        (project / "bin" / tool).symlink_to(str(shutil.which(tool)))
    (project / "bin" / "python3.12").symlink_to(sys.executable)
    script(project, "id", f"echo $(<{project}/uid)")
    (project / "uid").write_text("1000\n", encoding="utf-8")
    script(project, "pkg-config", f"[ -e {project}/headers ]")
    script(project, "dpkg", f"[ -e {project}/headers ]")
    script(
        project,
        "apt-get",
        f'echo "apt-get $*" >>{log}; [ ! -e {project}/offline ] || exit 100; touch '
        f"{project}/headers",
    )
    return project


def installed(project: Path) -> list[str]:
    """The extras that uv was asked for, in order; robosuite comes without its dependencies."""
    lines = (project / "log").read_text(encoding="utf-8").splitlines()
    asked = [line for line in lines if line.startswith("uv pip")]
    assert asked[-1].endswith("--require-hashes --no-deps -r .venv/robosuite.txt")
    return [" ".join(re.findall(r"--extra (\w+)", line)) for line in asked if " compile " in line]


def test_without_gstreamer_everything_else_is_installed_and_what_is_missing_is_said(
    full: Path,
) -> None:
    result = set_up(full, "full")
    assert result.returncode == 0, result.stderr
    assert "cameras through GStreamer are left out" in result.stderr
    assert "sudo apt-get install gcc libc6-dev pkg-config libgirepository1.0-dev" in result.stderr
    assert installed(full) == ["all ray"]
    assert "apt-get" not in (full / "log").read_text(encoding="utf-8"), "only root may"


def test_the_product_is_compiled_where_python_writes_no_bytecode(full: Path) -> None:
    module = full / "src/vram_arbiter/arbiter/daemon.py"
    module.parent.mkdir(parents=True)
    module.touch()
    assert set_up(full, "full", PYTHONDONTWRITEBYTECODE="1").returncode == 0
    assert list(module.parent.glob("__pycache__/daemon.*.pyc"))


def test_libraries_that_came_later_are_a_reason_to_begin_again(full: Path) -> None:
    assert set_up(full, "full").returncode == 0
    assert set_up(full, "full").returncode == 0
    assert installed(full) == ["all ray"]
    (full / "headers").touch()
    result = set_up(full, "full")
    assert result.returncode == 0, result.stderr
    assert installed(full) == ["all ray", "all ray gstreamer"]
    assert set_up(full, "full").returncode == 0
    assert len(installed(full)) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="apt is Linux's")
def test_root_gets_the_libraries_by_apt(full: Path) -> None:
    (full / "uid").write_text("0\n", encoding="utf-8")
    result = set_up(full, "full")
    assert result.returncode == 0, result.stderr
    assert "left out" not in result.stderr
    first, second = [
        line
        for line in (full / "log").read_text(encoding="utf-8").splitlines()
        if line.startswith("apt-get")
    ][:2]
    assert first == "apt-get update -qq"
    assert second.startswith("apt-get install -y -qq")
    assert "gstreamer1.0-plugins-good" in second
    assert installed(full) == ["all ray gstreamer"]


@pytest.mark.parametrize("trouble", ["offline", "unbuildable"])
def test_trouble_with_gstreamer_stops_nothing_else(full: Path, trouble: str) -> None:
    (full / "uid").write_text("0\n", encoding="utf-8")
    (full / trouble).touch()
    result = set_up(full, "full")
    if trouble == "offline" and "installing EGL" in result.stderr:
        pytest.skip("this machine lacks EGL, too, and that is wanted")
    assert result.returncode == 0, result.stderr
    assert "cameras through GStreamer are left out" in result.stderr
    assert installed(full)[-1] == "all ray"
