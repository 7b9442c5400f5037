"""Telemetry is asked for in standard words, refused with words that help, and costs nothing when it
is not asked for."""

import errno
import importlib.util
import logging
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence

import pytest

from tests.support.collector import Collector
from tests.support.paths import ROOT
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.ports import free_port
from vram_arbiter.schemas.runtime.telemetry import setup
from vram_arbiter.schemas.runtime.telemetry.setup import Telemetry, wanted

needs_sdk = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("opentelemetry.sdk", "prometheus_client")),
    reason="needs the extra `telemetry`",
)

BASE = "http://collector:4318"


PRELUDE = """
import sys, threading
import vram_arbiter.schemas.runtime.telemetry.setup as o
from vram_arbiter.schemas.errors import ConfigError
"""


def run_program(code: str, environ: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """In a process of its own: an SDK is installed once per process."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")}
    return subprocess.run(
        [sys.executable, "-c", PRELUDE + code],
        env={**kept, **environ},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )


type Variables = Callable[[Mapping[str, str]], None]


@pytest.fixture
def variables(monkeypatch: pytest.MonkeyPatch) -> Variables:
    """Let the environment have these variables of OpenTelemetry's, and no others."""

    def given(environ: Mapping[str, str]) -> None:
        for name in [name for name in os.environ if name.startswith("OTEL_")]:
            monkeypatch.delenv(name)
        for name, value in environ.items():
            monkeypatch.setenv(name, value)

    return given


# -- what is asked for
OTLP = ("otlp",)
OTLP_AND_PROMETHEUS = {
    "OTEL_EXPORTER_OTLP_ENDPOINT": BASE,
    "OTEL_METRICS_EXPORTER": "otlp,prometheus",
    "OTEL_EXPORTER_PROMETHEUS_PORT": "0",
}


@pytest.mark.parametrize(
    ("environ", "traces", "metrics", "logs"),
    [
        ({}, (), (), ()),
        ({"OTEL_SERVICE_NAME": "robot", "OTEL_TRACES_SAMPLER": "always_on"}, (), (), ()),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": BASE + "/"}, OTLP, OTLP, OTLP),
        ({"OTEL_LOGS_EXPORTER": "console"}, (), (), ("console",)),
        ({"OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": BASE + "/own"}, OTLP, (), ()),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": BASE, "OTEL_METRICS_EXPORTER": "none",
          "OTEL_LOGS_EXPORTER": "none"}, OTLP, (), ()),
        ({"OTEL_TRACES_EXPORTER": "otlp, console"}, ("otlp", "console"), (), ()),
        ({"OTEL_METRICS_EXPORTER": "prometheus"}, (), ("prometheus",), ()),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": BASE, "OTEL_METRICS_EXPORTER": "otlp,prometheus"}, OTLP,
         ("otlp", "prometheus"), OTLP),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": BASE, "OTEL_SDK_DISABLED": "True"}, (), (), ()),
    ],
)  # fmt: skip
def test_the_environment_says_which_exporters_are_wanted(
    environ: Mapping[str, str], traces: Sequence[str], metrics: Sequence[str], logs: Sequence[str]
) -> None:
    assert wanted(environ) == {"traces": traces, "metrics": metrics, "logs": logs}


