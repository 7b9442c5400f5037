"""Telemetry of a real daemon: one trace through a handover, numbers on loopback, lines that name
their span, and nothing at all when off."""

import http.client
import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.support.collector import Collector, ReceivedSpan
from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e
GIB = 1 << 30
TRACE, PARENT = "c" * 32, "3" * 16
HERS = f"00-{TRACE}-{PARENT}-01"

Make = Callable[..., ArbiterProcess]


@pytest.fixture
def collector() -> Iterator[Collector]:
    pytest.importorskip("opentelemetry.proto", reason="the extra `telemetry`")
    with Collector() as made:
        yield made


def on(lease: dict[str, Any]) -> dict[str, Any]:
    return {"lease_id": lease["lease_id"], "token": lease["token"]}


def hand_over(arbiter: ArbiterProcess) -> dict[str, Any]:
    """A detector leaves for a policy that was asked for within a trace. Returns the `revoke` that
    it heard."""
    client = WireClient(arbiter.endpoint).hello()
    try:
        detector = client.granted("detector", 5 * GIB)
        assert client.ask("ready", **on(detector))["ok"]
        queued = client.ask(
            "acquire",
            nonce="policy",
            traceparent=HERS,
            spec={
                "consumer": "policy",
                "model_id": "policy",
                "ttl_s": 600.0,
                "footprint": {
                    "load_peak_bytes": 5 * GIB,
                    "steady_bytes": 4 * GIB,
                    "residue_bytes": 0,
                },
            },
        )
        assert queued["state"] == "queued", queued
        revoke = client.push("revoke")
        assert client.ask("unloading", **on(detector))["ok"]
        assert client.ask("release", **on(detector))["ok"]
        policy = client.push("granted")["lease"]
        assert client.ask("ready", **on(policy))["ok"]
    finally:
        client.close()
    return revoke


def test_a_handover_is_one_trace(make_arbiter: Make, collector: Collector) -> None:
    """Regression: the name of a log record's event was its whole sentence, with sizes and ids."""
    arbiter = make_arbiter(arguments=("--log-format", "json")).start(collector.environ())
    revoke = hand_over(arbiter)
    arbiter.stop()
    spans = {span.name: span for span in collector.spans() if span.trace_id == TRACE}
    assert set(spans) == {
        "lease.acquire",
        "lease.queue",
        "lease.evict",
        "lease.verify",
        "lease.load",
    }
    acquire, evict = spans["lease.acquire"], spans["lease.evict"]
    assert acquire.parent_id == PARENT
    assert {spans[name].parent_id for name in ("lease.queue", "lease.evict", "lease.load")} == {
        acquire.span_id
    }
    assert spans["lease.verify"].parent_id == evict.span_id
    assert {span.service for span in spans.values()} == {"vram-arbiter"}
    assert revoke["traceparent"].split("-")[1:3] == [TRACE, evict.span_id]
    assert evict.attributes["vram.consumer"] == "detector"
    in_order(spans)
    (run,) = collector.spans("cli.command")
    assert (run.parent_id, run.attributes) == ("", {"cli.command": "serve", "process.exit.code": 0})

    lines = [json.loads(line) for line in arbiter.log.splitlines() if line.startswith("{")]
    named = {line["event"]["kind"]: line for line in lines if line.get("trace_id") == TRACE}
    assert (named["granted"]["span_id"], named["revoke_asked"]["span_id"]) == (
        acquire.span_id,
        evict.span_id,
    )
    told = {line.event_name: line for line in collector.lines() if line.trace_id == TRACE}
    assert told["vram_arbiter.granted"].span_id == acquire.span_id
    assert told["vram_arbiter.granted"].attributes["vram.consumer"] == "policy"
    assert told["vram_arbiter.verified"].attributes["vram.verdict"] == "verified"
    grants = collector.points("vram_arbiter.lease.grants")
    assert {point.attributes["vram.consumer"]: point.value for point in grants[-2:]} == {
        "detector": 1,
        "policy": 1,
    }
    assert collector.points("vram_arbiter.lease.evictions")[-1].attributes == {
        "vram.verdict": "verified"
    }
    assert collector.points("vram_arbiter.handover.duration")[-1].count == 1


