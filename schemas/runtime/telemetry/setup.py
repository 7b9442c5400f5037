"""Installs the OpenTelemetry SDK where the environment asks for it.

Nothing of OpenTelemetry is imported, and nothing runs, unless it is asked for (`wanted`). The SDK
and its exporters read the OTEL_* variables themselves; read here are those that say whether and
where to export. Exporters are the installed entry points of the specification's names (`otlp`,
`console`, ...); Prometheus is served on loopback alone, because it does not authenticate.
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
from typing import Any, Literal

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.telemetry import exported
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.urls import collector_url, http_address

log = logging.getLogger(__name__)

type Signal = Literal["traces", "metrics", "logs"]
type _Ends = list[Callable[[], object]]
type Wanted = Mapping[Signal, Sequence[str]]
"""Names of exporters; all empty: telemetry is off."""

SIGNALS: tuple[Signal, ...] = ("traces", "metrics", "logs")
PROMETHEUS = "prometheus"
OTLP_ENTRIES = {"http/protobuf": "otlp_proto_http", "grpc": "otlp_proto_grpc"}
"""Entry points of the exporters by OTLP's protocol."""
FLUSH_S = 5.0
"""Longest wait for a collector at a program's end."""
EXPORT_S = 3.0
"""Time limit of one OTLP export unless a variable sets it; the SDK's 10 s outlast FLUSH_S."""
INTERVAL_MS = 5000.0
"""Between two exports of metrics unless OTEL_METRIC_EXPORT_INTERVAL is set; the SDK's 60 s hide
what happens within a goal."""
HINT = "pip install 'vram-arbiter[telemetry]', or correct the OTEL_ variables that are set"
SAY_AGAIN_S = 300.0
"""Interval between two complaints about a collector that is away."""


def wanted(environ: Mapping[str, str]) -> Wanted:
    """Return what is asked for; import and open nothing. Raises ConfigError."""
    off = environ.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    return {signal: () if off else _exporters(environ, signal) for signal in SIGNALS}


