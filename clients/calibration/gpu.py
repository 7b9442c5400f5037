"""Readings of one GPU, real (NVML) or simulated, and how a program is told to use that GPU.

Calls block for about a millisecond. None creates a CUDA context.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from vram_arbiter.clients import cuda
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed
from vram_arbiter.schemas.runtime.fakegpu_folder import locked, settled

_HINT = "install the NVIDIA driver, or use --device fake:FOLDER for a simulated GPU"


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: bytes in use on the GPU, and bytes by pid. `processes` None: not listed."""

    used_bytes: int
    processes: Mapping[int, int] | None


class Gpu(Protocol):
    """One GPU. `device` is its name for sidecars, `environ` limits a program to it.

    `read` raises ProbeFailed.
    """

    uuid: str
    name: str
    driver: str
    device: str
    environ: Mapping[str, str]

    def read(self) -> Reading: ...


class FakeGpu:
    """The simulated GPU in `folder`. Raises NoGpu if there is none.

    Bytes of a living process that are on their way back are still counted for it: no other process
    can have them, and a simulated peak lasts no longer than they do.
    """

    driver = "simulated"

    def __init__(self, folder: Path) -> None:
        try:
            config = fakegpu.parse_config((folder / fakegpu.GPU_FILE).read_text())
        except (OSError, UnicodeDecodeError) as error:
            raise NoGpu(
                f"no simulated GPU in {folder}: {error}",
                hint="start the arbiter with --gpu fake:8GiB",
            ) from error
        self.uuid, self.name = config.uuid, config.name
        self.device = f"fake:{folder}"
        self.environ: Mapping[str, str] = {fakegpu.FOLDER_VARIABLE: str(folder)}
        self._folder = folder

    def read(self) -> Reading:
        try:
            with locked(self._folder):
                gpu = settled(self._folder)
        except (ConfigError, OSError, UnicodeDecodeError) as error:
            raise ProbeFailed(
                f"the simulated GPU in {self._folder} cannot be read: {error}",
                hint="stop what uses it and delete the folder; the arbiter creates it again",
            ) from error
        if gpu.config.faults.hide_processes:
            return Reading(gpu.used_bytes, None)
        living = [one for one in gpu.processes.values() if one.died_at_s is None]
        return Reading(gpu.used_bytes, {one.pid: one.on_gpu_bytes for one in living})


class NvmlGpu:
    """The NVIDIA GPU number `index`, in the order of NVML and of the PCI bus.

    `nvml` is the module `pynvml` unless a test brings its own. Raises NoGpu, ConfigError for MIG.
    """

    device = "cuda"

    def __init__(self, index: int, nvml: Any = None) -> None:
        if nvml is None:
            import pynvml

            nvml = pynvml
        self._nvml = nvml
        try:
            nvml.nvmlInit()
            count = nvml.nvmlDeviceGetCount()
            if index >= count:
                raise NoGpu(f"the NVIDIA driver knows {count} GPUs, not number {index}", hint=_HINT)
            self._handle = nvml.nvmlDeviceGetHandleByIndex(index)
            self.uuid = _text(nvml.nvmlDeviceGetUUID(self._handle))
            self.name = _text(nvml.nvmlDeviceGetName(self._handle))
            self.driver = _text(nvml.nvmlSystemGetDriverVersion())
            nvml.nvmlDeviceGetMemoryInfo(self._handle)
        except nvml.NVMLError_NotSupported as error:
            raise NoGpu(
                f"GPU {index} has no memory of its own, so its bytes cannot be told apart",
                hint="write its footprint by hand",
            ) from error
        except nvml.NVMLError as error:
            raise NoGpu(f"no NVIDIA driver answers: {error}", hint=_HINT) from error
        if self._is_split():
            raise ConfigError(
                f"{self.uuid} is in MIG mode: its instances have memory of their own",
                hint=f"nvidia-smi -i {index} -mig 0",
            )
        self.environ: Mapping[str, str] = {cuda.VISIBLE: self.uuid, cuda.ORDER: cuda.PCI}

    def read(self) -> Reading:
        nvml = self._nvml
        try:
            used = int(self._memory().used)
        except nvml.NVMLError as error:
            raise ProbeFailed(
                f"memory of {self.uuid} cannot be read: {error}", hint="see nvidia-smi and dmesg"
            ) from error
        processes: dict[int, int] = {}
        for listed in (
            nvml.nvmlDeviceGetComputeRunningProcesses,
            nvml.nvmlDeviceGetGraphicsRunningProcesses,
        ):
            try:
                found = listed(self._handle)
            except nvml.NVMLError:
                return Reading(used, None)
            for process in found:
                if process.usedGpuMemory is not None:  # WSL2 and some containers list pids alone
                    known = processes.get(process.pid, 0)  # a process in both lists counts once
                    processes[process.pid] = max(known, int(process.usedGpuMemory))
        return Reading(used, processes)

    def _memory(self) -> Any:
        """`used` of version 2 leaves out what the driver reserves for itself."""
        nvml = self._nvml
        try:
            return nvml.nvmlDeviceGetMemoryInfo(self._handle, version=nvml.nvmlMemory_v2)
        except (nvml.NVMLError_NotSupported, nvml.NVMLError_FunctionNotFound):
            return nvml.nvmlDeviceGetMemoryInfo(self._handle)

    def _is_split(self) -> bool:
        try:
            return bool(self._nvml.nvmlDeviceGetMigMode(self._handle)[0])
        except self._nvml.NVMLError:
            return False  # most GPUs have no such mode


def open_gpu(device: str | None, environ: Mapping[str, str] = os.environ) -> Gpu:
    """Open the GPU of `--device`: `fake:FOLDER`, `cuda` (the first) or `cuda:N`.

    None: the simulated GPU of the environment, else `cuda`. Raises NoGpu or ConfigError.
    """
    folder = environ.get(fakegpu.FOLDER_VARIABLE)
    text = device or (f"fake:{folder}" if folder else "cuda")
    kind, _, rest = text.partition(":")
    if kind == "fake" and rest:
        return FakeGpu(Path(rest))
    if text == "cuda" or (kind == "cuda" and rest.isdecimal()):
        return NvmlGpu(int(rest or 0))
    raise ConfigError(f"--device {text} is not a device", hint="write fake:FOLDER, cuda or cuda:1")


def _text(value: str | bytes) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else value
