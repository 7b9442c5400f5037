"""Choice of the device memory that a sidecar's `--device` names."""

from pathlib import Path

from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.sidecars.device.memory import DeviceMemory


def open_memory(device: str, name: str, context_bytes: int = RESIDUE_BYTES) -> DeviceMemory:
    """Open `fake:FOLDER`, `cuda`, `cuda:N` or `none` for the process `name`. `context_bytes` are
    assumed where the GPU does not tell. Raises NoGpu or ConfigError."""
    if device == "none":
        return DeviceMemory()
    if device.startswith("fake:"):
        from vram_arbiter.sidecars.device.fake import FakeMemory

        return FakeMemory(Path(device.removeprefix("fake:")), name, context_bytes)
    from vram_arbiter.sidecars.device.cuda import CudaMemory

    index = device.partition(":")[2]
    return CudaMemory(int(index) if index else None, context_bytes)
