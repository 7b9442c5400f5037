"""What a sidecar records: each request with its outcome, the loading in it, its own run; in the
caller's trace, and whatever ends it."""

import pytest

from tests.support.collector import Collector
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = [pytest.mark.heavy, pytest.mark.e2e]  # the OpenTelemetry SDK; real processes

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
SERVICE = "vram-sidecar-eye"


@pytest.fixture
def collector(lone_box):
    with Collector() as collector:
        lone_box.environ |= collector.environ()
        yield collector


def test_requests_are_spans_of_the_callers_trace_with_their_outcome(lone_box, collector):
    eye = lone_box.start("eye", "--no-arbiter")
    traceparent = f"00-{TRACE}-{PARENT}-01"
    assert eye.detect("cube", traceparent=traceparent)["ok"]
    assert eye.detect("fail", traceparent=traceparent)["code"] == "model_error"
    assert eye.detect("cube")["ok"]
    assert eye.ask("unload")["ok"]
    assert eye.terminate() == 0

    asked = sorted(collector.spans(telemetry.SPAN_SIDECAR_REQUEST), key=lambda span: span.start_ns)
    outcomes = [
        (span.attributes[telemetry.ATTR_OPERATION], span.attributes[telemetry.ATTR_OUTCOME])
        for span in asked
    ]
    assert outcomes == [
        ("detect", "ok"),
        ("detect", "model_error"),
        ("detect", "ok"),
        ("unload", "ok"),
    ]
    assert [(span.trace_id, span.parent_id) for span in asked[:2]] == [(TRACE, PARENT)] * 2
    assert [span.failed for span in asked] == [False, True, False, False]
    assert all(span.trace_id != TRACE and span.parent_id == "" for span in asked[2:]), (
        "a trace of its own"
    )
    (unload,) = collector.spans(telemetry.SPAN_SIDECAR_UNLOAD)
    assert unload.parent_id == asked[3].span_id
    counted = {
        (
            point.attributes[telemetry.ATTR_OPERATION],
            point.attributes[telemetry.ATTR_OUTCOME],
            point.count,
        )
        for point in collector.points(telemetry.METRIC_SIDECAR_REQUEST)
    }
    assert {("detect", "ok", 2), ("detect", "model_error", 1), ("unload", "ok", 1)} <= counted
    assert {span.service for span in collector.spans()} == {SERVICE}


def test_an_end_in_the_middle_of_the_imports_is_recorded_too(lone_box, collector):
    """That process does not wait for its thread, nor for the interpreter's own end."""
    folder = lone_box.runtime / "eye-model"
    folder.mkdir()
    (folder / "slow_prepare").touch()
    eye = lone_box.start("eye", "--no-arbiter")
    assert eye.terminate() == 0
    (run,) = collector.spans(telemetry.SPAN_COMMAND)
    assert (run.service, run.attributes[telemetry.ATTR_EXIT_CODE]) == (SERVICE, 0)
