"""A telemetry collector for tests: takes OTLP over HTTP on loopback and hands out what came,
decoded. Needs the extra `telemetry`."""

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from tests.support.waiting import PATIENCE_S

EXPORTERS_MAX = 128
"""Connections that the kernel takes while nobody here has the time to."""


@dataclass(frozen=True, slots=True)
class SpanEvent:
    name: str
    at_ns: int
    attributes: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ReceivedSpan:
    """Ids in hexadecimal as in a traceparent; `parent_id` "" for a root; times since 1970."""

    name: str
    service: str
    trace_id: str
    span_id: str
    parent_id: str
    start_ns: int
    end_ns: int
    failed: bool
    status: str
    kind: str = ""
    attributes: dict[str, Any] = field(default_factory=dict)
    events: tuple[SpanEvent, ...] = ()


@dataclass(frozen=True, slots=True)
class Point:
    """One value of a metric: a number, or for a histogram its count and sum."""

    metric: str
    unit: str
    service: str
    attributes: dict[str, Any]
    value: float
    count: int = 0


@dataclass(frozen=True, slots=True)
class LogLine:
    """One record of a program's log; ids "" outside any span."""

    body: str
    severity: str
    service: str
    trace_id: str
    span_id: str
    attributes: dict[str, Any]
    event_name: str = ""


class _Server(ThreadingHTTPServer):
    """Knows which of its connections are open, and when one of our own has had its turn: the kernel
    hands them over in the order they came.

    An exporter waits for a few seconds, then its program may end: what it sent lies in the kernel
    and is still to be read.
    """

    request_queue_size = EXPORTERS_MAX

    def __init__(self, handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(("127.0.0.1", 0), handler)
        self._changed = threading.Condition()
        self._open: set[object] = set()
        self._markers: dict[object, set[object] | None] = {}

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._changed:
            if client_address in self._markers:
                self._markers[client_address] = set(self._open)
                self._changed.notify_all()
                self.shutdown_request(request)
                return
            self._open.add(client_address)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._changed:
                self._open.discard(client_address)
                self._changed.notify_all()

    def settle(self) -> None:
        """Until everything is read of whoever connected before this call. Raises AssertionError."""
        with socket.socket() as marker:
            marker.bind(("127.0.0.1", 0))
            name = marker.getsockname()
            with self._changed:
                self._markers[name] = None
            marker.connect(self.server_address[:2])

            def read() -> bool:
                before = self._markers[name]
                return before is not None and not before & self._open

            with self._changed:
                settled = self._changed.wait_for(read, PATIENCE_S)
                del self._markers[name]
        assert settled, f"the collector has not read in {PATIENCE_S} s what it was sent"


class Collector:
    """`with Collector() as collector:` then start programs with `**collector.environ()`."""

    def __init__(self) -> None:
        self._spans: list[ReceivedSpan] = []
        self._points: list[Point] = []
        self._lines: list[LogLine] = []
        self._came = threading.Condition()
        self._waiting = threading.local()
        self._over = False
        collector = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                collector._take(self.path, body)
                self.send_response(200)
                self.send_header("Content-Type", "application/x-protobuf")
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:
                pass  # the test says what it finds wrong

        self._server = _Server(Handler)
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="collector", daemon=True
        )

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def environ(self, schedule_ms: int = 50) -> dict[str, str]:
        """Variables that send a program's telemetry here, spans after at most so many milliseconds.
        A machine too busy to listen is no collector that is away."""
        return {
            "OTEL_EXPORTER_OTLP_ENDPOINT": self.endpoint,
            "OTEL_EXPORTER_OTLP_TIMEOUT": str(PATIENCE_S),
            "OTEL_BSP_SCHEDULE_DELAY": str(schedule_ms),
            "OTEL_METRIC_EXPORT_INTERVAL": "200",
        }

    def __enter__(self) -> Self:
        decode_spans(b"")  # imports what it needs, while nobody waits for an answer
        decode_points(b"")
        decode_lines(b"")
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._server.settle()
        self._over = True
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def spans(self, name: str | None = None) -> list[ReceivedSpan]:
        """All that was sent until now, in the order of their ends as exported."""
        self._settle()
        with self._came:
            return [span for span in self._spans if name is None or span.name == name]

    def points(self, metric: str) -> list[Point]:
        """Every report of a metric that was sent until now, oldest first: each export repeats the
        running totals."""
        self._settle()
        with self._came:
            return [point for point in self._points if point.metric == metric]

    def lines(self) -> list[LogLine]:
        """All lines of logs that were sent until now."""
        self._settle()
        with self._came:
            return list(self._lines)

    def wait(self, condition: Callable[[], bool], what: str, timeout_s: float = PATIENCE_S) -> None:
        """Until `condition()` holds, looked at whenever something came. Raises AssertionError with
        what was waited for and what came."""
        self._waiting.now = True
        try:
            with self._came:
                if not self._came.wait_for(condition, timeout_s):
                    raise AssertionError(
                        f"no {what} within {timeout_s} s; spans: "
                        f"{sorted({s.name for s in self._spans})}, "
                        f"metrics: {sorted({p.metric for p in self._points})}"
                    )
        finally:
            self._waiting.now = False

    def _settle(self) -> None:
        """Not while `wait` looks: it looks again whenever something came, and what comes needs its
        lock."""
        if not self._over and not getattr(self._waiting, "now", False):
            self._server.settle()

    def _take(self, path: str, body: bytes) -> None:
        spans = decode_spans(body) if path == "/v1/traces" else []
        points = decode_points(body) if path == "/v1/metrics" else []
        lines = decode_lines(body) if path == "/v1/logs" else []
        with self._came:
            self._lines += lines
            self._spans += spans
            self._points += points
            self._came.notify_all()


