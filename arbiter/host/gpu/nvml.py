"""Reader of NVIDIA cards through NVML (nvidia-ml-py, module `pynvml`).

NVML only reads: it creates no CUDA context, which alone would cost 120-550 MB of the card. It knows nothing of leases.
"""

from pathlib import Path
from typing import Any

from arbiter.core.events import ProcessUse
from arbiter.host.gpu.probe import Card, Reading
from schemas.errors import NoGpu, ProbeFailed, UnknownGpu
from schemas.fakegpu import parse_stat
from schemas.ids import GpuId, ProcessKey

_HINT = "install the NVIDIA driver, or start with --gpu fake:8GiB to simulate a card"


class NvmlProbe:
    """`GpuProbe` over all NVIDIA cards of the machine, by UUID.

    `nvml` is the module `pynvml` unless a test brings its own. Raises NoGpu without library, driver or card.
    """

    def __init__(self, nvml: Any = None) -> None:
        if nvml is None:
            import pynvml

            nvml = pynvml
        self._nvml = nvml
        try:
            nvml.nvmlInit()
        except nvml.NVMLError as error:
            raise NoGpu(f"no NVIDIA driver answers: {error}", hint=_HINT) from error
        try:
            self._handles = self._find()
        except BaseException:
            self.close()
            raise

    def _find(self) -> dict[GpuId, Any]:
        nvml = self._nvml
        handles: dict[GpuId, Any] = {}
        try:
            for index in range(nvml.nvmlDeviceGetCount()):
                handle = nvml.nvmlDeviceGetHandleByIndex(index)
                handles[GpuId(_text(nvml.nvmlDeviceGetUUID(handle)))] = handle
        except nvml.NVMLError as error:
            raise NoGpu(
                f"the NVIDIA driver cannot list its cards: {error}", hint="see nvidia-smi -L"
            ) from error
        if not handles:
            raise NoGpu("the NVIDIA driver knows no card", hint=_HINT)
        return handles

    def cards(self) -> tuple[Card, ...]:
        found = []
        for gpu, handle in self._handles.items():
            try:
                index = int(self._nvml.nvmlDeviceGetIndex(handle))
                name = _text(self._nvml.nvmlDeviceGetName(handle))
            except self._nvml.NVMLError as error:
                raise ProbeFailed(
                    f"{gpu} does not answer: {error}", hint="see nvidia-smi and dmesg"
                ) from error
            _, total, reserved = self._memory(gpu, handle)
            found.append(Card(gpu, index, name, total, reserved))
        return tuple(sorted(found, key=lambda card: card.index))

    def sample(self, gpu: GpuId) -> Reading:
        handle = self._handles.get(gpu)
        if handle is None:
            raise UnknownGpu(f"no NVIDIA card {gpu}", details={"known": sorted(self._handles)})
        used, total, _ = self._memory(gpu, handle)
        return Reading(used, total, self._processes(handle))

    def close(self) -> None:
        try:
            self._nvml.nvmlShutdown()
        except self._nvml.NVMLError:
            pass  # it was shut down already: nothing is held

    def _memory(self, gpu: GpuId, handle: Any) -> tuple[int, int, int]:
        """(used, total, reserved) in bytes. What the driver reserves for itself counts neither as used nor as there."""
        nvml = self._nvml
        try:
            try:
                info = nvml.nvmlDeviceGetMemoryInfo(handle, version=nvml.nvmlMemory_v2)
            except (nvml.NVMLError_NotSupported, nvml.NVMLError_FunctionNotFound):
                info = nvml.nvmlDeviceGetMemoryInfo(
                    handle
                )  # driver < 510: `used` includes the reserve, and it cannot be told apart
                return int(info.used), int(info.total), 0
        except nvml.NVMLError as error:
            raise ProbeFailed(
                f"memory of {gpu} cannot be read: {error}", hint="see nvidia-smi and dmesg"
            ) from error
        return int(info.used), int(info.total) - int(info.reserved), int(info.reserved)

    def _processes(self, handle: Any) -> tuple[ProcessUse, ...] | None:
        """Compute and graphics processes; None where the driver does not list them. A process in both lists counts once."""
        nvml = self._nvml
        used: dict[int, int | None] = {}
        for read in (nvml.nvmlDeviceGetComputeRunningProcesses, nvml.nvmlDeviceGetGraphicsRunningProcesses):
            try:
                listed = read(handle)
            except nvml.NVMLError:
                return None  # the total still counts: it is the list that is evidence only
            for process in listed:
                known, size = used.get(process.pid), process.usedGpuMemory
                used[process.pid] = known if size is None else max(int(size), known or 0)
        return tuple(ProcessUse(_process_key(pid), _process_name(pid), used[pid]) for pid in sorted(used))


def _process_key(pid: int) -> ProcessKey:
    """With the start time if the process can be seen from here (it may live in another pid namespace or be gone)."""
    try:
        return ProcessKey(pid, parse_stat(Path(f"/proc/{pid}/stat").read_text())[1])
    except (OSError, IndexError, ValueError):
        return ProcessKey(pid, 0)


def _process_name(pid: int) -> str:
    """Program and, for an interpreter, what it runs: `python -m sidecars` says more than `python`."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return ""
    return " ".join([Path(words[0]).name, *(word for word in words[1:3] if word)])[:128].strip()


def _text(value: str | bytes) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else value
