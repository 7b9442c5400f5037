"""Capacity and compute capability of the GPUs that `--device` names, read without using one."""

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vram_arbiter.clients import cuda
from vram_arbiter.schemas.errors import NoGpu
from vram_arbiter.schemas.fakegpu import GPU_FILE, FakeGpuConfig, parse_config
from vram_arbiter.schemas.runtime.nvml import devices

FAKE = "fake:"


def simulated(device: str) -> FakeGpuConfig:
    """Return the configuration of `fake:FOLDER`. Raises NoGpu, ConfigError for a wrong file."""
    path = Path(device.removeprefix(FAKE)) / GPU_FILE
    try:
        return parse_config(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise NoGpu(  # a retry may succeed: the arbiter creates the GPU's folder at its start
            f"{path} cannot be read: {error.strerror}",
            hint="start the arbiter with --gpu fake:8GiB",
        ) from error


def leased_gpu(device: str, environ: Mapping[str, str] = os.environ) -> str:
    """Return the GPU to lease for `device`: its own, so that lease and bytes cannot differ.

    The arbiter makes a simulated one: ask after it has answered. Raises NoGpu or ConfigError.
    """
    if device.startswith(FAKE):
        return simulated(device).uuid
    number = device.partition(":")[2]
    return number if number and cuda.VISIBLE not in environ else "any"


def capacities(
    device: str, environ: Mapping[str, str] = os.environ, nvml: Any = None
) -> dict[str, int]:
    """Return the bytes of the GPUs that `device` (`fake:FOLDER`, `cuda`, `cuda:N`) may mean.

    Several for `cuda` alone: the arbiter chooses one. `nvml` is the module `pynvml` unless a test
    brings its own. Raises NoGpu.
    """
    if device.startswith(FAKE):
        gpu = simulated(device)
        return {gpu.uuid: gpu.capacity_bytes}
    if nvml is None:
        import pynvml

        nvml = pynvml
    try:
        with _initialized(nvml):
            found = {
                str(nvml.nvmlDeviceGetUUID(handle)): _bytes(nvml, handle)
                for handle in visible(device, environ, nvml)
            }
    except nvml.NVMLError as error:
        raise NoGpu(
            f"no NVIDIA driver answers: {error}",
            hint="--device none checks everything but the GPU",
        ) from error
    if not found:
        raise NoGpu(
            f"the NVIDIA driver lists no GPU for --device {device}", hint="see nvidia-smi -L"
        )
    return found


def capabilities(device: str) -> list[tuple[int, int]]:
    """Return the compute capabilities of the GPUs that `cuda` or `cuda:N` may mean, without
    initializing CUDA; none where NVML does not tell."""
    import pynvml

    try:
        with _initialized(pynvml):
            return [
                tuple(pynvml.nvmlDeviceGetCudaComputeCapability(handle))
                for handle in visible(device, os.environ, pynvml)
            ]
    except pynvml.NVMLError:
        return []


@contextlib.contextmanager
def _initialized(nvml: Any) -> Iterator[None]:
    nvml.nvmlInit()
    try:
        yield
    finally:
        nvml.nvmlShutdown()


def visible(device: str, environ: Mapping[str, str], nvml: Any) -> list[Any]:
    """Return the handles of the GPUs that `cuda` or `cuda:N` may mean, of an initialized `nvml`."""
    named = environ.get(cuda.VISIBLE)
    if named is None:
        found = [one.handle for one in devices(nvml)]
    else:
        words = [word.strip() for word in named.split(",") if word.strip()]
        found = [
            nvml.nvmlDeviceGetHandleByIndex(int(word))
            if word.isdecimal()
            else nvml.nvmlDeviceGetHandleByUUID(word)
            for word in words
        ]
    number = device.partition(":")[2]
    return found[int(number) : int(number) + 1] if number else found


def _bytes(nvml: Any, handle: Any) -> int:
    """Return a GPU's own memory, or the machine's where it has none of its own (Jetson, GB10)."""
    try:
        return int(nvml.nvmlDeviceGetMemoryInfo(handle).total)
    except nvml.NVMLError_NotSupported:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
