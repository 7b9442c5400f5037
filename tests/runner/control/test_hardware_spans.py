"""A tick on a robot in its goal's trace: one span a stage, in order, and what was withheld as
events.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = pytest.mark.heavy  # the OpenTelemetry SDK

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


def said_by(name: str, manifest: Path) -> Any:
    program = Path(__file__).parents[1] / name
    argv = [sys.executable, str(program), str(manifest), f"00-{TRACE}-{PARENT}-01"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True)
    return json.loads(done.stdout)


def test_each_stage_of_a_tick_is_a_span_of_the_goals_trace(navigate_manifest: Path) -> None:
    said = said_by("trace_a_tick.py", navigate_manifest)
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


def test_a_share_of_a_goals_ticks_is_traced_from_its_first_tick_on(navigate_manifest: Path) -> None:
    """The first action is always in the trace, then one tick in four; what is left out names the
    goal. Without a goal nothing is traced.
    """
    said = said_by("trace_some_ticks.py", navigate_manifest)
    assert said["idle_spans"] == 0
    assert said["ticks"][:2] == [None, None]
    assert said["ticks"][-1] is None
    assert said["traces"] == [TRACE]
    of_the_goal = [tuple(text.split("-")[1:]) for text in said["ticks"][2:-1]]
    assert [span for _, span, flags in of_the_goal if flags == "01"] == said["tick_spans"]
    assert [flags for _, _, flags in of_the_goal] == [
        "01",
        "00",
        "00",
        "00",
        "01",
        "00",
        "00",
        "00",
        "01",
    ]
    assert {(trace, span) for trace, span, flags in of_the_goal if flags == "00"} == {
        (TRACE, PARENT)
    }
    assert said["send_parents"] == said["tick_spans"]
