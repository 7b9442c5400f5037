"""Reader of NVIDIA GPUs through NVML (nvidia-ml-py, module `pynvml`).

NVML only reads: it creates no CUDA context, which alone would cost 120-550 MB of the GPU. It knows
nothing of leases.
"""

import threading
from collections.abc import Callable
from typing import Any

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, Reading
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId

_HINT = "install the NVIDIA driver, or start with --gpu fake:8GiB to simulate a GPU"


class NvmlProbe:
    """`GpuProbe` over all NVIDIA GPUs of the machine, by UUID.

    `nvml` is the module `pynvml` unless a test brings its own. Raises NoGpu without library, driver
    or GPU, ConfigError for a GPU in MIG mode. When no GPU answers any more, everything is opened
    anew: after a reset of the driver old handles are dead.
    """

    def __init__(self, nvml: Any = None, pids: PidMap | None = None) -> None:
        if nvml is None:
            import pynvml

            nvml = pynvml
        self._nvml = nvml
        self._pids = pids or PidMap()
        self._lock = threading.Lock()
        self._failing: set[GpuId] = set()
        self._handles = self._open()

    def _open(self) -> dict[GpuId, Any]:
        """Return the handles of all GPUs. Nothing stays open where that raises."""
        nvml, handles = self._nvml, dict[GpuId, Any]()
        try:
            nvml.nvmlInit()
        except nvml.NVMLError as error:
            raise NoGpu(f"no NVIDIA driver answers: {error}", hint=_HINT) from error
        try:
            for index in range(nvml.nvmlDeviceGetCount()):
                handle = nvml.nvmlDeviceGetHandleByIndex(index)
                gpu = GpuId(_text(nvml.nvmlDeviceGetUUID(handle)))
                if self._is_split(handle):
                    raise ConfigError(
                        f"{gpu} is in MIG mode: its instances have memory of their own, which "
                        "cannot be leased",
                        hint=f"nvidia-smi -i {index} -mig 0",
                    )
                handles[gpu] = handle
            if not handles:
                raise NoGpu("the NVIDIA driver knows no GPU", hint=_HINT)
        except nvml.NVMLError as error:
            self.close()
            raise NoGpu(
                f"the NVIDIA driver cannot list its GPUs: {error}", hint="see nvidia-smi -L"
            ) from error
        except BaseException:
            self.close()
            raise
        return handles

    def _is_split(self, handle: Any) -> bool:
        try:
            return bool(self._nvml.nvmlDeviceGetMigMode(handle)[0])
        except self._nvml.NVMLError:
            return False  # most GPUs have no such mode

    def _reopen_if_dead(self) -> None:
        """While another GPU still answers, its readings are not disturbed."""
        with self._lock:
            if len(self._failing) < len(self._handles):
                return
            self.close()
            try:
                found = self._open()
            except (NoGpu, ConfigError) as error:
                raise ProbeFailed(error.message, hint=error.hint) from error
            if lost := sorted(self._handles.keys() - found.keys()):
                raise ProbeFailed(
                    f"the NVIDIA driver no longer lists {', '.join(lost)}", hint="see dmesg"
                )
            self._handles = found
            self._failing.clear()

    def gpus(self) -> tuple[GpuDevice, ...]:
        found = []
        for gpu, handle in self._handles.items():
            index = int(self._ask(gpu, self._nvml.nvmlDeviceGetIndex))
            name = _text(self._ask(gpu, self._nvml.nvmlDeviceGetName))
            _, total = self._memory(gpu, handle)
            found.append(GpuDevice(gpu, index, name, total))
        return tuple(sorted(found, key=lambda device: device.index))

    def sample(self, gpu: GpuId) -> Reading:
        if gpu not in self._handles:
            raise UnknownGpu(f"no NVIDIA GPU {gpu}", details={"known": sorted(self._handles)})
        self._reopen_if_dead()
        handle = self._handles[gpu]
        try:
            used, total = self._memory(gpu, handle)
        except ProbeFailed:
            self._failing.add(gpu)
            raise
        self._failing.discard(gpu)
        return Reading(used, total, self._processes(handle))

    def memory_supported(self) -> bool:
        """False where the GPU has no memory of its own (GB10): NVML says NOT_SUPPORTED. Other
        failures may pass."""
        handle = next(iter(self._handles.values()))
        try:
            self._nvml.nvmlDeviceGetMemoryInfo(handle)
        except self._nvml.NVMLError_NotSupported:
            return False
        except self._nvml.NVMLError:
            return True
        return True

    def first(self) -> tuple[GpuId, str]:
        """Id and name of the first GPU. Raises ProbeFailed."""
        gpu = next(iter(self._handles))
        return gpu, _text(self._ask(gpu, self._nvml.nvmlDeviceGetName))

    def processes(self, gpu: GpuId) -> tuple[ProcessUse, ...] | None:
        """Return the processes on a GPU; None where the driver does not list them."""
        return self._processes(self._handles[gpu])

    def _ask(self, gpu: GpuId, call: Callable[[Any], Any]) -> Any:
        try:
            return call(self._handles[gpu])
        except self._nvml.NVMLError as error:
            raise ProbeFailed(
                f"{gpu} does not answer: {error}", hint="see nvidia-smi and dmesg"
            ) from error

    def close(self) -> None:
        try:
            self._nvml.nvmlShutdown()
        except self._nvml.NVMLError:
            pass  # it was shut down already: nothing is held

    def _memory(self, gpu: GpuId, handle: Any) -> tuple[int, int]:
        """(used, total) in bytes. What the driver reserves for itself counts neither as
        used nor as there."""
        nvml = self._nvml
        try:
            try:
                info = nvml.nvmlDeviceGetMemoryInfo(handle, version=nvml.nvmlMemory_v2)
            except (nvml.NVMLError_NotSupported, nvml.NVMLError_FunctionNotFound):
                # driver < 510: `used` includes the reserve, and it cannot be told apart
                info = nvml.nvmlDeviceGetMemoryInfo(handle)
                return int(info.used), int(info.total)
        except nvml.NVMLError as error:
            raise ProbeFailed(
                f"memory of {gpu} cannot be read: {error}", hint="see nvidia-smi and dmesg"
            ) from error
        return int(info.used), int(info.total) - int(info.reserved)

    def _processes(self, handle: Any) -> tuple[ProcessUse, ...] | None:
        """Compute and graphics processes; None where the driver does not list them. A process in
        both lists counts once."""
        nvml = self._nvml
        if not self._pids.knows:
            return None
        used: dict[int, int | None] = {}
        for read in (
            nvml.nvmlDeviceGetComputeRunningProcesses,
            nvml.nvmlDeviceGetGraphicsRunningProcesses,
        ):
            try:
                listed = read(handle)
            except nvml.NVMLError:
                return None  # the total still counts: it is the list that is evidence only
            for process in listed:
                known, size = used.get(process.pid), process.usedGpuMemory
                used[process.pid] = known if size is None else max(int(size), known or 0)
        return tuple(ProcessUse(*self._pids.translate(pid), used[pid]) for pid in sorted(used))


def _text(value: str | bytes) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else value
