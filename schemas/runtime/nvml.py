"""NVIDIA GPUs as programs use them: of a GPU in MIG mode its instances in its place.

NVML has a handle for each compute instance (a MIG device), which its calls take like a GPU's: name,
UUID (`MIG-…`, as CUDA_VISIBLE_DEVICES takes it) and memory are those of the instance. Knows nothing
of leases. `nvml` is the module `pynvml`, initialized; every call blocks.
"""

from typing import Any, NamedTuple

from vram_arbiter.schemas.errors import ConfigError

UNKNOWN_INSTANCE = 0xFFFFFFFF
"""What NVML gives for the GPU instance of a process where it knows none."""


class Device(NamedTuple):
    """A GPU, or a GPU instance of one in MIG mode."""

    handle: Any
    instance: int | None = None  # id of the GPU instance, unique within its GPU


def devices(nvml: Any) -> list[Device]:
    """Return GPUs and instances in the driver's order: places in it are their indices.

    Raises NVMLError, or ConfigError for an instance whose memory is shared.
    """
    found = []
    for index in range(nvml.nvmlDeviceGetCount()):
        handle = nvml.nvmlDeviceGetHandleByIndex(index)
        found += _instances(nvml, index, handle) if _is_split(nvml, handle) else [Device(handle)]
    return found


def bytes_by_pid(nvml: Any, handle: Any) -> dict[int, int] | None:
    """Return what each process holds on a GPU, computing and rendering; None: it does not tell."""
    processes: dict[int, int] = {}
    for kind in ("Compute", "Graphics"):
        try:
            found = getattr(nvml, f"nvmlDeviceGet{kind}RunningProcesses")(handle)
        except nvml.NVMLError:
            return None
        for process in found:
            if process.usedGpuMemory is None:
                return None  # WSL2 and some containers list pids alone
            known = processes.get(process.pid, 0)  # a process in both lists counts once
            processes[process.pid] = max(known, int(process.usedGpuMemory))
    return processes


def _is_split(nvml: Any, handle: Any) -> bool:
    try:
        return bool(nvml.nvmlDeviceGetMigMode(handle)[0])
    except nvml.NVMLError:
        return False  # most GPUs have no such mode


def _instances(nvml: Any, index: int, gpu: Any) -> list[Device]:
    """Return the instances of a GPU in MIG mode.

    The compute instances of one GPU instance share its memory, and a process is shown one of them
    only: two of them are refused, since neither memory is its own.
    """
    found: dict[int, Device] = {}
    for place in range(nvml.nvmlDeviceGetMaxMigDeviceCount(gpu)):
        try:
            handle = nvml.nvmlDeviceGetMigDeviceHandleByIndex(gpu, place)
        except (nvml.NVMLError_NotFound, nvml.NVMLError_InvalidArgument):
            continue  # no instance has this place
        instance = int(nvml.nvmlDeviceGetGpuInstanceId(handle))
        if instance in found:
            raise ConfigError(
                f"instance {instance} of GPU {index} has several compute instances, which share "
                "its memory",
                hint=f"leave it one: nvidia-smi mig -i {index} -gi {instance} -lci lists them",
            )
        found[instance] = Device(handle, instance)
    return list(found.values())
