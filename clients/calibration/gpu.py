"""Readings of one GPU, real (NVML) or simulated, and how a program is told to use that GPU.

A reading blocks for about a millisecond. None creates a CUDA context.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vram_arbiter.clients import cuda
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed
from vram_arbiter.schemas.runtime.fakegpu_folder import locked, settled
from vram_arbiter.schemas.runtime.nvml import bytes_by_pid, devices

_HINT = "install the NVIDIA driver, or use --device fake:FOLDER for a simulated GPU"


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: bytes in use on the GPU, and bytes by pid. `processes` None: not listed."""

    used_bytes: int
    processes: Mapping[int, int] | None


@dataclass(frozen=True, slots=True)
class Gpu:
    """One GPU. `device` is its name for sidecars, `environ` limits a program to it; `read` raises
    ProbeFailed or NoGpu."""

    uuid: str
    name: str
    driver: str
    total_bytes: int
    device: str
    environ: Mapping[str, str]
    read: Callable[[], Reading]


def open_gpu(device: str | None, environ: Mapping[str, str] = os.environ) -> Gpu:
    """Open the GPU of `--device`: `fake:FOLDER`, `cuda` (the first) or `cuda:N`.

    None: the simulated GPU of the environment, else `cuda`. Raises NoGpu or ConfigError.
    """
    folder = environ.get(fakegpu.FOLDER_VARIABLE)
    text = device or (f"fake:{folder}" if folder else "cuda")
    kind, _, rest = text.partition(":")
    if kind == "fake" and rest:
        return fake_gpu(Path(rest))
    if text == "cuda" or (kind == "cuda" and rest.isdecimal()):
        import pynvml

        return nvml_gpu(int(rest or 0), pynvml)
    raise ConfigError(f"--device {text} is not a device", hint="write fake:FOLDER, cuda or cuda:1")


def fake_gpu(folder: Path) -> Gpu:
    """Open the simulated GPU in `folder`. Raises NoGpu if there is none.

    Bytes of a living process that are on their way back are still counted for it: no other process
    can have them, and a simulated peak lasts no longer than they do.
    """

    def state() -> fakegpu.GpuState:
        try:
            with locked(folder):
                return settled(folder)
        except (ConfigError, OSError, UnicodeDecodeError) as error:
            raise NoGpu(
                f"no simulated GPU can be read in {folder}: {error}",
                hint="start the arbiter with --gpu fake:8GiB; it creates the folder again",
            ) from error

    def read() -> Reading:
        gpu = state()
        if gpu.config.faults.hide_processes:
            return Reading(gpu.used_bytes, None)
        living = [one for one in gpu.processes.values() if one.died_at_s is None]
        return Reading(gpu.used_bytes, {one.pid: one.on_gpu_bytes for one in living})

    config, environ = state().config, {fakegpu.FOLDER_VARIABLE: str(folder)}
    total = config.capacity_bytes
    return Gpu(config.uuid, config.name, "simulated", total, f"fake:{folder}", environ, read)


def nvml_gpu(index: int, nvml: Any) -> Gpu:
    """Open the NVIDIA GPU or MIG instance number `index`, in the order of NVML and of the PCI bus.
    `nvml` is the module `pynvml`. Raises NoGpu or ConfigError."""

    def read() -> Reading:
        try:
            return Reading(nvml.nvmlDeviceGetMemoryInfo(handle).used, bytes_by_pid(nvml, handle))
        except nvml.NVMLError as error:
            problem = f"memory of GPU {index} cannot be read: {error}"
            raise ProbeFailed(problem, hint="see nvidia-smi and dmesg") from error

    try:
        nvml.nvmlInit()
        handle = devices(nvml)[index].handle
        uuid, name = nvml.nvmlDeviceGetUUID(handle), nvml.nvmlDeviceGetName(handle)
        driver = nvml.nvmlSystemGetDriverVersion()
        total = nvml.nvmlDeviceGetMemoryInfo(handle).total
    except (nvml.NVMLError, IndexError) as error:
        raise NoGpu(f"no NVIDIA driver answers for GPU {index}: {error}", hint=_HINT) from error
    environ = {cuda.VISIBLE: uuid, cuda.ORDER: cuda.PCI}
    return Gpu(uuid, name, driver, total, "cuda", environ, read)