def in_order(spans: dict[str, ReceivedSpan]) -> None:
    acquire, load = spans["lease.acquire"], spans["lease.load"]
    for span in spans.values():
        assert acquire.start_ns <= span.start_ns <= span.end_ns <= acquire.end_ns
    assert spans["lease.queue"].end_ns <= load.start_ns
    assert spans["lease.evict"].end_ns <= load.start_ns


def test_prometheus_reads_the_gpus_on_loopback(make_arbiter: Make) -> None:
    pytest.importorskip("prometheus_client", reason="the extra `telemetry`")
    arbiter = make_arbiter(config="telemetry:\n  prometheus_port: 0\n").start()
    hand_over(arbiter)
    found = re.search(r"Prometheus endpoint on loopback, port (\d+)", arbiter.log)
    assert found, arbiter.log
    port = int(found[1])
    for wanted in (
        r'^vram_arbiter_lease_grants_total\{vram_consumer="policy"\} 1\.0$',
        r'^vram_arbiter_gpu_capacity_bytes\{vram_gpu="[^"]+"\} 8\.589934592e\+09$',
        r"^vram_arbiter_handover_duration_seconds_count\{.*\} 1\.0$",
        r'service_name="vram-arbiter"',
    ):
        scraped(port, wanted)
    (arbiter.runtime / "arbiter.yaml").write_text("telemetri: {}\n")
    assert arbiter.process is not None
    arbiter.process.send_signal(signal.SIGHUP)
    scraped(port, r"^vram_arbiter_config_refused 1\.0$")

    other = make_arbiter(config=f"telemetry:\n  prometheus_port: {port}\n")
    other.spawn()
    assert other.process is not None
    assert other.process.wait(60) == 2
    assert f"no Prometheus endpoint on 127.0.0.1:{port}" in other.log
    arbiter.stop()


def scraped(port: int, wanted: str) -> None:
    """Until it is there: an event is answered before it is counted, and a loop that was held up
    shows no picture of the GPUs."""
    deadline = time.monotonic() + 60.0
    while not re.search(wanted, text := scrape(port), re.MULTILINE):
        assert time.monotonic() < deadline, f"no {wanted} in {text}"


def scrape(port: int) -> str:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("GET", "/metrics")
        return connection.getresponse().read().decode()
    finally:
        connection.close()


def test_a_collector_that_is_away_changes_nothing(make_arbiter: Make) -> None:
    pytest.importorskip("opentelemetry.sdk", reason="the extra `telemetry`")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        environ = {
            "OTEL_EXPORTER_OTLP_ENDPOINT": f"http://127.0.0.1:{closed.getsockname()[1]}",
            "OTEL_EXPORTER_OTLP_TIMEOUT": "0.2",
            "OTEL_BSP_SCHEDULE_DELAY": "20",
        }
        arbiter = make_arbiter().start(environ)
        assert hand_over(arbiter)["traceparent"].split("-")[1] == TRACE
        assert arbiter.process is not None
        arbiter.process.terminate()
        assert arbiter.process.wait(60) == 0
    assert arbiter.log.count("Failed to export span") <= 1, arbiter.log


def test_off_imports_nothing_and_passes_the_trace_on(make_arbiter: Make) -> None:
    arbiter = make_arbiter()
    arbiter.program = [arbiter.program[0], "-X", "importtime", *arbiter.program[1:]]
    arbiter.start()
    assert hand_over(arbiter)["traceparent"] == HERS, "the waiter's own: there is no span of ours"
    arbiter.stop()
    assert "vram_arbiter.arbiter.host.executor" in arbiter.log
    assert "opentelemetry" not in arbiter.log
    assert "prometheus_client" not in arbiter.log


@pytest.mark.parametrize(
    ("environ", "words"),
    [
        (
            {"OTEL_EXPORTER_OTLP_ENDPOINT": "collector"},
            "OTEL_EXPORTER_OTLP_ENDPOINT: expected the URL of a collector",
        ),
        (
            {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://x", "OTEL_EXPORTER_OTLP_PROTOCOL": "grpc"},
            "no exporter 'otlp_proto_grpc' is installed",
        ),
    ],
)
def test_what_the_environment_gets_wrong_is_found_before_a_start(
    make_arbiter: Make, environ: dict[str, str], words: str
) -> None:
    arbiter = make_arbiter()
    done = subprocess.run(
        arbiter.command("--check-config"),
        env={**arbiter.environ, **environ},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
