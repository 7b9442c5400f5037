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


def test_each_stage_of_a_tick_is_a_span_of_the_goals_trace(outcome: Any) -> None:
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
    events = [event for span in later for event in span["events"]]  # its camera is gone
    assert events[:2] == [telemetry.EVENT_STALE, telemetry.EVENT_ACTION_WITHHELD]
    assert events.count(telemetry.EVENT_STALE) == 1
    check_metrics(outcome["metrics"])
    check_dashboard(*(promql.scrape(page) for page in outcome["pages"]))


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
    assert counts(telemetry.METRIC_WORLD_STALE, telemetry.ATTR_COMPONENT)["front"] >= 3
    assert counts(telemetry.METRIC_ESTOPS, "") == {None: 1}
    assert set(counts(telemetry.METRIC_CPU_TIME, telemetry.ATTR_CPU_MODE)) == {"user", "system"}
    assert counts(telemetry.METRIC_MEMORY, "")[None] > 1_000_000
    assert all(metric["unit"] and metric["description"] for metric in metrics.values())
    durations = [name for name in metrics if name.endswith((".duration", ".age"))]
    assert {metrics[name]["unit"] for name in durations} == {"s"}


def test_a_share_of_a_goals_ticks_is_traced_from_its_first_tick_on(outcome: Any) -> None:
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
