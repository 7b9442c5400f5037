"""A `libnvidia-ml.so.1` that answers from a text file: the real `pynvml` loads it in a process of
its own."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.support.nvml_stub import NvmlStub

HERE = Path(__file__).parent


def compiled(source: str, library: Path) -> Path:
    """Compile a library of one file; skips the test without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip(f"no C compiler: {library.name} cannot be simulated")
    command = [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(HERE / source)]
    subprocess.run(command, check=True)
    return library


def answer_of_child(code: str, *arguments: str, environ: Mapping[str, str], text: str = "") -> Any:
    """Return what a child process that runs `code` prints as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, **environ},
        input=text,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="session")
def nvml_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nvml")
    return compiled("nvml_stub.c", folder / "libnvidia-ml.so.1").parent


@pytest.fixture(scope="session")
def xe_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """To be loaded before the C library (LD_PRELOAD)."""
    return compiled("xe_stub.c", tmp_path_factory.mktemp("xe") / "xe.so")


@pytest.fixture
def nvml(nvml_library: Path, tmp_path: Path) -> Iterator[NvmlStub]:
    stub = NvmlStub(nvml_library, tmp_path / "nvml.txt")
    stub.write()
    yield stub
    stub.write()  # lets a hanging call return


NAMED = """
open("/proc/self/comm", "wb").write("abcdefghijklmnü".encode())
print("named", flush=True)
input()
"""


@pytest.fixture
def half_a_letter() -> Iterator[int]:
    """The pid of a process whose name the kernel cut after 15 bytes, in the middle of a letter."""
    with subprocess.Popen(
        [sys.executable, "-c", NAMED],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as child:
        assert child.stdout.readline() == b"named\n"
        assert b"(abcdefghijklmn\xc3)" in Path(f"/proc/{child.pid}/stat").read_bytes()
        yield child.pid
        child.kill()
