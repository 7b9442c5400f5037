"""A `libnvidia-ml.so.1` that answers from a text file: the real `pynvml` loads it in a process of
its own."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.nvml_stub import NvmlStub

SOURCE = Path(__file__).with_name("nvml_stub.c")


@pytest.fixture(scope="session")
def nvml_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: libnvidia-ml.so.1 cannot be simulated")
    folder = tmp_path_factory.mktemp("nvml")
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(folder / "libnvidia-ml.so.1"), str(SOURCE)],
        check=True,
    )
    return folder


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
        assert child.stdout is not None
        assert child.stdout.readline() == b"named\n"
        assert b"(abcdefghijklmn\xc3)" in Path(f"/proc/{child.pid}/stat").read_bytes()
        yield child.pid
        child.kill()
