"""What this process takes of the machine, as metrics: CPU time and RAM.

Read when metrics are exported, never in between. Imported only where they are.
"""

import os
import resource
from collections.abc import Iterable

from opentelemetry import metrics
from opentelemetry.metrics import CallbackOptions, Observation

from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry.names import INSTRUMENTS


def observe() -> None:
    """Create the instruments. Call it once, after the SDK's provider is set."""
    meter = metrics.get_meter(telemetry.TRACER)
    name = telemetry.METRIC_CPU_TIME
    meter.create_observable_counter(name, [_cpu_time], *INSTRUMENTS[name][:2])
    name = telemetry.METRIC_MEMORY
    meter.create_observable_up_down_counter(name, [_memory], *INSTRUMENTS[name][:2])


def _cpu_time(_: CallbackOptions) -> Iterable[Observation]:
    times = os.times()
    yield Observation(times.user, {telemetry.ATTR_CPU_MODE: "user"})
    yield Observation(times.system, {telemetry.ATTR_CPU_MODE: "system"})


def _memory(_: CallbackOptions) -> Iterable[Observation]:
    with open("/proc/self/statm", encoding="ascii") as file:
        yield Observation(int(file.read().split()[1]) * resource.getpagesize())
