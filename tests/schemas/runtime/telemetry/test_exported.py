"""What no collector could read is written so that it can, and takes nothing else with it."""

import math
from pathlib import Path

import pytest

from tests.support.collector import Collector
from tests.support.ports import free_port
from vram_arbiter.schemas.runtime.telemetry.exported import (
    LABEL_MAX_CHARS,
    TEXT_MAX_CHARS,
    attribute,
    attributes,
    labels,
    text,
)

from .test_setup import needs_sdk, run_program

HALF = "half a pair: \ud800"


def test_what_can_be_sent_is_sent_as_it_is() -> None:
    for value in ("grün", "", True, 7, -(1 << 63), 0.5, None, math.inf, ["a", 1]):
        assert attribute(value) == value


@pytest.mark.parametrize(
    ("value", "sent"),
    [
        (HALF, "half a pair: \\ud800"),
        (b"caf\xc3\xa9 \xff", "café \ufffd"),
        (1 << 70, str(1 << 70)),
        (["a", HALF], ["a", "half a pair: \\ud800"]),
        ({"a": 1}, "{'a': 1}"),
        (Path("a"), "a"),
    ],
)
def test_what_cannot_is_said_in_other_words(value: object, sent: object) -> None:
    assert attribute(value) == sent


def test_there_is_an_end_to_everything() -> None:
    assert text("x" * TEXT_MAX_CHARS) == "x" * TEXT_MAX_CHARS
    for long in (text("x" * 10_000_000), attribute(b"x" * 10_000_000)):
        assert isinstance(long, str)
        assert (len(long), long[-1]) == (TEXT_MAX_CHARS, "…")
    assert len(text("\ud800" * TEXT_MAX_CHARS)) == TEXT_MAX_CHARS, (
        "six characters for one, and no more in all"
    )
    nested: list[object] = []
    nested.append(nested)
    assert attribute(nested) == ["[[...]]"]
    assert attributes({HALF: [HALF]}) == {"half a pair: \\ud800": ["half a pair: \\ud800"]}
    assert len(str(attribute(["x" * 1000] * 100_000))) < 200_000
    assert labels({"a": "x" * 10_000, "b": "ok"}) == {
        "a": "x" * (LABEL_MAX_CHARS - 1) + "…",
        "b": "ok",
    }


PROGRAM = """
import os, urllib.request
import vram_arbiter.schemas.runtime.telemetry.setup as o
from vram_arbiter.schemas.runtime.telemetry import meters, spans as tracing
t = o.set_up('robot', attributes={'robot': 'a\\ud800'})
half = 'half a pair: \\ud800'
with tracing.span('good', attributes={'a': 'b'}):
    tracing.event(half, what=half)
    meters.count('vram_runner.goals', {'rskill.id': half})
    meters.measure('vram_sidecar.load.duration', 1.0, {'vram.model': half})
with tracing.span(half, attributes={half: half, 'long': 'x' * 5_000_000, 'big': 1 << 70}):
    pass
try:
    with tracing.span('failed'):
        raise OSError(half)
except OSError:
    pass
port = os.environ['OTEL_EXPORTER_PROMETHEUS_PORT']
print(urllib.request.urlopen(f'http://127.0.0.1:{port}/metrics').read().decode())
t()
"""


@needs_sdk
def test_half_a_surrogate_pair_costs_no_other_span_and_no_metric() -> None:
    """Regression: an exception with an undecodable file name in its words took its whole batch of
    spans with it, and one such label every later scrape of the Prometheus endpoint."""
    with Collector() as collector:
        environ = {
            "OTEL_EXPORTER_OTLP_ENDPOINT": collector.endpoint,
            "OTEL_RESOURCE_ATTRIBUTES": "site=l\udcfcbeck",
            "OTEL_METRICS_EXPORTER": "otlp,prometheus",
            "OTEL_EXPORTER_PROMETHEUS_PORT": str(free_port()),
        }
        result = run_program(PROGRAM, environ)
        assert (result.returncode, result.stderr) == (0, "")
        sent = "half a pair: \\ud800"
        assert [span.name for span in collector.spans()] == ["good", sent, "failed"]
        good, odd, failed = collector.spans()
        assert [(event.name, event.attributes) for event in good.events] == [(sent, {"what": sent})]
        assert odd.attributes[sent] == sent
        assert len(odd.attributes["long"]) == TEXT_MAX_CHARS
        assert failed.status == f"OSError: {sent}"
        assert failed.events[0].attributes["exception.message"] == sent
        (point,) = collector.points("vram_runner.goals")
        assert point.attributes == {"rskill.id": sent}
        assert 'vram_runner_goals_total{rskill_id="half a pair: \\\\ud800"} 1.0' in result.stdout
        assert 'robot="a\\\\ud800"' in result.stdout
        assert 'site="l\\\\udcfcbeck"' in result.stdout
