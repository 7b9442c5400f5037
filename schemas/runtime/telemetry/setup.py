"""Installs an OpenTelemetry SDK when a person asked for one: standard OTEL_* variables, or what a program's configuration says.

Not asked for, nothing of OpenTelemetry is imported and nothing runs. Must not know any span or metric of a program; the names are in
`schemas.runtime.telemetry.names`, the calls in `schemas.runtime.telemetry.spans` and with the programs. OTLP goes over HTTP with protobuf; the Prometheus endpoint
listens on loopback alone, because it asks nobody who he is. What is not named here (headers, certificates, OTEL_BSP_*,
OTEL_METRIC_EXPORT_INTERVAL, OTEL_RESOURCE_ATTRIBUTES) the SDK reads from the process's environment by itself.
"""

import atexit
import ipaddress
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any
from urllib.parse import urlsplit

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.telemetry import exported
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

log = logging.getLogger(__name__)

EXTRA = "vram-arbiter[telemetry]"
OTLP_DEFAULT = "http://localhost:4318"
PROMETHEUS_PORT = 9464
"""The port that OpenTelemetry's specification gives to a Prometheus endpoint."""
FLUSH_S = 5.0
"""A program that ends waits at most so long for its collector."""
EXPORT_S = 3.0
"""Time limit of one export, retries included, unless OTEL_EXPORTER_OTLP_TIMEOUT or the signal's own says otherwise. The SDK's own 10 s outlasts FLUSH_S."""
EXPORT_MAX_S = 86_400.0
SAY_AGAIN_S = 300.0
"""A collector that is away is complained of this often, not with every batch."""

_SAMPLERS = (
    "always_on",
    "always_off",
    "traceidratio",
    "parentbased_always_on",
    "parentbased_always_off",
    "parentbased_traceidratio",
)
_BOUNDS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
_BOUNDS_WRITE_S = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.05, 0.25, 1.0, 5.0)
_BOUNDS_MS = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 33.0, 40.0, 50.0, 100.0, 250.0, 500.0, 1000.0, 5000.0)  # fmt: skip
_BOUNDS: Mapping[str, Sequence[float]] = {
    telemetry.METRIC_WAIT: _BOUNDS_S,
    telemetry.METRIC_HANDOVER: _BOUNDS_S,
    telemetry.METRIC_SIDECAR_LOAD: _BOUNDS_S,
    telemetry.METRIC_JOURNAL_WRITE: _BOUNDS_WRITE_S,
    telemetry.METRIC_TICK: _BOUNDS_MS,
    telemetry.METRIC_INFERENCE: _BOUNDS_MS,
    telemetry.METRIC_SIDECAR_REQUEST: _BOUNDS_MS,
}


@dataclass(frozen=True, slots=True)
class Plan:
    """What to export and where to. All None: telemetry is off."""

    traces: str | None = None  # whole URL
    metrics: str | None = None  # whole URL
    prometheus: tuple[str, int] | None = None  # loopback address, port; 0: any free one
    sampler: str = "parentbased_traceidratio"
    ratio: float = 1.0  # 0..1, of the traces that begin here
    traces_timeout_s: float = EXPORT_S
    metrics_timeout_s: float = EXPORT_S

    @property
    def on(self) -> bool:
        return self.traces is not None or self.metrics is not None or self.prometheus is not None


class Telemetry:
    """What `set_up` gives back: call it at the program's end, at most FLUSH_S; again is nothing. `on`: an SDK is installed."""

    def __init__(
        self, ends: Sequence[Callable[[], object]] = (), prometheus_port: int | None = None
    ) -> None:
        self.on = bool(ends)
        self.prometheus_port = prometheus_port
        self._over = threading.Event()
        # In threads of their own, because an exporter does not look at the clock while it waits for a collector that does not answer;
        # made now, because none can be made any more while the interpreter ends.
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
        except Exception as error:  # noqa: BLE001 - a thread's outermost call: what telemetry cannot say ends no program badly
            log.warning("telemetry ended badly: %s", error)


_installed: Telemetry | None = (
    None  # OpenTelemetry's providers are one per process and can be set once
)


