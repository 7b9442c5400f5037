"""What leaves over OTLP, and the text that Prometheus reads.

The SDK's own variables (OTEL_*) say where spans, metrics and log records go; without them the
metrics are for Prometheus alone. Exporting is the SDK's threads' work: nothing here waits.
"""

import logging
import time
from collections.abc import Iterable

from opentelemetry import metrics, trace
from opentelemetry._logs import LogRecord, SeverityNumber, get_logger
from opentelemetry.exporter.prometheus import PrometheusMetricReader
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from vram_arbiter.clients.observer import names as own
from vram_arbiter.clients.observer.metrics import LeaseMetrics
from vram_arbiter.clients.observer.present import Look, Present
from vram_arbiter.clients.observer.spans import NotedIds, Spans, context_of
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry import exported, names, setup
from vram_arbiter.schemas.wire.notes import WARNING_KINDS

log = logging.getLogger(__name__)

SERVICE = "vram-arbiter"
"""What is exported is the daemon's."""
EVENTS = "vram_arbiter"
"""Namespace of the events; the last part is the kind in the history."""
FRESH_S = 1.0
"""A reader of /metrics gets a status that is no older."""
_LABELS = {
    "consumer": names.ATTR_CONSUMER,
    "lease_id": names.ATTR_LEASE,
    "gpu": names.ATTR_GPU,
    "verdict": own.ATTR_VERDICT,
    "code": names.ATTR_ERROR_TYPE,
    "reason": names.ATTR_REASON,
}


class Exports:
    """`take` events, `show` each status, `text` for Prometheus; `close` sends what is left."""

    def __init__(self) -> None:
        """Install the SDK. Raises ConfigError for OTEL_ variables that make no sense."""
        self._registry, ids = CollectorRegistry(), NotedIds()
        reader = PrometheusMetricReader(scope_info_enabled=False, registry=self._registry)
        self._sdk = setup.set_up(SERVICE, readers=(reader,), id_generator=ids)
        self._metrics = LeaseMetrics(metrics.get_meter(names.TRACER))
        self._spans = Spans(trace.get_tracer(names.TRACER), ids)
        self._logs = get_logger("arbiter.events")

    def take(self, events: Iterable[JsonMap]) -> None:
        for event in events:
            self._metrics.take(event)
            self._spans.take(event)
            self._logs.emit(record_of(event))

    def show(self, look: Look | None) -> None:
        self._metrics.show(None if look is None else look.status)

    def text(self, accept: str) -> tuple[bytes, str]:
        """Return the metrics in Prometheus' text format, or as OpenMetrics (with exemplars)."""
        encode, kind = choose_encoder(accept)
        return encode(self._registry), kind

    def close(self) -> None:
        self._spans.close(time.time_ns())
        self._sdk()


class Scrapes:
    """/metrics: as of now, where the arbiter answers."""

    def __init__(self, exports: Exports, present: Present) -> None:
        self._exports = exports
        self._present = present

    async def text(self, accept: str) -> tuple[bytes, str]:
        await self._present.look(FRESH_S)
        return self._exports.text(accept)


def record_of(event: JsonMap) -> LogRecord:
    """Return an event as a log record, with the span that it belongs to."""
    labels = {label: str(event[key]) for key, label in _LABELS.items() if key in event}
    subject = " ".join(str(event[key]) for key in ("consumer", "lease_id") if event.get(key))
    words = " ".join((event["kind"], subject, str(event.get("reason") or "")))
    warns = event["kind"] in WARNING_KINDS
    return LogRecord(
        timestamp=int(event["at_wall_s"] * 1e9),
        observed_timestamp=time.time_ns(),
        context=context_of(event),
        severity_text="WARN" if warns else "INFO",
        severity_number=SeverityNumber.WARN if warns else SeverityNumber.INFO,
        body=exported.text(" ".join(words.split())),
        attributes=dict(exported.attributes(labels)),
        event_name=f"{EVENTS}.{event['kind']}",
    )
