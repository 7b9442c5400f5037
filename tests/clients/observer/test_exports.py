"""What a real observer exports of a real daemon: one trace through a handover, numbers for
Prometheus, log records that name their span. Whatever becomes of it touches no grant."""

import json
import os
import re
import signal
import socket
import uuid
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.collector import Collector, ReceivedSpan
from tests.support.observer import ObserverProcess
from tests.support.prepared import run
from tests.support.process import ArbiterProcess, Make
from tests.support.processes import children
from tests.support.status_page import EventStream, get, port_of
from tests.support.waiting import until
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.fakegpu import GPU_FILE
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.fakegpu_folder import locked, replace

pytestmark = pytest.mark.e2e
TRACE, PARENT = "c" * 32, "3" * 16
HERS = f"00-{TRACE}-{PARENT}-01"


@pytest.fixture
def collector() -> Iterator[Collector]:
    pytest.importorskip("opentelemetry.proto", reason="the extra `telemetry`")
    with Collector() as made:
        yield made


def on(lease: dict[str, Any]) -> dict[str, Any]:
    return {"lease_id": lease["lease_id"], "token": lease["token"]}


def hand_over(
    arbiter: ArbiterProcess, traceparent: str | None = HERS, detector: str = "detector"
) -> dict[str, Any]:
    """A detector leaves for a policy that was asked for within a trace. Returns the `revoke` that
    it heard."""
    with WireClient(arbiter.endpoint) as client:
        client.hello()
        first = client.granted(detector, 5 * GIB)
        assert client.ask("ready", **on(first))["ok"]
        fields = {"steady_bytes": 4 * GIB, "traceparent": traceparent, "nonce": uuid.uuid4().hex}
        queued = client.acquire("policy", 5 * GIB, **fields)
        assert queued["state"] == "queued", queued
        revoke = client.push("revoke")
        assert client.ask("unloading", **on(first))["ok"]
        assert client.ask("release", **on(first))["ok"]
        policy = client.push("granted")["lease"]
        assert client.ask("ready", **on(policy))["ok"]
        assert client.ask("release", **on(policy))["ok"]
    return revoke


def test_a_handover_is_one_trace(make_arbiter: Make, collector: Collector) -> None:
    """The acquirer's span is the parent of the wait, the wait that of the eviction, whose id the
    holder heard in `revoke`. Regression: the name of a log record's event was its whole sentence,
    with sizes and ids."""
    arbiter = make_arbiter(arguments=("--log-format", "json")).start()
    with ObserverProcess(arbiter, environ=collector.environ()) as observer:
        revoke = hand_over(arbiter)
        until(lambda: "policy" in granted_on(observer.port))
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
    assert revoke["traceparent"] == f"00-{TRACE}-{evict.span_id}-01"
    assert evict.attributes["vram.consumer"] == "detector"
    in_order(spans)

    arbiter.stop()
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


def granted_on(port: int) -> str:
    """Return the lines of /metrics that tell grants."""
    text = get(port, "/metrics").body.decode()
    return "\n".join(re.findall(r"^vram_arbiter_lease_grants_total.*$", text, re.MULTILINE))


def test_prometheus_reads_the_daemon(make_arbiter: Make) -> None:
    arbiter = make_arbiter(config="log: {level: info}\n").start()
    gpu = arbiter.gpu_folder / GPU_FILE
    sensors = {"utilization": 0.5, "temperature_c": 64.0, "power_w": 215.5}
    with locked(arbiter.gpu_folder):
        replace(gpu, json.dumps({**json.loads(gpu.read_text()), "sensors": sensors}))
    with ObserverProcess(arbiter) as observer:
        hand_over(arbiter)
        for wanted in (
            r'^vram_arbiter_lease_grants_total\{vram_consumer="policy"\} 1\.0$',
            r'^vram_arbiter_gpu_capacity_bytes\{vram_gpu="[^"]+"\} 8\.589934592e\+09$',
            r"^vram_arbiter_handover_duration_seconds_count\{.*\} 1\.0$",
            r"^vram_arbiter_journal_writes_total [1-9]",
            r'^hw_gpu_utilization\{hw_id="GPU-[^"]+",hw_type="gpu"\} 0\.5$',
            r"^hw_temperature_celsius\{.*\} 64\.0$",
            r"^hw_power_watts\{.*\} 215\.5$",
            r'^process_cpu_time_seconds_total\{cpu_mode="user"\} ',
            r'service_name="vram-arbiter"',
        ):
            scraped(observer.port, wanted)
        (arbiter.runtime / "arbiter.yaml").write_text("telemetri: {}\n")
        arbiter.process.send_signal(signal.SIGHUP)
        scraped(observer.port, r"^vram_arbiter_config_refused 1\.0$")
        openmetrics = get(observer.port, "/metrics", Accept="application/openmetrics-text")
        assert openmetrics.headers["content-type"].startswith("application/openmetrics-text")


def scraped(port: int, wanted: str) -> None:
    """Until it is there: an event is answered before it is counted."""
    until(lambda: re.search(wanted, get(port, "/metrics").body.decode(), re.MULTILINE))