def set_up(
    service: str,
    *,
    environ: Mapping[str, str] = os.environ,
    endpoint: str | None = None,
    prometheus_port: int | None = None,
    sample_ratio: float | None = None,
    attributes: Mapping[str, str] | None = None,
) -> Telemetry:
    """Install the SDK if anything was asked for; the result ends it. Arguments (a program's configuration) win over `environ`.

    `endpoint`: OTLP collector, the base without /v1/traces. `sample_ratio`: share of the traces that begin in this process; one that began
    elsewhere is kept if it was kept there. `attributes`: more of the resource's. A second call in a process gives the first one's result.
    Raises ConfigError: the extra `telemetry` is not installed, a value makes no sense, the port is taken.
    """
    global _installed
    planned = plan(
        environ, endpoint=endpoint, prometheus_port=prometheus_port, sample_ratio=sample_ratio
    )
    if not planned.on:
        return Telemetry()
    if _installed is None:
        _installed = _install(service, planned, attributes or {})
        atexit.register(_installed)
    return _installed


def plan(
    environ: Mapping[str, str],
    *,
    endpoint: str | None = None,
    prometheus_port: int | None = None,
    sample_ratio: float | None = None,
) -> Plan:
    """What was asked for; nothing is imported or opened. Raises ConfigError that names the variable."""
    if environ.get("OTEL_SDK_DISABLED", "").strip().lower() == "true":
        return Plan()
    ways = {
        "TRACES": _exporters(environ, "OTEL_TRACES_EXPORTER", ("otlp", "none")),
        "METRICS": _exporters(environ, "OTEL_METRICS_EXPORTER", ("otlp", "prometheus", "none")),
    }
    urls = {signal: _url(environ, signal, ways[signal], endpoint) for signal in ways}
    prometheus = None
    if prometheus_port is not None or "prometheus" in (ways["METRICS"] or ()):
        prometheus = _prometheus(environ, prometheus_port)
    if not (urls["TRACES"] or urls["METRICS"] or prometheus):
        return Plan()
    if urls["TRACES"] or urls["METRICS"]:
        _check_protocol(environ)
    sampler, ratio = _sampling(environ, sample_ratio)
    limits_s = {
        signal: _timeout_s(environ, signal) if url else EXPORT_S for signal, url in urls.items()
    }
    return Plan(
        urls["TRACES"],
        urls["METRICS"],
        prometheus,
        sampler,
        ratio,
        limits_s["TRACES"],
        limits_s["METRICS"],
    )


def _exporters(
    environ: Mapping[str, str], name: str, known: Sequence[str]
) -> tuple[str, ...] | None:
    """None: the variable does not say."""
    given = tuple(part.strip().lower() for part in environ.get(name, "").split(",") if part.strip())
    for part in given:
        if part not in known:
            raise ConfigError(
                f"{name}: {part!r} is no exporter here", hint=f"one of {', '.join(known)}"
            )
    return given or None


def _url(
    environ: Mapping[str, str], signal: str, ways: tuple[str, ...] | None, endpoint: str | None
) -> str | None:
    if ways is not None and "otlp" not in ways:
        return None
    path = f"/v1/{signal.lower()}"
    own = f"OTEL_EXPORTER_OTLP_{signal}_ENDPOINT"
    if endpoint is not None:
        return checked_url(endpoint, "the telemetry endpoint").rstrip("/") + path
    if given := environ.get(own, "").strip():
        return checked_url(given, own)
    if base := environ.get("OTEL_EXPORTER_OTLP_ENDPOINT", "").strip():
        return checked_url(base, "OTEL_EXPORTER_OTLP_ENDPOINT").rstrip("/") + path
    return None if ways is None else OTLP_DEFAULT + path


def checked_url(text: str, name: str) -> str:
    """`text` itself. Raises ConfigError unless it is http://HOST… or https://HOST…."""
    try:
        parts = urlsplit(text)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        good = False
    if not good:
        shown = text.rpartition("@")[2].partition("?")[0]  # no password, no token
        raise ConfigError(
            f"{name}: {shown!r} is no URL of a collector", hint=f"write {OTLP_DEFAULT}"
        )
    return text


