"""GPU memory of this process as a metric, read when metrics are exported, never in between."""

import os
from collections.abc import Iterable
from functools import cache

from opentelemetry import metrics
from opentelemetry.metrics import CallbackOptions, Observation

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.nvml import bytes_by_pid, devices
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry.names import INSTRUMENTS


def observe_gpu() -> None:
    """Create the instrument of GPU memory, for a program that renders or decodes on a GPU.

    Not for all: a driver that hangs would hang the export with it. Without an SDK nothing is read.
    """
    name = telemetry.METRIC_GPU_MEMORY
    meter = metrics.get_meter(telemetry.TRACER)
    meter.create_observable_gauge(name, [_gpu_memory], *INSTRUMENTS[name][:2])


@cache
def _nvml() -> bool:
    """Return whether this machine's NVML is open now; it stays so for the life of the process."""
    import pynvml

    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return False
    return True


def _gpu_memory(_: CallbackOptions) -> Iterable[Observation]:
    """Return nothing without NVML, or for a GPU that does not tell what a process holds."""
    if not _nvml():
        return []
    import pynvml

    found = []
    try:
        for handle, _ in devices(pynvml):
            if (held := bytes_by_pid(pynvml, handle)) is not None:
                labels = {telemetry.ATTR_GPU: pynvml.nvmlDeviceGetUUID(handle)}
                found.append(Observation(held.get(os.getpid(), 0), labels))
    except (pynvml.NVMLError, ConfigError):  # the driver restarts, or the GPU fell off the bus
        pass
    return found
