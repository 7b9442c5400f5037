"""Interface of a GPU backend: list the GPUs, and read one of them.

Calls block and may hang as drivers do: the host runs them in a thread of their own with a deadline.
A probe never decides anything, and none creates a CUDA context.

What sources can tell beside the total. The engine derives it from each reading
(`events.MemorySampled`), since a driver may fail to list processes at any time:

| source                                   | lists_processes | lists_bytes | pids are ours     |
| ---------------------------------------- | --------------- | ----------- | ----------------- |
| NVML on a host                           | yes             | yes         | yes               |
| NVML under WSL2                          | yes             | no          | yes               |
| NVML, MIG: instances of processes told   | yes             | yes         | yes               |
| NVML, MIG: else                          | no              | no          | no                |
| NVML in a container, host's /proc known  | yes             | yes         | in this container |
| NVML in a container, host's /proc hidden | no              | no          | no                |
| unified: nvmap as root, or NVML's list   | yes             | yes         | yes               |
| unified: neither                         | no              | no          | no                |
| drm, every process may be looked at      | yes             | yes         | yes               |
| drm, else                                | no              | no          | no                |
| fake                                     | yes             | yes         | yes               |
| fake with the fault `hide_processes`     | no              | no          | no                |

A listed process that /proc does not show is named by its pid alone (`start_ticks` 0).
"""

from dataclasses import dataclass
from typing import Protocol

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.views import SensorsView


@dataclass(frozen=True, slots=True)
class GpuDevice:
    """One GPU as its backend names it; `total_bytes` without what the driver keeps for itself.

    A GPU that shares the machine's memory needs more: `margin_bytes` is its least reserve,
    `noise_bytes` its least tolerance.
    """

    id: GpuId
    index: int
    name: str
    total_bytes: int
    margin_bytes: int = 0
    noise_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of one GPU. `used_bytes` excludes the driver's own reserve.

    `processes` is None where they cannot be listed.
    """

    used_bytes: int
    total_bytes: int
    processes: tuple[ProcessUse, ...] | None


class GpuProbe(Protocol):
    """A backend. Every method blocks.

    `gpus` raises NoGpu where there is none. `sample` raises ProbeFailed when the reading fails
    (unknown, never free) and UnknownGpu for a GPU that `gpus` does not list. `sensors` leaves out
    what cannot be read; it and `close` may be called from other threads. `close` ends a hanging
    `sample` where the backend can.
    """

    def gpus(self) -> tuple[GpuDevice, ...]: ...

    def sample(self, gpu: GpuId) -> Reading: ...

    def sensors(self, gpu: GpuId) -> SensorsView: ...

    def close(self) -> None: ...