@needs_sdk
@pytest.mark.parametrize(
    ("environ", "words"),
    [
        ({"OTEL_TRACES_EXPORTER": "zipkin"}, "no exporter 'zipkin' is installed"),
        ({"OTEL_METRICS_EXPORTER": "statsd"}, "no exporter 'statsd' is installed"),
        ({"OTEL_TRACES_EXPORTER": "otlp", "OTEL_EXPORTER_OTLP_PROTOCOL": "grpc"},
         "no exporter 'otlp_proto_grpc' is installed"),
        ({"OTEL_TRACES_EXPORTER": "otlp", "OTEL_EXPORTER_OTLP_PROTOCOL": "carrier-pigeon"},
         "expected http/protobuf or grpc, got 'carrier-pigeon'"),
        # protobuf was sent instead
        ({"OTEL_METRICS_EXPORTER": "otlp", "OTEL_EXPORTER_OTLP_METRICS_PROTOCOL": "http/json"},
         "expected http/protobuf or grpc, got 'http/json'"),
        ({"OTEL_METRICS_EXPORTER": "prometheus", "OTEL_EXPORTER_PROMETHEUS_HOST": "0.0.0.0"},
         "expected a loopback address"),
        ({"OTEL_METRICS_EXPORTER": "prometheus", "OTEL_EXPORTER_PROMETHEUS_HOST": "robot"},
         "expected ADDRESS:PORT"),
        ({"OTEL_METRICS_EXPORTER": "prometheus", "OTEL_EXPORTER_PROMETHEUS_PORT": "70000"},
         "expected ADDRESS:PORT"),
        # more than the queue holds
        ({"OTEL_BSP_MAX_EXPORT_BATCH_SIZE": "4096"}, "OpenTelemetry cannot be set up: "),
        ({"OTEL_BSP_SCHEDULE_DELAY": "0"}, "OpenTelemetry cannot be set up: "),
        ({"OTEL_METRIC_EXPORT_INTERVAL": "0"}, "OpenTelemetry cannot be set up: "),
        ({"OTEL_METRICS_EXEMPLAR_FILTER": "sometimes"}, "OpenTelemetry cannot be set up: "),
        ({"OTEL_SPAN_ATTRIBUTE_COUNT_LIMIT": "many"}, "OpenTelemetry cannot be set up: "),
    ],
)  # fmt: skip
def test_what_cannot_be_set_up_is_the_operators_error_and_leaves_no_half(
    environ: dict[str, str], words: str, variables: Variables
) -> None:
    """Regression: a bad number in an `OTEL_` variable ended programs with a traceback and left half
    a set-up."""
    variables(OTLP_AND_PROMETHEUS | environ)
    with pytest.raises(ConfigError, match=words):
        setup.set_up("robot")
    assert setup._installed is None
    assert not [one.name for one in threading.enumerate() if "serve_forever" in one.name]


