"""Reader of NVIDIA GPUs through NVML (nvidia-ml-py, module `pynvml`).

NVML only reads: it creates no CUDA context, which alone would cost 120-550 MB of the GPU. It knows
nothing of leases.

MIG, by NVML's documentation: memory and processes of a whole GPU are told to privileged callers
only; those of an instance to all, by its own handle, but not below a vGPU host. A handle "may be
reused and its properties can change" once its instance is destroyed, so each reading asks whose it
is.
"""

import threading
from collections.abc import Callable
from typing import Any

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, Reading
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.runtime.nvml import UNKNOWN_INSTANCE, Device, devices
from vram_arbiter.schemas.wire.views import SensorsView

_HINT = (
    "install the NVIDIA driver, or start with --gpu drm for GPUs of AMD and Intel, or with --gpu "
    "fake:8GiB to simulate one"
)


class NvmlProbe:
    """`GpuProbe` over all NVIDIA GPUs and MIG instances of the machine, by UUID.

    `nvml` is the module `pynvml` unless a test brings its own. Raises NoGpu without library, driver
    or GPU, ConfigError for an instance without memory of its own. When no GPU answers any more,
    everything is opened anew: after a reset of the driver old handles are dead.
    """

    def __init__(self, nvml: Any = None, pids: PidMap | None = None) -> None:
        if nvml is None:
            import pynvml

            nvml = pynvml
        self._nvml = nvml
        self._pids = pids or PidMap()
        self._lock = threading.Lock()
        self._failing: set[GpuId] = set()
        self._devices = self._open()

    def _open(self) -> dict[GpuId, Device]:
        """Return all GPUs. Nothing stays open where that raises."""
        nvml = self._nvml
        try:
            nvml.nvmlInit()
        except nvml.NVMLError as error:
            raise NoGpu(f"no NVIDIA driver answers: {error}", hint=_HINT) from error
        try:
            found = {
                GpuId(_text(nvml.nvmlDeviceGetUUID(device.handle))): device
                for device in devices(nvml)
            }
            if not found:
                told = "the NVIDIA driver knows no GPU, or of one in MIG mode no instance"
                raise NoGpu(told, hint=_HINT)
        except nvml.NVMLError as error:
            self.close()
            raise NoGpu(
                f"the NVIDIA driver cannot list its GPUs: {error}", hint="see nvidia-smi -L"
            ) from error
        except BaseException:
            self.close()
            raise
        return found

    def _reopen_if_dead(self) -> None:
        """While another GPU still answers, its readings are not disturbed."""
        with self._lock:
            if len(self._failing) < len(self._devices):
                return
            self.close()
            try:
                found = self._open()
            except (NoGpu, ConfigError) as error:
                raise ProbeFailed(error.message, hint=error.hint) from error
            if lost := sorted(self._devices.keys() - found.keys()):
                raise ProbeFailed(
                    f"the NVIDIA driver no longer lists {', '.join(lost)}", hint="see dmesg"
                )
            self._devices = found
            self._failing.clear()

    def gpus(self) -> tuple[GpuDevice, ...]:
        found = []
        for index, gpu in enumerate(self._devices):
            name = _text(self._ask(gpu, self._nvml.nvmlDeviceGetName))
            _, total = self._memory(gpu)
            found.append(GpuDevice(gpu, index, name, total))
        return tuple(found)

    def sample(self, gpu: GpuId) -> Reading:
        if gpu not in self._devices:
            raise UnknownGpu(f"no NVIDIA GPU {gpu}", details={"known": sorted(self._devices)})
        self._reopen_if_dead()
        try:
            self._identify(gpu)
            used, total = self._memory(gpu)
        except ProbeFailed:
            self._failing.add(gpu)
            raise
        self._failing.discard(gpu)
        return Reading(used, total, self.processes(gpu))

    def sensors(self, gpu: GpuId) -> SensorsView:
        """Instances of a GPU have none: temperature and power are the board's, and NVML measures
        the utilization of whole GPUs alone."""
        nvml, (handle, instance) = self._nvml, self._devices[gpu]
        if instance is not None:
            return SensorsView()

        def told(call: Callable[[Any], float]) -> float | None:
            try:
                return call(handle)
            except nvml.NVMLError:
                return None

        return SensorsView(
            told(lambda gpu: nvml.nvmlDeviceGetUtilizationRates(gpu).gpu / 100),
            told(lambda gpu: float(nvml.nvmlDeviceGetTemperature(gpu, nvml.NVML_TEMPERATURE_GPU))),
            told(lambda gpu: nvml.nvmlDeviceGetPowerUsage(gpu) / 1000),  # milliwatts
        )

    def memory_supported(self) -> bool:
        """False where the GPU has no memory of its own (GB10): NVML says NOT_SUPPORTED. Other
        failures may pass."""
        device = next(iter(self._devices.values()))
        try:
            self._nvml.nvmlDeviceGetMemoryInfo(device.handle)
        except self._nvml.NVMLError_NotSupported:
            return False
        except self._nvml.NVMLError:
            return True
        return True

    def first(self) -> tuple[GpuId, str]:
        """Id and name of the first GPU. Raises ProbeFailed."""
        gpu = next(iter(self._devices))
        return gpu, _text(self._ask(gpu, self._nvml.nvmlDeviceGetName))

    def _ask(self, gpu: GpuId, call: Callable[[Any], Any]) -> Any:
        try:
            return call(self._devices[gpu].handle)
        except self._nvml.NVMLError as error:
            raise ProbeFailed(
                f"{gpu} does not answer: {error}", hint="see nvidia-smi and dmesg"
            ) from error

    def close(self) -> None:
        try:
            self._nvml.nvmlShutdown()
        except self._nvml.NVMLError:
            pass  # it was shut down already: nothing is held

    def _identify(self, gpu: GpuId) -> None:
        """Raises ProbeFailed for a handle that stands for another instance by now."""
        if (now := _text(self._ask(gpu, self._nvml.nvmlDeviceGetUUID))) != gpu:
            raise ProbeFailed(f"{gpu} is gone, {now} is in its place", hint="see nvidia-smi -L")

    def _memory(self, gpu: GpuId) -> tuple[int, int]:
        """(used, total) in bytes. What the driver reserves for itself counts neither as
        used nor as there."""
        nvml, handle = self._nvml, self._devices[gpu].handle
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

    def processes(self, gpu: GpuId) -> tuple[ProcessUse, ...] | None:
        """Return compute and graphics processes; None where the driver does not list them, or not
        by instance. A process in both lists counts once."""
        nvml, (handle, instance) = self._nvml, self._devices[gpu]
        if not self._pids.knows:
            return None
        used: dict[int, int | None] = {}
        for read in (
            nvml.nvmlDeviceGetComputeRunningProcesses,
            nvml.nvmlDeviceGetGraphicsRunningProcesses,
        ):
            try:
                listed = _within(instance, read(handle))
            except nvml.NVMLError:
                listed = None
            if listed is None:
                return None  # the total still counts: it is the list that is evidence only
            for process in listed:
                known, size = used.get(process.pid), process.usedGpuMemory
                used[process.pid] = known if size is None else max(int(size), known or 0)
        return tuple(ProcessUse(*self._pids.translate(pid), used[pid]) for pid in sorted(used))


def _within(instance: int | None, listed: list[Any]) -> list[Any] | None:
    """Return the processes on an instance, or on a GPU that has none; None: one may be anywhere."""
    if instance is None:
        return listed
    if any(process.gpuInstanceId == UNKNOWN_INSTANCE for process in listed):
        return None
    return [process for process in listed if process.gpuInstanceId == instance]


def _text(value: str | bytes) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else value
