"""A tick on a robot in its goal's trace: one span a stage, in order, and what was withheld as events."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from schemas import telemetry

pytestmark = pytest.mark.heavy  # the OpenTelemetry SDK

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


def test_each_stage_of_a_tick_is_a_span_of_the_goals_trace(navigate_manifest: Path) -> None:
    program = Path(__file__).parent / "trace_a_tick.py"
    argv = [sys.executable, str(program), str(navigate_manifest), f"00-{TRACE}-{PARENT}-01"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True)
    said = json.loads(done.stdout)
    spans = said["spans"]
    assert {span["trace_id"] for span in spans} == {TRACE}
    first, *later = [span for span in spans if span["name"] == telemetry.SPAN_TICK]
    assert first["parent"] == PARENT
    assert [span["name"] for span in spans if span["parent"] == first["span_id"]] == [
        telemetry.SPAN_SENSORS,
        telemetry.SPAN_WORLD,
        telemetry.SPAN_INFERENCE,
        telemetry.SPAN_SAFETY,
        telemetry.SPAN_SEND,
    ]
    assert said["tick"]["traceparent"] == f"00-{TRACE}-{first['span_id']}-01"
    assert said["run"] == TRACE
    events = [event for span in later for event in span["events"]]  # its camera is gone
    assert events[:2] == [telemetry.EVENT_STALE, telemetry.EVENT_ACTION_WITHHELD]
    assert events.count(telemetry.EVENT_STALE) == 1