def _timeout_s(environ: Mapping[str, str], signal: str) -> float:
    """Of one export, as the SDK reads it: the signal's own variable before the common one, and in seconds."""
    for name in (f"OTEL_EXPORTER_OTLP_{signal}_TIMEOUT", "OTEL_EXPORTER_OTLP_TIMEOUT"):
        if not (text := environ.get(name, "").strip()):
            continue
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not 0.0 < value <= EXPORT_MAX_S:
            raise ConfigError(
                f"{name}: {text!r} is no number of seconds for an export",
                hint=f"more than 0 and at most {EXPORT_MAX_S:g}, e.g. 10",
            )
        return value
    return EXPORT_S


def _check_protocol(environ: Mapping[str, str]) -> None:
    for name in (
        "OTEL_EXPORTER_OTLP_PROTOCOL",
        "OTEL_EXPORTER_OTLP_TRACES_PROTOCOL",
        "OTEL_EXPORTER_OTLP_METRICS_PROTOCOL",
    ):
        given = environ.get(name, "").strip().lower()
        if given not in ("", "http/protobuf"):
            raise ConfigError(
                f"{name}: {given!r} is not spoken here",
                hint="http/protobuf is; collectors take it on port 4318",
            )


def _prometheus(environ: Mapping[str, str], port: int | None) -> tuple[str, int]:
    host = environ.get("OTEL_EXPORTER_PROMETHEUS_HOST", "").strip() or "127.0.0.1"
    if not _is_loopback(host):
        raise ConfigError(
            f"OTEL_EXPORTER_PROMETHEUS_HOST: {host} is no loopback address, and the endpoint asks nobody who he is",
            hint="write 127.0.0.1 and let a collector or a proxy on this machine pass it on",
        )
    if port is None:
        text = environ.get("OTEL_EXPORTER_PROMETHEUS_PORT", "").strip() or str(PROMETHEUS_PORT)
        if not text.isascii() or not text.isdigit() or int(text) > 65_535:
            raise ConfigError(
                f"OTEL_EXPORTER_PROMETHEUS_PORT: {text!r} is no port", hint="0 to 65535"
            )
        port = int(text)
    return host, port


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _sampling(environ: Mapping[str, str], ratio: float | None) -> tuple[str, float]:
    if ratio is not None:
        return "parentbased_traceidratio", _ratio(str(ratio), "the sample ratio")
    name = environ.get("OTEL_TRACES_SAMPLER", "").strip().lower() or "parentbased_traceidratio"
    if name not in _SAMPLERS:
        raise ConfigError(
            f"OTEL_TRACES_SAMPLER: {name!r} is unknown", hint=f"one of {', '.join(_SAMPLERS)}"
        )
    text = environ.get("OTEL_TRACES_SAMPLER_ARG", "").strip() or "1.0"
    return name, _ratio(text, "OTEL_TRACES_SAMPLER_ARG") if name.endswith("ratio") else 1.0


def _ratio(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise ConfigError(f"{name}: {text!r} is no share", hint="0 (no trace) to 1 (all)")
    return value


# -- the SDK: nothing above this line imports it ------------------------------------------------------------------------
def _install(service: str, planned: Plan, attributes: Mapping[str, str]) -> Telemetry:
    """Everything that can fail comes first: a program whose telemetry is refused has no half of it."""
    ends: list[Callable[[], object]] = []
    try:
        port = _make(service, planned, attributes, ends)
    except BaseException as error:
        for end in ends:
            end()
        if isinstance(error, ImportError):
            raise _not_installed(error) from error
        if isinstance(
            error, ValueError
        ):  # the SDK read the rest of the environment, and says what is wrong there
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
    ends: list[Callable[[], object]],
) -> int | None:
    """Prometheus's port. What was begun is in `ends` as soon as it has; nothing of it is the process's own before all of it is there."""
    from opentelemetry import metrics, trace
    from opentelemetry.sdk.metrics import MeterProvider
    from opentelemetry.sdk.resources import OTELResourceDetector, Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    if planned.prometheus is not None:  # what is missing is found before any thread runs
        import_module("opentelemetry.exporter.prometheus")
    own = {
        "service.name": service,
        "service.namespace": telemetry.TRACER,
        "service.instance.id": f"{socket.gethostname()}:{os.getpid()}",
        **attributes,
    }
    _quieten()
    named = Resource.create(own).merge(
        OTELResourceDetector().detect()
    )  # what the environment says wins
    resource = Resource(exported.attributes(named.attributes), named.schema_url)
    tracers = meters = None
    if planned.traces is not None:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

        tracers = TracerProvider(
            sampler=_sampler(planned), resource=resource, shutdown_on_exit=False
        )
        ends.append(tracers.shutdown)
        exporter = OTLPSpanExporter(endpoint=planned.traces, timeout=planned.traces_timeout_s)
        tracers.add_span_processor(BatchSpanProcessor(exported.Legible(exporter)))
    readers, port = _readers(planned, ends)
    if readers:
        meters = MeterProvider(readers, resource=resource, shutdown_on_exit=False, views=_views())
        ends.append(meters.shutdown)
    if tracers is not None:
        trace.set_tracer_provider(tracers)
    if meters is not None:
        metrics.set_meter_provider(meters)
    return port


