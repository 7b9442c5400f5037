"""Control of a compiled `libnvidia-ml.so.1` for tests (`tests/arbiter/host/gpu/nvml_stub.c`): a
text file that it reads at every call."""

import os
from dataclasses import dataclass, field
from pathlib import Path

from vram_arbiter.schemas.defaults import GIB, MIB


@dataclass
class NvmlStub:
    """One control file. `write` replaces it in one step; the library reads it at every call."""

    library: Path
    control: Path
    gpus: list[str] = field(default_factory=lambda: [f"gpu GPU-stub-0 {8 * GIB} {256 * MIB} 0"])

    @property
    def environ(self) -> dict[str, str]:
        path = os.environ.get("LD_LIBRARY_PATH")
        folders = f"{self.library}:{path}" if path else str(self.library)
        return {"LD_LIBRARY_PATH": folders, "NVML_STUB": str(self.control)}

    def write(self, *lines: str) -> None:
        """The GPUs, and what is said of them now."""
        fresh = self.control.with_suffix(".new")
        fresh.write_text("\n".join([*self.gpus, *lines]) + "\n")
        fresh.rename(self.control)

    def gpu(self, used: int, *, more: str = "") -> None:
        """One GPU of 8 GiB, of which the driver keeps 256 MiB."""
        self.gpus = [f"gpu GPU-stub-0 {8 * GIB} {256 * MIB} {used} {more}".rstrip()]

    def instances(self, *used: int) -> None:
        """One GPU in MIG mode, with instances 1, 2, … of 4 GiB, of which the driver keeps 64 MiB,
        in every second place of the driver."""
        self.gpus = [f"gpu GPU-stub-0 {8 * GIB} {256 * MIB} 0 mig"] + [
            f"instance 0 {2 * place} {place + 1} MIG-stub-{place + 1} {4 * GIB} {64 * MIB} {bytes_}"
            for place, bytes_ in enumerate(used)
        ]