def test_a_collector_that_is_away_delays_nothing(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        environ = {
            "OTEL_EXPORTER_OTLP_ENDPOINT": f"http://127.0.0.1:{closed.getsockname()[1]}",
            "OTEL_EXPORTER_OTLP_TIMEOUT": "0.2",
            "OTEL_BSP_SCHEDULE_DELAY": "20",
        }
        with ObserverProcess(arbiter, environ=environ) as observer:
            assert hand_over(arbiter)["traceparent"].split("-")[1] == TRACE
            scraped(observer.port, r'^vram_arbiter_lease_grants_total\{vram_consumer="policy"\}')
        assert observer.log.count("Failed to export span") <= 1, observer.log


def test_the_daemon_imports_nothing_that_looks_at_it(make_arbiter: Make) -> None:
    """After it has served a handover: no OpenTelemetry, no HTTP, no Prometheus. An eviction has its
    span all the same, in its waiter's trace."""
    arbiter = make_arbiter()
    arbiter.program = [arbiter.program[0], "-X", "importtime", *arbiter.program[1:]]
    arbiter.start()
    traceparent = hand_over(arbiter)["traceparent"]
    assert traceparent[:36] == f"00-{TRACE}-"
    assert traceparent[36:52] != PARENT
    without = hand_over(arbiter, None, "second")["traceparent"].split("-")
    assert (len(without[1]), len(without[2]), without[3]) == (32, 16, "01")
    arbiter.stop()
    imported = set(re.findall(r"^import time:.*\| +(\S+)$", arbiter.log, re.MULTILINE))
    assert "vram_arbiter.arbiter.host.executor" in imported
    for absent in (
        *("opentelemetry", "h11", "http", "prometheus_client", "uvicorn", "starlette"),
        "vram_arbiter.clients",
    ):
        found = {name for name in imported if name == absent or name.startswith(f"{absent}.")}
        assert not found


@pytest.mark.parametrize("fate", [signal.SIGKILL, signal.SIGSTOP])
def test_whatever_becomes_of_the_observer_touches_no_grant(
    make_arbiter: Make, fate: signal.Signals
) -> None:
    """Killed it is said once; hanging, with an open page and a subscription that it does not read,
    it holds nothing up. It ends with the daemon."""
    arbiter = make_arbiter(arguments=("--http", "127.0.0.1:0")).start()
    port = port_of(arbiter)
    until(lambda: get(port, "/events", method="HEAD").status == 200)
    with EventStream(port) as page:
        page.until("snapshot")
        (child,) = children(arbiter.pid)
        os.kill(child, fate)
        if fate == signal.SIGKILL:
            until(lambda: "the observer ended with -9; leases go on as before" in arbiter.log)
        for name in ("one", "two", "three"):
            hand_over(arbiter, detector=name)
    assert arbiter.stop() == 0
    assert arbiter.log.count("the observer ended") == (fate == signal.SIGKILL)
    until(lambda: ended(child))


def test_an_observer_beside_the_daemon_ends_with_it_even_if_that_is_killed(
    make_arbiter: Make,
) -> None:
    """Whether it is reaped is its new parent's affair: the tests' own process may be that, once a
    test has made it adopt orphans."""
    arbiter = make_arbiter(arguments=("--http", "127.0.0.1:0")).start()
    port_of(arbiter)
    (child,) = until(lambda: children(arbiter.pid))
    arbiter.kill()
    until(lambda: ended(child))


def ended(pid: int) -> bool:
    stat = procfs.read_stat(pid)
    return stat is None or not stat.alive


def test_no_event_is_lost_or_counted_twice_across_restarts_of_the_daemon(
    make_arbiter: Make, collector: Collector
) -> None:
    """The daemon is killed and stopped between handovers; each grant is one span and one count.
    What a crash takes from the history is lost to every reader: the observer has read it before."""
    arbiter = make_arbiter().start()
    with ObserverProcess(arbiter, environ=collector.environ()) as observer:
        hand_over(arbiter)
        # a crash loses what the history has not written yet
        until(lambda: "policy" in granted_on(observer.port))
        arbiter.kill()
        arbiter.start()
        hand_over(arbiter)
        arbiter.stop()
        arbiter.start()
        hand_over(arbiter)
        wanted = {
            f'vram_arbiter_lease_grants_total{{vram_consumer="{name}"}} 3.0' for name in NAMES
        }
        until(lambda: set(granted_on(observer.port).splitlines()) == wanted)
    spans = collector.spans("lease.acquire")
    assert len({span.span_id for span in spans}) == len(spans) == 6
    told = [line for line in collector.lines() if line.event_name == "vram_arbiter.granted"]
    assert len(told) == 6


NAMES = ("detector", "policy")


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
def test_what_the_environment_gets_wrong_ends_the_start(
    arbiter_daemon: ArbiterProcess, environ: dict[str, str], words: str
) -> None:
    environ = {**arbiter_daemon.environ, **environ}
    done = run("vram-observer", ["--http", "127.0.0.1:0"], environ, 60.0)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
