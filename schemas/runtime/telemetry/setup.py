"""Installs the OpenTelemetry SDK where the environment or a program's configuration asks for it.

Nothing of OpenTelemetry is imported, and nothing runs, unless it is asked for (`plan`). Only
`prometheus` is our own server, which limits what a local process may cost it and listens on
loopback alone, because it does not authenticate.
Names of spans and metrics are in `names`, the calls in `spans`.
"""

import atexit
import errno
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.telemetry import exported
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry.plan import (
    Plan,
    Signal,
    entry_point,
    not_installed,
    plan,
)

log = logging.getLogger(__name__)

FLUSH_S = 5.0
"""Longest wait for a collector at a program's end."""
EXPORT_S = 3.0
"""Time limit of one OTLP export unless a variable sets it; the SDK's 10 s outlast FLUSH_S."""
SAY_AGAIN_S = 300.0
"""Interval between two complaints about a collector that is away."""


class Telemetry:
    """Result of `set_up`: call it at the program's end to send what is left. `on`: the SDK runs."""

    def __init__(
        self, ends: Sequence[Callable[[], object]] = (), prometheus_port: int | None = None
    ) -> None:
        self.on = bool(ends)
        self.prometheus_port = prometheus_port
        self._over = threading.Event()
        # One thread each: an exporter that waits for a silent collector does not look at the clock.
        # Started now: no thread can start while the interpreter ends.
        self._threads = [
            threading.Thread(target=self._end, args=(end,), name="telemetry-end", daemon=True)
            for end in ends
        ]
        for thread in self._threads:
            thread.start()

    def __call__(self, timeout_s: float = FLUSH_S) -> None:
        if self._over.is_set():
            return
        self._over.set()
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _end(self, end: Callable[[], object]) -> None:
        self._over.wait()
        try:
            end()
        except Exception as error:  # noqa: BLE001 - a failed export must not fail the program
            log.warning("telemetry ended badly: %s", error)


_installed: Telemetry | None = None  # the SDK's providers can be set once per process


def set_up(
    service: str,
    *,
    environ: Mapping[str, str] = os.environ,
    endpoint: str | None = None,
    prometheus_port: int | None = None,
    sample_ratio: float | None = None,
    attributes: Mapping[str, str] | None = None,
    port_required: bool = True,
) -> Telemetry:
    """Install the SDK if it is asked for. Returns what ends it.

    Args:
        service: name of the service on every span and metric.
        endpoint: base URL of an OTLP collector, without /v1/traces; wins over `environ`.
        prometheus_port: port on loopback; wins over `environ`.
        sample_ratio: share (0 to 1) of the traces that begin in this process. A trace that began
            elsewhere is kept if it was kept there.
        attributes: further attributes of the resource.
        port_required: False goes on without Prometheus where its port is taken.

    A second call in a process returns the first one's result.

    Raises:
        ConfigError: the extra `telemetry` is not installed, an exporter is unknown, the SDK refuses
            a variable, or the port is taken.
    """
    global _installed
    planned = plan(
        environ, endpoint=endpoint, prometheus_port=prometheus_port, sample_ratio=sample_ratio
    )
    if not planned.on:
        return Telemetry()
    if _installed is None:
        _installed = _install(service, planned, attributes or {}, port_required)
        atexit.register(_installed)
    return _installed


def _install(
    service: str, planned: Plan, attributes: Mapping[str, str], port_required: bool
) -> Telemetry:
    """Install all of `planned`, or nothing."""
    ends: list[Callable[[], object]] = []
    try:
        port = _make(service, planned, attributes, port_required, ends)
    except BaseException as error:
        for end in ends:
            end()
        if isinstance(error, ImportError):
            raise not_installed(error) from error
        if isinstance(error, ValueError):
            raise ConfigError(
                f"OpenTelemetry refuses its settings: {error}",
                hint="see the OTEL_ variables that are set",
            ) from error
        raise
    return Telemetry(ends, port)


