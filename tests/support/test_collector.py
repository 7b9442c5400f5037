"""The tests' telemetry collector: what was sent is there, however late it is read and whether or
not its sender lives."""

import http.client
import socket
import threading

import pytest

from tests.support.collector import Collector

pytest.importorskip("opentelemetry.proto", reason="the extra `telemetry`")


def batch(name: str) -> bytes:
    from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

    request = ExportTraceServiceRequest()
    request.resource_spans.add().scope_spans.add().spans.add().name = name
    body: bytes = request.SerializeToString()
    return body


def connected(collector: Collector) -> socket.socket:
    host, port = collector.endpoint.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)))


def test_what_an_exporter_sent_before_it_ended_is_there() -> None:
    """Regression: on a slow machine a program had ended before the test's own thread had read its
    last spans."""
    with Collector() as collector:
        body = batch("last")
        head = (
            f"POST /v1/traces HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n".encode()
        )
        for _ in range(50):
            with connected(collector) as exporter:
                exporter.sendall(head + body)  # and it ends without having heard the answer
        assert [span.name for span in collector.spans()] == ["last"] * 50


def test_who_is_still_sending_is_waited_for_and_who_comes_later_is_not() -> None:
    with Collector() as collector:
        body = batch("slow")
        slow = http.client.HTTPConnection(collector.endpoint.removeprefix("http://"), timeout=60)
        slow.putrequest("POST", "/v1/traces")
        slow.putheader("Content-Length", str(len(body)))
        slow.endheaders()
        seen: list[str] = []
        asked = threading.Thread(
            target=lambda: seen.extend(span.name for span in collector.spans())
        )
        asked.start()
        slow.send(body)
        asked.join(60)
        assert seen == ["slow"]
        assert slow.getresponse().status == 200
        slow.close()
        with pytest.raises(AssertionError, match="no nothing within"):
            collector.wait(lambda: False, "nothing", timeout_s=0.0)
    assert [span.name for span in collector.spans()] == ["slow"], (
        "it is kept when the collector has ended"
    )
