"""The dashboard that is shipped shows what the daemon really exports, by the names that Prometheus
sees."""

import json
import re
from typing import Any

import pytest

from tests.support.paths import ROOT

pytest.importorskip("prometheus_client", reason="the extra `telemetry`")

from opentelemetry.exporter.prometheus import PrometheusMetricReader
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.trace import NoOpTracerProvider
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from tests.support.core_driver import CoreDriver
from tests.support.scenes import sent_away
from vram_arbiter.arbiter.core.effects import Note, Push
from vram_arbiter.arbiter.host.telemetry.metrics import LeaseMetrics
from vram_arbiter.arbiter.host.telemetry.spans import LeaseTelemetry
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.runtime.telemetry import names as names

GUIDE = ROOT / "docs" / "operating.md"
DASHBOARD = ROOT / "configs" / "grafana" / "arbiter.json"


class NeverCalled:
    def call_later(self, *_: object) -> Any:
        return None


@pytest.fixture(scope="module")
def exported() -> dict[str, set[str]]:
    """Names of series → their labels, after a handover and a denial. Only metrics are on: there is
    no tracer."""
    registry = CollectorRegistry()
    reader = PrometheusMetricReader(scope_info_enabled=False, registry=registry)
    meters = MeterProvider([reader], shutdown_on_exit=False)
    numbers = LeaseMetrics(meters.get_meter("test"))
    telemetry = LeaseTelemetry(NoOpTracerProvider().get_tracer("test"), numbers)
    driver = CoreDriver(8 * d.GIB)
    sent_away(driver)
    driver.consumer("huge").try_acquire(80 * d.GIB)
    telemetry.outgoing(driver.effects)
    for push in (effect for effect in driver.effects if isinstance(effect, Push)):
        assert telemetry.revoke(push.body) == push.body, "no span of ours to name"
    for note in (effect for effect in driver.effects if isinstance(effect, Note)):
        event = {
            "seq": 1,
            "at_wall_s": 1.8e9,
            **words.event(note),
        }
        assert telemetry.observe(note, event) == {}
    numbers.wrote(0.001, failed=False)
    figures = driver.arbiter.figures()
    numbers.watch(NeverCalled(), lambda: figures)  # type: ignore[arg-type]
    series: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(generate_latest(registry).decode()):
        for sample in family.samples:
            series.setdefault(sample.name, set()).update(sample.labels)
    return series


def expressions() -> list[str]:
    panels = json.loads(DASHBOARD.read_text())["panels"]
    return [target["expr"] for panel in panels for target in panel["targets"]]


@pytest.mark.parametrize("expression", expressions())
def test_every_curve_exists(expression: str, exported: dict[str, set[str]]) -> None:
    known = set(re.findall(r"\bvram_\w+", expression))
    names = {name for name in known if name in exported}
    assert names, f"{known} is not exported: {sorted(exported)}"
    labels = set().union(*(exported[name] for name in names))
    assert known - names <= labels


def test_every_metric_has_a_panel(exported: dict[str, set[str]]) -> None:
    shown = " ".join(expressions())
    own = {
        re.sub(r"_(bucket|count|sum|total)$", "", name)
        for name in exported
        if name.startswith("vram_")
    }
    assert {name for name in own if name not in shown} == set()


def test_the_operators_guide_names_the_metrics_that_there_are() -> None:
    """A metric that is only written down makes an alert that never fires."""
    documented = re.search(
        r"^Metrics of the programs.*?(?=^\*\*Logs)", GUIDE.read_text(), re.M | re.S
    )
    assert documented
    named = set(re.findall(r"`((?:vram|process)\.[a-z_.]+)`", documented[0]))
    assert named == {value for key, value in vars(names).items() if key.startswith("METRIC_")}
