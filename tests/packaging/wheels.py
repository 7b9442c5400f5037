"""The wheel as it is built, and those of the packages that it needs."""

import ensurepip
import os
import subprocess
import sys
from pathlib import Path

from tests.support.paths import ROOT


def built(source: Path, folder: Path, **environment: str) -> Path:
    """Build the wheel of a source tree into a folder."""
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    environ = {**os.environ, **environment}
    subprocess.run(build, cwd=source, check=True, capture_output=True, env=environ)
    (made,) = folder.glob("*.whl")
    return made


def pip(*arguments: str, **environment: str) -> None:
    """Run the pip that Python brings."""
    (found,) = (Path(ensurepip.__file__).parent / "_bundled").glob("pip-*.whl")
    subprocess.run(
        [sys.executable, f"{found}/pip", *arguments],
        check=True, capture_output=True, env={**os.environ, **environment},
    )  # fmt: skip


def wheels_into(folder: Path) -> None:
    """Build the wheel of this checkout, and download those of its base dependencies."""
    pip("download", "--only-binary=:all:", f"--dest={folder}", str(built(ROOT, folder)))
