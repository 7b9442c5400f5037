"""An empty context on a GPU: `python -m vram_arbiter.clients.calibration.context DEVICE`.

`vramctl calibrate` measures it, and learns from it whether the driver lists bytes by process here.
Says `ready` once the context exists, and ends when its standard input is closed.
"""

import ctypes
import os
import sys
import time
from pathlib import Path

from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import fakegpu_folder, procfs


def make_cuda_context() -> None:
    """Create the primary context of the first visible GPU. Raises OSError."""
    driver = ctypes.CDLL("libcuda.so.1")
    device, context = ctypes.c_int(), ctypes.c_void_p()
    for name, arguments in (
        ("cuInit", (ctypes.c_uint(0),)),
        ("cuDeviceGet", (ctypes.byref(device), ctypes.c_int(0))),
        ("cuDevicePrimaryCtxRetain", (ctypes.byref(context), device)),
    ):
        if code := getattr(driver, name)(*arguments):
            raise OSError(f"{name} failed with CUDA error {code}")


def make_fake_context(folder: Path) -> None:
    """Create a context of the usual size on a simulated GPU. Raises SimulatedOutOfMemory."""
    key = ProcessKey(os.getpid(), procfs.start_ticks(os.getpid()) or 0)

    def touch(gpu: fakegpu.GpuState) -> fakegpu.Change:
        return fakegpu.touch(gpu, key, "context", RESIDUE_BYTES, time.monotonic())

    with fakegpu_folder.locked(folder):
        fakegpu_folder.change(folder, touch)


def main(device: str) -> int:
    try:
        if device.startswith("fake:"):
            make_fake_context(Path(device.removeprefix("fake:")))
        else:
            make_cuda_context()
    except (OSError, fakegpu.SimulatedOutOfMemory) as error:
        print(error, file=sys.stderr)
        return 1
    print("ready", flush=True)
    sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
