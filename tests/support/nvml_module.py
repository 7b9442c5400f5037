"""A module in the place of `pynvml`: its answers are those of GPUs given as dictionaries."""

from types import SimpleNamespace
from typing import Any

from vram_arbiter.schemas.defaults import GIB


class NVMLError(Exception):
    pass


class NotSupported(NVMLError):
    pass


class NvmlModule:
    """`NvmlModule(a_gpu(), a_gpu(uuid="GPU-2"))`; `init_error` is what `nvmlInit` raises.

    An exception under `memory_error` is raised where the memory is asked for."""

    NVMLError = NVMLError
    NVMLError_NotSupported = NotSupported
    NVMLError_FunctionNotFound = NotSupported
    nvmlMemory_v2 = 2

    def __init__(self, *gpus: dict[str, Any], init_error: Exception | None = None) -> None:
        self.gpus = gpus
        self.init_error = init_error
        self.shutdowns = 0

    def nvmlInit(self) -> None:
        if self.init_error:
            raise self.init_error
        self.shutdowns = 0

    def nvmlShutdown(self) -> None:
        self.shutdowns += 1
        if self.shutdowns > 1:
            raise NVMLError("Uninitialized")

    def nvmlDeviceGetCount(self) -> int:
        return len(self.gpus)

    def nvmlDeviceGetHandleByIndex(self, index: int) -> dict[str, Any]:
        return self.gpus[index]

    def nvmlDeviceGetUUID(self, handle: dict[str, Any]) -> str:
        return str(handle["uuid"])

    def nvmlDeviceGetName(self, handle: dict[str, Any]) -> str:
        return str(handle["name"])

    def nvmlDeviceGetMigMode(self, handle: dict[str, Any]) -> list[int]:
        raise NotSupported("Not Supported")

    def nvmlDeviceGetMemoryInfo(self, handle: dict[str, Any], version: int = 0) -> Any:
        if "memory_error" in handle:
            raise handle["memory_error"]
        return SimpleNamespace(
            total=handle["total"], reserved=handle["reserved"], used=handle["used"]
        )

    def nvmlDeviceGetComputeRunningProcesses(self, handle: dict[str, Any]) -> list[Any]:
        return [
            SimpleNamespace(pid=pid, usedGpuMemory=size) for pid, size in handle.get("compute", [])
        ]

    def nvmlDeviceGetGraphicsRunningProcesses(self, handle: dict[str, Any]) -> list[Any]:
        return []


def a_gpu(**changes: Any) -> dict[str, Any]:
    """A GPU of 8 GiB, of which 1 GiB is in use and the driver keeps a quarter."""
    return {
        "uuid": "GPU-1",
        "name": "NVIDIA GPU",
        "total": 8 * GIB,
        "reserved": GIB // 4,
        "used": GIB,
    } | changes