def _make(
    service: str,
    planned: Plan,
    attributes: Mapping[str, str],
    port_required: bool,
    ends: list[Callable[[], object]],
) -> int | None:
    """Return Prometheus's port. What was started is in `ends` at once; providers are set last."""
    from opentelemetry import metrics, trace
    from opentelemetry.sdk.metrics import MeterProvider
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor
    from opentelemetry.sdk.trace.sampling import ParentBasedTraceIdRatio

    if planned.prometheus is not None:  # a missing package is found before any thread runs
        import_module("opentelemetry.exporter.prometheus")
    _quieten()
    resource = _resource(service, attributes)
    tracers = meters = None
    if planned.traces:
        exporters = [_exporter("traces", name, planned) for name in planned.traces]
        sampler = None if planned.ratio is None else ParentBasedTraceIdRatio(planned.ratio)
        tracers = TracerProvider(sampler=sampler, resource=resource, shutdown_on_exit=False)
        ends.append(tracers.shutdown)
        for exporter in exporters:
            tracers.add_span_processor(BatchSpanProcessor(exported.Legible(exporter)))
    if planned.logs:
        from vram_arbiter.schemas.runtime.telemetry import logs

        shippers = [_exporter("logs", name, planned) for name in planned.logs]
        ends.append(logs.install(resource, shippers))
    readers, port = _readers(planned, port_required, ends)
    if readers:
        meters = MeterProvider(readers, resource=resource, shutdown_on_exit=False)
        ends.append(meters.shutdown)
    if tracers is not None:
        trace.set_tracer_provider(tracers)
    if meters is not None:
        from vram_arbiter.schemas.runtime.telemetry import process

        metrics.set_meter_provider(meters)
        process.observe()
    return port


def _resource(service: str, attributes: Mapping[str, str]) -> Any:
    """Return the resource: ours, then what the environment says, which wins."""
    from opentelemetry.sdk.resources import OTELResourceDetector, Resource

    own = {
        "service.name": service,
        "service.namespace": telemetry.TRACER,
        "service.instance.id": f"{socket.gethostname()}:{os.getpid()}",
        **attributes,
    }
    named = Resource.create(own).merge(OTELResourceDetector().detect())
    return Resource(exported.attributes(named.attributes), named.schema_url)


def _exporter(signal: Signal, name: str, planned: Plan) -> Any:
    """Return an exporter by its name in the specification, from the installed entry points."""
    options: dict[str, object] = {}
    if name == "otlp":
        limits = ("OTEL_EXPORTER_OTLP_TIMEOUT", f"OTEL_EXPORTER_OTLP_{signal.upper()}_TIMEOUT")
        if not any(os.environ.get(limit, "").strip() for limit in limits):
            options["timeout"] = EXPORT_S
        if planned.endpoint is not None:
            options["endpoint"] = f"{planned.endpoint.rstrip('/')}/v1/{signal}"
    return entry_point(signal, name).load()(**options)


def _readers(
    planned: Plan, port_required: bool, ends: list[Callable[[], object]]
) -> tuple[list[Any], int | None]:
    """Return the readers of metrics and Prometheus's port."""
    from opentelemetry.sdk.metrics.export import PeriodicExportingMetricReader

    exporters = [_exporter("metrics", name, planned) for name in planned.metrics]
    readers: list[Any] = [PeriodicExportingMetricReader(exporter) for exporter in exporters]
    if planned.prometheus is None:
        return readers, None
    from opentelemetry.exporter.prometheus import PrometheusMetricReader
    from prometheus_client import CollectorRegistry

    from vram_arbiter.schemas.runtime.telemetry import scrapes

    registry = CollectorRegistry()
    host, wanted = planned.prometheus
    try:
        server = scrapes.ScrapeServer(host, wanted, scrapes.page_of(registry))
    except OSError as error:
        problem = f"no Prometheus endpoint on {host}:{wanted}: {error}"
        if not port_required:
            log.info("%s", problem)
            return readers, None
        taken = error.errno == errno.EADDRINUSE
        why = "another program has the port" if taken else "its unit may have no network"
        raise ConfigError(
            problem,
            hint=f"{why}; set OTEL_EXPORTER_PROMETHEUS_PORT or the configuration",
        ) from error
    ends.append(server.close)
    server.start()
    readers.append(PrometheusMetricReader(scope_info_enabled=False, registry=registry))
    return readers, server.port


def _quieten() -> None:
    """Log complaints about a collector seldom, and about headers without them: they are secrets."""
    for name in (
        "opentelemetry.exporter.otlp.proto.http.trace_exporter",
        "opentelemetry.exporter.otlp.proto.http.metric_exporter",
        "opentelemetry.exporter.otlp.proto.http._log_exporter",
        "opentelemetry.sdk._shared_internal",  # the queue of spans
        "opentelemetry.sdk.metrics._internal.export",
    ):
        logging.getLogger(name).addFilter(_SeldomFilter())
    logging.getLogger("opentelemetry.util.re").addFilter(_without_header)


def _without_header(record: logging.LogRecord) -> bool:
    record.args = ("(not shown)",) if record.args else None
    return True


class _SeldomFilter(logging.Filter):
    """Pass a complaint once in SAY_AGAIN_S, not with every batch that fails."""

    def __init__(self) -> None:
        super().__init__()
        self._said: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        now = time.monotonic()
        if now - self._said.get(str(record.msg), -SAY_AGAIN_S) < SAY_AGAIN_S:
            return False
        self._said[str(record.msg)] = now
        return True
