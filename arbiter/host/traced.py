"""The daemon's telemetry put together, on the SDK that `schemas.otel` has installed. Imported only then."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from opentelemetry import metrics, trace

from arbiter import telemetry
from arbiter.host.otel import LeaseTelemetry
from arbiter.host.otel_metrics import LeaseMetrics
from schemas import telemetry as names


class Traced:
    """`leases` goes to the executor, `log_event` too; `watch` once the core is there, `close` before the SDK ends."""

    def __init__(self) -> None:
        self._metrics = LeaseMetrics(metrics.get_meter(names.TRACER))
        self.leases = LeaseTelemetry(trace.get_tracer(names.TRACER), self._metrics)

    def log_event(self, event: Mapping[str, Any]) -> None:
        """One event of the history: as spans and numbers, and as a line of the log that names its span."""
        telemetry.log_event(event, self.leases.observe(event))

    def watch(self, loop: asyncio.AbstractEventLoop, read: Callable[[], Mapping[str, Any] | None]) -> None:
        self._metrics.watch(loop, read)

    def close(self) -> None:
        self._metrics.close()
        self.leases.close()
