"""A tick on a robot in its goal's trace: one span a stage, in order, and what was withheld as
events.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("prometheus_client", reason="the extra `telemetry`")

from tests.support import promql
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = pytest.mark.heavy  # the OpenTelemetry SDK

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


@pytest.fixture(scope="module")
def outcome() -> Any:
    """What the ticks of a program record."""
    runner = Path(__file__).parents[1]
    manifest = runner.parents[1] / "configs/rskills/so101-navigate/rskill.yaml"
    argv = [sys.executable, str(runner / "trace_a_tick.py"), str(manifest)]
    argv.append(f"00-{TRACE}-{PARENT}-01")
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True)
    return json.loads(done.stdout)


def test_each_stage_of_a_tick_is_a_span(outcome: Any) -> None:
    spans = outcome["spans"]
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
    assert outcome["tick"]["traceparent"] == f"00-{TRACE}-{first['span_id']}-01"
    assert outcome["run"] == TRACE
    sensed = [span["span_id"] for span in spans if span["name"] == telemetry.SPAN_SENSORS]
    read = [span for span in spans if span["name"] == telemetry.SPAN_READ]
    assert [span["parent"] for span in read] == sensed
    assert read[-1]["attributes"] == {"error.type": "robot_fault"}
    told = [name for span in later for name, _ in span["events"]]  # its camera is gone
    assert told[0] == telemetry.EVENT_ACTION_WITHHELD
    check_metrics(outcome["metrics"])
    check_dashboard(*(promql.scrape(page) for page in outcome["pages"]))


def test_untrusted_data_is_an_event_of_the_first_tick(outcome: Any) -> None:
    """By the world state, whether a skill needs it or not; each failed reading is one of its own.
    What is too old is told from what failed."""
    ended = [
        (name, about["component"])
        for span in outcome["spans"]
        if span["name"] == telemetry.SPAN_WORLD
        for name, about in span["events"]
    ]
    assert ended == [(telemetry.EVENT_ERROR, "front")]
    latched = [
        (name, about["component"])
        for span, name, about in outcome["slow"]
        if span == telemetry.SPAN_WORLD
    ]
    assert latched == [(telemetry.EVENT_STALE, "wrist"), (telemetry.EVENT_ERROR, "joint_state")]
    missed = [
        (name, about["sensor"], about["reason"])
        for span, name, about in outcome["slow"]
        if span == telemetry.SPAN_SENSORS
    ]
    assert [(name, sensor) for name, sensor, _ in missed] == [
        (telemetry.EVENT_SENSOR_STALE, "wrist"),
        (telemetry.EVENT_SENSOR_STALE, "joint_state"),
    ] * 2
    assert "2067 ms old" in missed[0][2]
    points = outcome["metrics_of_slow"][telemetry.METRIC_COMPONENTS_STALE]["points"]
    assert {p["labels"][telemetry.ATTR_COMPONENT]: p["count"] for p in points} == {
        "front": 1,
        "wrist": 1,
        "joint_state": 1,
    }
    ages = outcome["metrics_of_slow"][telemetry.METRIC_STALENESS]["points"]
    (wrist,) = [p for p in ages if p["labels"][telemetry.ATTR_COMPONENT] == "wrist"]
    assert wrist["sum"] > 4.0


def test_a_violation_names_its_check_and_severity(outcome: Any) -> None:
    """As an event, as the recorded exception of a refusal, and as labels of the counter."""
    about = {telemetry.ATTR_CHECK: "joint_range", telemetry.ATTR_SEVERITY: "error"}
    told = [event[1:] for event in outcome["slow"] if event[0] == telemetry.SPAN_SAFETY]
    assert [name for name, _ in told] == [telemetry.EVENT_SAFETY_VIOLATION, "exception"] * 2
    (_, event), (_, recorded), *_ = told
    assert about.items() <= event.items()
    assert "9.000 rad is 7.342 outside" in event["reason"]
    assert about.items() <= recorded.items()
    assert recorded["exception.type"].endswith(".SafetyViolation")
    (point,) = outcome["metrics_of_slow"][telemetry.METRIC_SAFETY_VIOLATIONS]["points"]
    assert (point["labels"], point["count"]) == ({telemetry.ATTR_SKILL: "a/slow", **about}, 2)


def check_dashboard(*pages: promql.Scrape) -> None:
    """Curves and alerts of the runner; those of a policy's chunks, goals, sidecars and the reasoner
    are in tests/e2e/test_trace.py, that of GPU memory in arbiter/host/gpu/test_nvml_library.py."""
    ready, moving, stopped, _ = pages
    drawn = promql.panels("runner.json").values()
    elsewhere = (
        "vram_runner_chunk_duration_",
        "vram_runner_goals_",
        "vram_sidecar_",
        "vram_reasoner_",
    )
    shown = {str(one.name) for expression in drawn for one in promql.selectors(expression)}
    own = {name for name in shown if not name.startswith((*elsewhere, "vram_runner_gpu_memory"))}
    for expression in drawn:
        if {str(one.name) for one in promql.selectors(expression)} <= own:
            assert promql.unknown(expression, pages) == set()
            for selector in promql.selectors(expression):
                seen = [promql.matched(selector, page) for page in pages]
                assert any(one != seen[0] for one in seen), f"{selector} never moves"
    exported = {name for page in pages for name in promql.metrics_of(page, "vram_runner_")}
    assert {name for name in exported if not {name, f"{name}_bucket"} & own} == set()
    unnamed = promql.named_without_series("runner.json", pages)
    assert [one for one in unnamed if "gpu_memory" not in one] == []
    for name, alert in promql.alerts("vram-runner").items():
        assert not promql.fires(alert, ready, moving), f"{name} is silent while the robot works"
        assert promql.fires(alert, moving, stopped), name
        seen = [key for one in promql.selectors(alert) for key in promql.matched(one, stopped)]
        labels = {label for key in seen for label, _ in key}
        assert promql.described("vram-runner")[name] <= labels | promql.TARGET_LABELS


def check_metrics(metrics: dict[str, Any]) -> None:
    """Seven readings of which two failed, two actions, a camera that ended, a stop."""

    def counts(name: str, label: str) -> dict[str | None, float]:
        return {p["labels"].get(label): p["count"] for p in metrics[name]["points"]}

    def mean_s(name: str) -> float:
        points = metrics[name]["points"]
        return float(sum(p["sum"] for p in points) / sum(p["count"] for p in points))

    assert counts(telemetry.METRIC_HAL_READ, telemetry.ATTR_ERROR_TYPE) == {
        None: 5,
        "robot_fault": 2,
    }
    assert mean_s(telemetry.METRIC_HAL_READ) == pytest.approx(0.004)
    assert counts(telemetry.METRIC_HAL_SEND, telemetry.ATTR_ERROR_TYPE) == {None: 2}
    assert mean_s(telemetry.METRIC_HAL_SEND) == pytest.approx(0.008)
    assert counts(telemetry.METRIC_SENSOR_AGE, telemetry.ATTR_SENSOR) == {
        "joint_state": 5,
        "front": 1,
    }
    stale = {"front": 3, "joint_state": 2}
    assert counts(telemetry.METRIC_STALE_READS, telemetry.ATTR_SENSOR) == stale
    assert counts(telemetry.METRIC_COMPONENTS_STALE, telemetry.ATTR_COMPONENT) == {
        "front": 1,
        "joint_state": 0,
    }
    assert counts(telemetry.METRIC_ESTOPS, "") == {None: 1}
    assert set(counts(telemetry.METRIC_CPU_TIME, telemetry.ATTR_CPU_MODE)) == {"user", "system"}
    assert counts(telemetry.METRIC_MEMORY, "")[None] > 1_000_000
    assert all(metric["unit"] and metric["description"] for metric in metrics.values())
    durations = [name for name in metrics if name.endswith((".duration", ".age"))]
    assert {metrics[name]["unit"] for name in durations} == {"s"}


def test_a_share_of_a_goals_ticks_is_traced(outcome: Any) -> None:
    """The first action is always in the trace, then one tick in four; what is left out names the
    goal. Without a goal nothing is traced.
    """
    outcome = outcome["some"]
    assert outcome["idle_spans"] == 0
    assert outcome["ticks"][:2] == [None, None]
    assert outcome["ticks"][-1] is None
    assert outcome["traces"] == [TRACE]
    of_the_goal = [tuple(text.split("-")[1:]) for text in outcome["ticks"][2:-1]]
    assert [span for _, span, flags in of_the_goal if flags == "01"] == outcome["tick_spans"]
    assert [flags for _, _, flags in of_the_goal] == [*(["01", "00", "00", "00"] * 2), "01"]
    assert {(trace, span) for trace, span, flags in of_the_goal if flags == "00"} == {
        (TRACE, PARENT)
    }
    assert outcome["send_parents"] == outcome["tick_spans"]