def _not_installed(error: ImportError) -> ConfigError:
    return ConfigError(
        f"telemetry is asked for, but its packages are not installed: {error}",
        hint=f"pip install '{EXTRA}', or unset the OTEL_ variables and the telemetry section",
    )


def _sampler(planned: Plan) -> Any:
    from opentelemetry.sdk.trace import sampling

    name = planned.sampler.removeprefix("parentbased_")
    root = {
        "always_on": sampling.ALWAYS_ON,
        "always_off": sampling.ALWAYS_OFF,
        "traceidratio": sampling.TraceIdRatioBased(planned.ratio),
    }[name]
    return sampling.ParentBased(root) if planned.sampler.startswith("parentbased_") else root


def _readers(planned: Plan, ends: list[Callable[[], object]]) -> tuple[list[Any], int | None]:
    """(readers of metrics, Prometheus's port)."""
    readers: list[Any] = []
    port: int | None = None
    if planned.metrics is not None:
        from opentelemetry.exporter.otlp.proto.http.metric_exporter import OTLPMetricExporter
        from opentelemetry.sdk.metrics.export import PeriodicExportingMetricReader

        exporter = OTLPMetricExporter(endpoint=planned.metrics, timeout=planned.metrics_timeout_s)
        readers.append(PeriodicExportingMetricReader(exporter))
    if planned.prometheus is not None:
        from opentelemetry.exporter.prometheus import PrometheusMetricReader
        from prometheus_client import CollectorRegistry

        from vram_arbiter.schemas.runtime.telemetry import scrapes

        registry = CollectorRegistry()
        host, wanted = planned.prometheus
        try:
            server = scrapes.ScrapeServer(host, wanted, scrapes.page_of(registry))
        except OSError as error:
            raise ConfigError(
                f"no Prometheus endpoint on {host}:{wanted}: {error}",
                hint="another program has the port; OTEL_EXPORTER_PROMETHEUS_PORT or the configuration names another one",
            ) from error
        ends.append(server.close)
        server.start()
        port = server.port
        readers.append(PrometheusMetricReader(scope_info_enabled=False, registry=registry))
    return readers, port


def _views() -> list[Any]:
    from opentelemetry.sdk.metrics.view import ExplicitBucketHistogramAggregation, View

    return [
        View(instrument_name=name, aggregation=ExplicitBucketHistogramAggregation(bounds))
        for name, bounds in _BOUNDS.items()
    ]


def _quieten() -> None:
    """What the SDK and its exporters say of a collector comes seldom, and what they say of headers without the headers: those are secrets."""
    for name in (
        "opentelemetry.exporter.otlp.proto.http.trace_exporter",
        "opentelemetry.exporter.otlp.proto.http.metric_exporter",
        "opentelemetry.sdk._shared_internal",  # the queue of spans
        "opentelemetry.sdk.metrics._internal.export",
    ):
        logging.getLogger(name).addFilter(_SeldomFilter())
    logging.getLogger("opentelemetry.util.re").addFilter(_without_header)


def _without_header(record: logging.LogRecord) -> bool:
    record.args = ("(not shown)",) if record.args else None
    return True


class _SeldomFilter(logging.Filter):
    """Lets an exporter's complaint through once in SAY_AGAIN_S, not with every batch that nobody takes."""

    def __init__(self) -> None:
        super().__init__()
        self._said: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        now = time.monotonic()
        if now - self._said.get(str(record.msg), -SAY_AGAIN_S) < SAY_AGAIN_S:
            return False
        self._said[str(record.msg)] = now
        return True