def _exporters(environ: Mapping[str, str], signal: Signal) -> tuple[str, ...]:
    """Return the exporters' names. An OTLP endpoint alone asks for `otlp`."""
    given = environ.get(f"OTEL_{signal.upper()}_EXPORTER", "").lower().split(",")
    names = tuple(name.strip() for name in given if name.strip())
    variables = (f"OTEL_EXPORTER_OTLP_{signal.upper()}_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
    urls = [variable for variable in variables if environ.get(variable, "").strip()]
    if not names and urls:
        names = ("otlp",)
    for variable in urls if "otlp" in names else ():
        try:
            collector_url(environ[variable].strip())
        except ValueError as error:
            raise ConfigError(f"{variable}: {error}", hint="or unset it") from None
    return tuple(name for name in names if name != "none")


class Telemetry:
    """Result of `set_up`: call it at the program's end to send what is left. `on`: the SDK runs."""

    def __init__(self, ends: Sequence[Callable[[], object]] = ()) -> None:
        self.on = bool(ends)
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


_said: dict[str, float] = {}
_installed: Telemetry | None = None  # the SDK's providers can be set once per process


def set_up(
    service: str,
    *,
    attributes: Mapping[str, str] | None = None,
    port_required: bool = True,
    readers: Sequence[Any] = (),
    id_generator: Any = None,
) -> Telemetry:
    """Install the SDK if this process's environment asks for it. Returns what ends it.

    Args:
        service: name of the service on every span and metric.
        attributes: further attributes of the resource.
        port_required: False goes on without Prometheus where its port is taken.
        readers: readers of metrics, beside those of the environment. They ask for the SDK, too, and
            for no metrics of this process.
        id_generator: of spans; None: the SDK's.

    A second call in a process returns the first one's result. Raises ConfigError: the packages are
    not installed, an exporter is unknown, the SDK refuses a variable, or the port is taken.
    """
    global _installed
    exporters = wanted(os.environ)
    if not any(exporters.values()) and not readers:
        return Telemetry()
    if _installed is None:
        ends: _Ends = []
        given = readers
        try:
            _quieten()
            resource = _resource(service, attributes or {})
            # first: a missing package is found before a thread runs
            if PROMETHEUS in exporters["metrics"]:
                readers = [*readers, *_prometheus(ends, port_required=port_required)]
            tracers = _tracers(exporters["traces"], resource, id_generator, ends)
            meters = _meters(exporters["metrics"], readers, resource, ends)
            _install(tracers, meters, exporters["logs"], resource, ends)
            if meters is not None and not given:
                import_module("vram_arbiter.schemas.runtime.telemetry.process").observe()
        except BaseException as error:
            for end in ends:
                end()
            if not isinstance(error, ImportError | ValueError):
                raise
            raise ConfigError(f"OpenTelemetry cannot be set up: {error}", hint=HINT) from error
        _installed = Telemetry(ends)
        atexit.register(_installed)
    return _installed


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


def _tracers(names: Sequence[str], resource: Any, id_generator: Any, ends: _Ends) -> Any:
    if not names:
        return None
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    made = TracerProvider(resource=resource, id_generator=id_generator, shutdown_on_exit=False)
    ends.append(made.shutdown)
    for exporter in [_exporter("traces", name) for name in names]:
        made.add_span_processor(BatchSpanProcessor(exported.Legible(exporter)))
    return made


def _meters(names: Sequence[str], readers: Sequence[Any], resource: Any, ends: _Ends) -> Any:
    from opentelemetry.sdk.metrics import MeterProvider
    from opentelemetry.sdk.metrics.export import PeriodicExportingMetricReader

    exporters = [_exporter("metrics", name) for name in names if name != PROMETHEUS]
    given = os.environ.get("OTEL_METRIC_EXPORT_INTERVAL", "").strip()
    interval_ms = None if given else INTERVAL_MS  # None: the SDK reads it
    every = [*readers, *(PeriodicExportingMetricReader(one, interval_ms) for one in exporters)]
    if not every:
        return None
    made = MeterProvider(every, resource=resource, shutdown_on_exit=False)
    ends.append(made.shutdown)
    return made


def _install(tracers: Any, meters: Any, logs: Sequence[str], resource: Any, ends: _Ends) -> None:
    """Set the providers, once nothing can fail any more."""
    from opentelemetry import metrics, trace

    shippers = [_exporter("logs", name) for name in logs]
    if shippers:
        handler = import_module("vram_arbiter.schemas.runtime.telemetry.logs")
        ends.append(handler.install(resource, shippers))
    if tracers is not None:
        trace.set_tracer_provider(tracers)
    if meters is not None:
        metrics.set_meter_provider(meters)


def _exporter(signal: Signal, name: str) -> Any:
    """Return an exporter by its name in the specification, from the installed entry points."""
    from importlib.metadata import entry_points

    entry, options = name, {}
    if name == "otlp":
        protocol = _variable("PROTOCOL", signal) or "http/protobuf"
        if protocol not in OTLP_ENTRIES:
            raise ConfigError(
                f"OTEL_EXPORTER_OTLP_PROTOCOL: expected {' or '.join(OTLP_ENTRIES)}, got "
                f"{protocol!r}"
            )
        entry = OTLP_ENTRIES[protocol]
        if not _variable("TIMEOUT", signal):
            options = {"timeout": EXPORT_S}
    found = tuple(entry_points(group=f"opentelemetry_{signal}_exporter", name=entry))
    if not found:
        raise ConfigError(
            f"OTEL_{signal.upper()}_EXPORTER: no exporter {entry!r} is installed",
            hint="write otlp, prometheus (metrics only) or none, or install its package",
        )
    return found[0].load()(**options)


def _variable(what: str, signal: Signal) -> str:
    """Return an OTLP setting of the environment, of a signal or of all; "": neither is set."""
    names = (f"OTEL_EXPORTER_OTLP_{signal.upper()}_{what}", f"OTEL_EXPORTER_OTLP_{what}")
    return next((found for name in names if (found := os.environ.get(name, "").strip())), "")


def _prometheus(ends: _Ends, *, port_required: bool) -> Sequence[Any]:
    """Serve Prometheus on loopback, and return its reader; none where the port is not needed and
    is taken."""
    from opentelemetry.exporter.prometheus import PrometheusMetricReader
    from prometheus_client import CollectorRegistry, start_http_server

    host = os.environ.get("OTEL_EXPORTER_PROMETHEUS_HOST", "").strip() or "127.0.0.1"
    # 9464 is the specification's
    port = os.environ.get("OTEL_EXPORTER_PROMETHEUS_PORT", "").strip() or "9464"
    address = http_address(f"[{host}]:{port}" if ":" in host else f"{host}:{port}")
    if not address.loopback:
        raise ConfigError(
            f"OTEL_EXPORTER_PROMETHEUS_HOST: expected a loopback address, got {host}; the endpoint"
            " does not authenticate",
            hint="write 127.0.0.1 and let a collector or proxy on this machine forward it",
        )
    registry = CollectorRegistry()
    try:
        server, _ = start_http_server(address.port, address.host, registry)
    except OSError as error:
        problem = f"no Prometheus endpoint on {address}: {error}"
        if not port_required:
            log.info("%s", problem)
            return ()
        taken = error.errno == errno.EADDRINUSE
        why = "another program has the port" if taken else "its unit may have no network"
        hint = f"{why}; set OTEL_EXPORTER_PROMETHEUS_PORT"
        raise ConfigError(problem, hint=hint) from error
    ends += [server.shutdown, server.server_close]
    return (PrometheusMetricReader(scope_info_enabled=False, registry=registry),)


def _quieten() -> None:
    """Log complaints about a collector seldom, and about headers without them: they are secrets."""
    for name in (
        "opentelemetry.exporter.otlp.proto.http.trace_exporter",
        "opentelemetry.exporter.otlp.proto.http.metric_exporter",
        "opentelemetry.exporter.otlp.proto.http._log_exporter",
        "opentelemetry.sdk._shared_internal",  # the queue of spans
        "opentelemetry.sdk.metrics._internal.export",
    ):
        logging.getLogger(name).addFilter(_seldom)
    logging.getLogger("opentelemetry.util.re").addFilter(_without_header)


def _without_header(record: logging.LogRecord) -> bool:
    record.args = ("(not shown)",) if record.args else None
    return True


def _seldom(record: logging.LogRecord) -> bool:
    """Pass a complaint once in SAY_AGAIN_S, not with every batch that fails."""
    what, now = f"{record.name} {record.msg}", time.monotonic()
    if now - _said.get(what, -SAY_AGAIN_S) < SAY_AGAIN_S:
        return False
    _said[what] = now
    return True