def decode_spans(body: bytes) -> list[ReceivedSpan]:
    from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
    from opentelemetry.proto.trace.v1.trace_pb2 import Span, Status

    request = ExportTraceServiceRequest.FromString(body)
    return [
        ReceivedSpan(
            name=span.name,
            service=str(_attributes(group.resource.attributes).get("service.name", "")),
            trace_id=span.trace_id.hex(),
            span_id=span.span_id.hex(),
            parent_id=span.parent_span_id.hex(),
            start_ns=span.start_time_unix_nano,
            end_ns=span.end_time_unix_nano,
            failed=span.status.code == Status.STATUS_CODE_ERROR,
            status=span.status.message,
            kind=Span.SpanKind.Name(span.kind).removeprefix("SPAN_KIND_"),
            attributes=_attributes(span.attributes),
            events=tuple(
                SpanEvent(event.name, event.time_unix_nano, _attributes(event.attributes))
                for event in span.events
            ),
        )
        for group in request.resource_spans
        for scope in group.scope_spans
        for span in scope.spans
    ]


def decode_lines(body: bytes) -> list[LogLine]:
    from opentelemetry.proto.collector.logs.v1.logs_service_pb2 import ExportLogsServiceRequest

    return [
        LogLine(
            body=line.body.string_value,
            severity=line.severity_text,
            service=str(_attributes(group.resource.attributes).get("service.name", "")),
            trace_id=line.trace_id.hex(),
            span_id=line.span_id.hex(),
            attributes=_attributes(line.attributes),
            event_name=line.event_name,
        )
        for group in ExportLogsServiceRequest.FromString(body).resource_logs
        for scope in group.scope_logs
        for line in scope.log_records
    ]


def decode_points(body: bytes) -> list[Point]:
    from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import (
        ExportMetricsServiceRequest,
    )

    request = ExportMetricsServiceRequest.FromString(body)
    found = []
    for group in request.resource_metrics:
        service = str(_attributes(group.resource.attributes).get("service.name", ""))
        for scope in group.scope_metrics:
            for metric in scope.metrics:
                kind = metric.WhichOneof("data")
                for point in getattr(metric, kind).data_points if kind else ():
                    labels = _attributes(point.attributes)
                    if kind == "histogram":
                        made = Point(
                            metric.name, metric.unit, service, labels, point.sum, point.count
                        )
                    else:
                        value = (
                            point.as_int
                            if point.WhichOneof("value") == "as_int"
                            else point.as_double
                        )
                        made = Point(metric.name, metric.unit, service, labels, float(value))
                    found.append(made)
    return found


def _attributes(pairs: Any) -> dict[str, Any]:
    return {
        pair.key: getattr(pair.value, pair.value.WhichOneof("value") or "string_value")
        for pair in pairs
    }
