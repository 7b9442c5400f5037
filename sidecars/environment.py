"""Environments of packages that manifests ask for: made by uv, one for each list of requirements.

The packages of a manifest come first, this installation's behind them. An environment lies in the
cache folder, is made under a lock, and is made anew unless it was finished and its Python is there.
"""

import contextlib
import fcntl
import hashlib
import os
import shutil
import site
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import vram_arbiter
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable

MAKE_MAX_S: Final = 1800.0
"""Limit of one call of uv: torch and its libraries are 3 GB."""
MARK: Final = "requirements.txt"
"""File that a finished environment has, with the requirements."""
STDERR: Final = 2


def enter(requirements: Sequence[str] | None, arguments: Sequence[str]) -> None:
    """Start `vram-sidecar` again in the environment of the requirements, as this process; return
    where it runs there already, or there are none (None).

    Raises ConfigError without uv, SidecarUnavailable where uv fails.
    """
    if requirements is None or _finished(Path(sys.prefix), requirements):
        return
    python = str(environment(requirements, os.environ) / "bin/python")
    os.execv(python, [python, "-P", "-m", "vram_arbiter.sidecars", *arguments])


def environment(requirements: Sequence[str], environ: Mapping[str, str]) -> Path:
    """Return the folder of the environment, which is made where it is missing. Raises as
    `enter`."""
    folder = cache_folder(environ) / "environments"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}", hint="set XDG_CACHE_HOME") from error
    of = "\n".join([sys.version, *_own_folders(), *requirements])
    made = folder / hashlib.sha256(of.encode()).hexdigest()[:16]
    with _locked(made.with_suffix(".lock")):
        if not _finished(made, requirements):
            _make(made, requirements)
    return made


def cache_folder(environ: Mapping[str, str]) -> Path:
    """Return `$CACHE_DIRECTORY` under systemd, else `vram-arbiter` in the user's cache."""
    if under_systemd := environ.get("CACHE_DIRECTORY"):
        return Path(under_systemd.split(":")[0])
    home = environ.get("XDG_CACHE_HOME") or f"{environ.get('HOME', '/')}/.cache"
    return Path(home) / "vram-arbiter"


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait for another process that makes the environment; its lock ends with it."""
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _finished(folder: Path, requirements: Sequence[str]) -> bool:
    """Return whether a folder is the whole environment of the requirements."""
    try:
        mark = (folder / MARK).read_text()
    except OSError:
        return False
    return mark == _text(requirements) and (folder / "bin/python").exists()


def _make(folder: Path, requirements: Sequence[str]) -> None:
    """Make the environment; its mark is written last."""
    beside = os.pathsep.join([os.environ.get("PATH", ""), os.path.dirname(sys.executable)])
    uv = shutil.which("uv", path=beside)
    if uv is None:
        raise ConfigError(
            "the manifest's environment needs uv, which is not on PATH", hint="pip install uv"
        )
    shutil.rmtree(folder, ignore_errors=True)
    _run(uv, "venv", "--quiet", "--python", sys.executable, str(folder))
    python = folder / "bin/python"
    if requirements:
        _run(uv, "pip", "install", "--python", str(python), "--", *requirements)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "vram-arbiter.pth").write_text(_text(_own_folders()))
    (folder / MARK).write_text(_text(requirements))


def _run(*command: str) -> None:
    try:
        subprocess.run(command, check=True, stdout=STDERR, timeout=MAKE_MAX_S)
    except (OSError, subprocess.SubprocessError) as error:
        raise SidecarUnavailable(
            f"the manifest's environment was not made: {error}",
            hint="uv's reason is on stderr; the manifest's `environment` lists the packages",
        ) from error


def _own_folders() -> list[str]:
    """Return the folders of this installation's packages."""
    assert vram_arbiter.__file__ is not None, "it is a regular package"
    return list(
        dict.fromkeys([*site.getsitepackages(), str(Path(vram_arbiter.__file__).parents[1])])
    )


def _text(lines: Sequence[str]) -> str:
    return "".join(f"{line}\n" for line in lines)
