"""Dashboard and alert rules of the arbiter against its real export: every metric and label that
they name exists, and moves in a scene that causes it. An alert is silent before its scene and fires
after it."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.paths import ROOT

pytest.importorskip("prometheus_client", reason="the extra `telemetry`")

from opentelemetry.exporter.prometheus import PrometheusMetricReader
from opentelemetry.sdk.metrics import MeterProvider
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest

from tests.support import promql
from tests.support.core_driver import CoreDriver
from tests.support.scenes import GIB, held, sent_away
from vram_arbiter.arbiter.core.effects import Effect, Note, Refuse
from vram_arbiter.arbiter.core.events import Asked
from vram_arbiter.arbiter.host.journal import Journal
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.clients.observer import names as own
from vram_arbiter.clients.observer.metrics import LeaseMetrics
from vram_arbiter.reasoner.llm import names as chats
from vram_arbiter.schemas.ids import ProcessKey, Token
from vram_arbiter.schemas.runtime.telemetry import names
from vram_arbiter.schemas.runtime.telemetry.names import INSTRUMENTS
from vram_arbiter.schemas.wire.requests import Drain
from vram_arbiter.schemas.wire.views import DaemonView

GUIDE = ROOT / "docs" / "reference" / "metrics.md"


class Scene:
    """An engine whose words reach the real metrics, as the daemon sends them, and a Prometheus
    endpoint's page of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.driver = CoreDriver(8 * GIB, start=False)
        self.daemon = DaemonView("vram-arbiter 1.0", "3.12")
        self.refusals: Counter[str] = Counter()
        self._registry = CollectorRegistry()
        reader = PrometheusMetricReader(scope_info_enabled=False, registry=self._registry)
        self.provider = MeterProvider([reader], shutdown_on_exit=False)
        self.numbers = LeaseMetrics(self.provider.get_meter("test"), lambda: self.driver.now)
        self._heard = 0
        self.driver.after_event = self._hear
        self.driver.advance(0.01)

    def _hear(self) -> None:
        batch: Sequence[Effect] = self.driver.effects[self._heard :]
        self._heard = len(self.driver.effects)
        for effect in batch:
            if isinstance(effect, Note):
                at_wall_s = 1.8e9 + self.driver.now
                kind = {"seq": 1, "at_wall_s": at_wall_s, "kind": effect.kind}
                self.numbers.take({**kind, **words.event(effect)})
            elif isinstance(effect, Refuse):
                self.refusals[effect.refusal.code] += 1

    def page(self) -> promql.Scrape:
        daemon = replace(self.daemon, refusals=dict(self.refusals))
        self.numbers.show(replace(self.driver.arbiter.status(self.driver.now), daemon=daemon))
        return promql.scrape(generate_latest(self._registry).decode())


# -- scenes that cause an alert
def stops(scene: Scene) -> None:
    scene.provider.shutdown()


def cannot_be_read(scene: Scene) -> None:
    scene.driver.device.failing = "the driver does not answer"
    held_by_a_consumer(scene)


def held_by_a_consumer(scene: Scene) -> None:
    scene.driver.consumer("late").acquire(GIB)
    scene.driver.advance(5.0)


def takes_what_it_was_not_given(scene: Scene) -> None:
    held(scene.driver, "det", 5)
    scene.driver.device.set(ProcessKey(77, 1), 4 * GIB, scene.driver.now)
    scene.driver.advance(5.0)


def waits_for_ever(scene: Scene) -> None:
    det, lease = held(scene.driver, "det", 5, ttl_s=3600.0)
    det.use_begin(lease)
    scene.driver.consumer("policy").acquire(5 * GIB)
    scene.driver.advance(601.0)


def frees_nothing(scene: Scene) -> None:
    det, lease = held(scene.driver, "det", 5)
    scene.driver.device.silent = True
    det.release(lease)
    scene.driver.advance(11.0)


def is_silent(scene: Scene) -> None:
    held(scene.driver, "det", 2, ttl_s=10.0)
    scene.driver.advance(20.0)


def uses_an_old_token(scene: Scene) -> None:
    det, lease = held(scene.driver, "det", 2)
    det.use_begin(lease, token=Token(1, 1))


def runs_out_of_memory(scene: Scene) -> None:
    det, lease = held(scene.driver, "det", 2)
    det.oom(lease, GIB)


def cannot_write(scene: Scene) -> None:
    scene.daemon = replace(scene.daemon, journal_failures=1, journal_healthy=False)


def lost_its_journal(scene: Scene) -> None:
    (scene.folder / "journal.sqlite").write_bytes(b"no database" * 1000)
    journal = Journal.open(scene.folder, "boot")
    scene.daemon = replace(scene.daemon, journal_doubted=journal.doubted)
    journal.close()


def refuses_its_configuration(scene: Scene) -> None:
    scene.daemon = replace(scene.daemon, config_refused=True)


def hands_over(scene: Scene) -> None:
    sent_away(scene.driver)
    scene.driver.consumer("huge").try_acquire(80 * GIB)
    used = {"cpu_user_s": 1.0, "cpu_system_s": 0.5, "memory_bytes": 40 << 20}
    scene.daemon = replace(scene.daemon, journal_writes=9, journal_write_s=0.001, **used)


