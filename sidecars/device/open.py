"""Choice of the device memory that a sidecar's settings name."""

from pathlib import Path

from vram_arbiter.sidecars.device.memory import DeviceMemory
from vram_arbiter.sidecars.settings import Settings


def open_memory(settings: Settings) -> DeviceMemory:
    """Open the device of the settings. Raises NoGpu or ConfigError."""
    if settings.device == "none":
        return DeviceMemory()
    if settings.device.startswith("fake:"):
        from vram_arbiter.sidecars.device.fake import FakeMemory

        folder = Path(settings.device.removeprefix("fake:"))
        return FakeMemory(folder, settings.name, settings.footprint.residue_bytes)
    from vram_arbiter.sidecars.device.cuda import CudaMemory

    index = settings.device.partition(":")[2]
    return CudaMemory(int(index) if index else None, settings.footprint.residue_bytes)