@needs_sdk
@pytest.mark.parametrize(
    "package", ["opentelemetry.sdk", "opentelemetry.exporter.otlp", "prometheus_client"]
)
def test_packages_that_are_missing_are_asked_for(
    package: str, variables: Variables, monkeypatch: pytest.MonkeyPatch
) -> None:
    variables(OTLP_AND_PROMETHEUS)
    for name in [package, *(name for name in sys.modules if name.startswith(f"{package}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError) as told:
        setup.set_up("robot")
    assert "pip install 'vram-arbiter[telemetry]'" in told.value.hint


# -- on
PROGRAM = """
import logging
from vram_arbiter.schemas.runtime.telemetry import names as telemetry, spans as tracing
from vram_arbiter.schemas.errors import RobotFault
from opentelemetry import metrics
made_before = metrics.get_meter(telemetry.TRACER).create_counter(telemetry.METRIC_GOALS)
t = o.set_up('vram-runner', attributes={'robot.model': 'so101'})
assert t.on and o.set_up('other') is t
with tracing.span(telemetry.SPAN_GOAL, sys.argv[1] if len(sys.argv) > 1 else None):
    with tracing.span(telemetry.SPAN_TICK):
        tracing.event(telemetry.EVENT_ESTOP, who='operator')
        logging.getLogger('robot').warning('a \\udcff name')
        logging.getLogger('urllib3.pool').warning('of the export itself')
        print(tracing.traceparent())
        assert tracing.traceparent()[3:-3] == '-'.join(tracing.log_ids().values())
    try:
        with tracing.span(telemetry.SPAN_SEND): raise RobotFault('the bus is silent')
    except RobotFault: logging.getLogger('robot').exception('it failed')
made_before.add(3, {telemetry.ATTR_OUTCOME: 'succeeded'})
assert tracing.log_ids() == {}
"""


@needs_sdk
def test_spans_and_metrics_are_sent_at_the_end() -> None:
    with Collector() as collector:
        environ = {
            "OTEL_EXPORTER_OTLP_ENDPOINT": collector.endpoint,
            "OTEL_RESOURCE_ATTRIBUTES": "robot.model=so101-b",
        }
        # nothing is due before the end: it is the end that sends
        result = run_program(PROGRAM, environ)
        assert (result.returncode, result.stderr) == (0, "")
        tick, sent, goal = collector.spans()
        assert [tick.name, goal.name] == ["rskill.tick", "rskill.goal"]
        assert [tick.kind, goal.kind, sent.kind] == ["INTERNAL", "SERVER", "INTERNAL"]
        assert (sent.failed, sent.attributes) == (True, {"error.type": "robot_fault"})
        named, failed = collector.lines()  # not what the export itself logs
        assert (named.body, named.severity, named.service) == (
            r"a \udcff name",
            "WARN",
            "vram-runner",
        )
        assert (named.trace_id, named.span_id) == (tick.trace_id, tick.span_id)
        assert (failed.severity, failed.span_id) == ("ERROR", goal.span_id)
        assert failed.attributes["exception.type"] == "RobotFault"
        assert "the bus is silent" in failed.attributes["exception.stacktrace"]
        assert (tick.parent_id, goal.parent_id) == (goal.span_id, "")
        assert result.stdout.startswith(f"00-{tick.trace_id}-{tick.span_id}-")
        assert [(event.name, event.attributes) for event in tick.events] == [
            ("vram.event.estop_requested", {"who": "operator"})
        ]
        assert {tick.service, goal.service} == {"vram-runner"}
        (point,) = collector.points("vram_runner.goals")
        assert (point.value, point.attributes, point.service) == (
            3,
            {"outcome": "succeeded"},
            "vram-runner",
        )


@needs_sdk
@pytest.mark.parametrize(("given", "interval_ms"), [("", 5000.0), ("20000", 20000.0)])
def test_metrics_leave_every_five_seconds(
    given: str, interval_ms: float, variables: Variables
) -> None:
    variables({"OTEL_METRIC_EXPORT_INTERVAL": given, "OTEL_METRICS_EXPORTER": "console"})
    ends: list[Callable[[], object]] = []
    made = setup._meters(("console",), (), setup._resource("robot", {}), ends)
    (reader,) = made._metric_readers
    assert reader._export_interval_millis == interval_ms
    for end in ends:
        end()


@needs_sdk
def test_prometheus_is_read_on_loopback_until_the_end() -> None:
    port = str(free_port())
    result = run_program(
        "import http.client\n"
        "from vram_arbiter.schemas.runtime.telemetry import names as n\n"
        "t = o.set_up('vram-runner')\n"
        "from vram_arbiter.schemas.runtime.telemetry import meters\n"
        "meters.count(n.METRIC_GOALS, {n.ATTR_SKILL: 'grab'}, 2)\n"
        "for value in (0.3, -0.1, float('nan')): meters.measure(n.METRIC_CHUNK, value)\n"
        f"c = http.client.HTTPConnection('127.0.0.1', {port}, timeout=60)\n"
        "c.request('GET', '/metrics')\n"
        "print(c.getresponse().read().decode())\n"
        "c.close()\n"
        "t()\n"
        f"try: http.client.HTTPConnection('127.0.0.1', {port}, timeout=60).connect()\n"
        "except ConnectionRefusedError: print('refused')\n",
        {"OTEL_METRICS_EXPORTER": "prometheus", "OTEL_EXPORTER_PROMETHEUS_PORT": port},
    )
    assert (result.returncode, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert 'vram_runner_goals_total{rskill_id="grab"} 2.0' in lines
    assert 'vram_runner_chunk_duration_seconds_bucket{le="0.25"} 0.0' in lines
    assert 'vram_runner_chunk_duration_seconds_bucket{le="0.5"} 1.0' in lines
    assert "vram_runner_chunk_duration_seconds_count 1.0" in lines
    assert any('service_name="vram-runner"' in line for line in lines)
    assert lines[-1] == "refused"


@needs_sdk
@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.EADDRINUSE, "another program has"), (errno.EAFNOSUPPORT, "may have no network")],
)
def test_a_port_that_cannot_be_had_says_why(
    number: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a unit without network it said that another program had the port."""

    def refused(*arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    import prometheus_client

    monkeypatch.setattr(prometheus_client, "start_http_server", refused)
    with pytest.raises(ConfigError, match=r"no Prometheus endpoint on 127\.0\.0\.1:") as told:
        setup._prometheus([], port_required=True)
    assert reason in told.value.hint
    assert setup._prometheus([], port_required=False) == ()


@needs_sdk
def test_a_collector_that_is_away_is_complained_of_once_and_holds_up_no_end() -> None:
    with socket.socket() as deaf:  # takes connections and never answers
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        result = run_program(
            "import logging; logging.basicConfig(format='%(message)s')\n"
            "from vram_arbiter.schemas.runtime.telemetry import spans as tracing\n"
            "t = o.set_up('robot')\n"
            "from opentelemetry import trace\n"
            "for n in range(3):\n"
            "    with tracing.span('rskill.tick'): pass\n"
            "    trace.get_tracer_provider().force_flush()\n"
            "t(1.0)\n"
            "import threading; print([x.name for x in threading.enumerate() if not x.daemon])\n",
            {
                "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": f"http://127.0.0.1:{deaf.getsockname()[1]}",
                "OTEL_EXPORTER_OTLP_TIMEOUT": "0.2",
            },
        )
    assert result.returncode == 0
    assert result.stdout.strip() == "['MainThread']", (
        "nothing is left that an interpreter would wait for"
    )
    assert result.stderr.count("Failed to export") == 1, result.stderr


def test_ending_waits_for_nobody_longer_than_it_was_told() -> None:
    never, flushed = threading.Event(), threading.Event()
    said: list[str] = []
    ends = Telemetry([never.wait, lambda: (said.append("flushed"), flushed.set())])
    ends(0.5)
    ends(0.5)  # again is nothing
    assert flushed.wait(60.0)
    assert said == ["flushed"]
    never.set()


@needs_sdk
def test_an_operators_time_limits_win_over_ours(variables: Variables) -> None:
    """Regression: a limit for one signal was overridden by our 3 s."""
    variables({"OTEL_EXPORTER_OTLP_METRICS_TIMEOUT": "0.25"})
    made = {signal: setup._exporter(signal, "otlp") for signal in setup.SIGNALS}
    limits = {signal: exporter._client._timeout for signal, exporter in made.items()}
    assert limits == {"traces": 3.0, "metrics": 0.25, "logs": 3.0}


@needs_sdk
def test_no_secret_stands_in_a_message(
    variables: Variables, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: the SDK writes an unreadable header into its warning, and our message named the
    address as given."""
    variables({"OTEL_EXPORTER_OTLP_HEADERS": "geheim"})
    setup._quieten()
    setup._exporter("traces", "otlp")
    assert "Header format invalid" in caplog.text
    assert "geheim" not in caplog.text
    for url in ("htps://me:geheim@host", "htps://host/?key=geheim"):
        with pytest.raises(ConfigError, match="expected the URL of a collector") as told:
            wanted({"OTEL_EXPORTER_OTLP_ENDPOINT": url})
        assert "geheim" not in str(told.value)


def test_a_full_queue_of_spans_is_complained_of_as_seldom_as_its_collector(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Regression: only the exporters were quietened: "Queue full" was logged every 20 s."""
    setup._quieten()
    sdk = logging.getLogger("opentelemetry.sdk._shared_internal")
    for _ in range(3):
        sdk.warning("Queue full, dropping %s.", "Span")
        # another one between: the SDK's own filter lets both pass
        sdk.error("Exception while exporting %s.", "Span")
    assert caplog.text.count("Queue full") == 1