def is_drained(scene: Scene) -> None:
    ops = scene.driver.consumer("ops")
    request = scene.driver.next_request()
    scene.driver.post(Asked(ops.client, request, Drain("maintenance"), operator="ops"))


CAUSES: dict[str, Callable[[Scene], None]] = {
    "VramArbiterDown": stops,
    "VramGpuUnreadable": cannot_be_read,
    "VramPressure": takes_what_it_was_not_given,
    "VramStowaway": takes_what_it_was_not_given,
    "VramWaiterStarving": waits_for_ever,
    "VramVerificationFailed": frees_nothing,
    "VramHolderSilent": is_silent,
    "VramStaleToken": uses_an_old_token,
    "VramOutOfMemory": runs_out_of_memory,
    "VramJournalUnwritable": cannot_write,
    "VramJournalDoubted": lost_its_journal,
    "VramConfigRefused": refuses_its_configuration,
    "VramDrained": is_drained,
}


type Pages = Mapping[str, tuple[promql.Scrape, promql.Scrape]]

CONSTANT = {"vram_arbiter_build_info", "vram_arbiter_gpu_capacity_bytes"}


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Pages:
    """Scrapes of an idle daemon, and of the same after each cause."""
    found = {}
    for name, cause in {**CAUSES, "a handover": hands_over}.items():
        scene = Scene(tmp_path_factory.mktemp("journal"))
        before = scene.page()
        cause(scene)
        found[name] = before, scene.page()
    return found


@pytest.mark.parametrize("name", promql.alerts("vram-arbiter"))
def test_an_alert_fires_after_its_cause_and_not_before(pages: Pages, name: str) -> None:
    """Regression: `increase` does not count a series that begins at 1, so the first lost lease, or
    the first failed verification, would have gone unseen."""
    alert, (before, after) = promql.alerts("vram-arbiter")[name], pages[name]
    assert not promql.fires(alert, before, before), "silent on an idle daemon"
    assert promql.fires(alert, before, after), [
        (str(one), promql.matched(one, before), promql.matched(one, after))
        for one in promql.selectors(alert)
    ]
    assert not promql.fires(alert, *pages["a handover"]), "silent in daily work"
    assert promql.grouped_by(alert) <= promql.TARGET_LABELS
    labels = {
        label
        for one in promql.selectors(alert)
        for key in promql.matched(one, before) | promql.matched(one, after)
        for label, _ in key
    }
    assert promql.described("vram-arbiter")[name] <= labels, "in its texts"


def test_every_curve_exists_and_moves(pages: Pages) -> None:
    every = [page for pair in pages.values() for page in pair]
    assert promql.named_without_series("arbiter.json", every) == []
    for text, expression in promql.panels("arbiter.json").items():
        unknown = promql.unknown(expression, every)
        assert not unknown, text
        for selector in promql.selectors(expression):
            if selector.name not in CONSTANT:
                assert any(
                    promql.matched(selector, before) != promql.matched(selector, after)
                    for before, after in pages.values()
                ), f"{selector} never moves"


def test_every_metric_has_a_curve(pages: Pages) -> None:
    shown = {
        str(one.name).removesuffix("_bucket")
        for expression in promql.panels("arbiter.json").values()
        for one in promql.selectors(expression)
    }
    _, after = pages["a handover"]
    assert {name for name in promql.metrics_of(after, "vram_") if name not in shown} == set()


def test_names_and_units_follow_the_conventions(pages: Pages) -> None:
    """Prometheus: base units and `_total` of counters in the name. OpenTelemetry: a namespace for
    each program, a description for every metric."""
    _, after = pages["a handover"]
    for name in promql.metrics_of(after, "vram_"):
        assert re.fullmatch(r"vram_arbiter(_[a-z]+)+", name), name
    for name, (unit, description, bounds) in INSTRUMENTS.items():
        assert re.match(
            r"(vram_(arbiter|runner|sidecar|gateway|reasoner)|process|gen_ai|hw)\.", name
        )
        assert unit in ("s", "By", "1", "Cel", "W", "") or re.fullmatch(r"\{[a-z]+\}", unit), name
        assert description[0].isupper() == (not description.startswith("1 ")), description
        assert list(bounds) == sorted(set(bounds))
        assert not name.endswith(".duration") or (unit == "s" and bounds), name
    assert set(INSTRUMENTS) == {
        value
        for module in (names, own, chats)
        for key, value in vars(module).items()
        if key.startswith(("METRIC_", "GEN_AI_"))
    }


def test_the_labels_of_the_reference_are_of_metrics_that_there_are() -> None:
    """A metric that is only written down makes an alert that never fires."""
    named = set(
        re.findall(r"`((?:vram_[a-z]+|gen_ai\.client|process)\.[a-z_.]+)", GUIDE.read_text())
    )
    found = {name for name in named if any(one.startswith(name) for one in INSTRUMENTS)}
    assert (named - found, len(named) > 10) == (set(), True)
