"""Spans and numbers of leases, from what a real engine says, as the daemon sends it and the
observer exports it, with the SDK's own recorders."""

from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("opentelemetry.sdk", reason="the extra `telemetry`")

from opentelemetry import trace
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import InMemoryMetricReader
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.sdk.trace.sampling import ALWAYS_OFF, ParentBased

from tests.support.core_driver import START_S, CoreDriver
from tests.support.scenes import held, sent_away
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect, Note, Push
from vram_arbiter.arbiter.host.executor import SpanIds
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.clients.observer import metrics as observer_metrics
from vram_arbiter.clients.observer import spans as otel
from vram_arbiter.clients.observer.metrics import OTHERS, LeaseMetrics
from vram_arbiter.clients.observer.spans import NotedIds, Spans, context_of
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.wire.views import DaemonView

WALL_S = 1.8e9
TRACE, PARENT = "a" * 32, "1" * 16
HERS = f"00-{TRACE}-{PARENT}-01"


class Listener:
    """Reads what an engine says as the daemon sends it, and keeps spans, numbers, events and the
    pushes as they were sent."""

    def __init__(self, sampler: Any = None) -> None:
        self.exporter = InMemorySpanExporter()
        ids = NotedIds()
        provider = TracerProvider(sampler=sampler, id_generator=ids, shutdown_on_exit=False)
        provider.add_span_processor(SimpleSpanProcessor(self.exporter))
        self.reader = InMemoryMetricReader()
        meters = MeterProvider([self.reader], shutdown_on_exit=False)
        self.now = START_S
        self.metrics = LeaseMetrics(meters.get_meter("test"), lambda: self.now)
        self.telemetry = Spans(provider.get_tracer("test"), ids)
        self.minted = SpanIds()
        self.pushed: list[dict[str, Any]] = []
        self.events: list[dict[str, Any]] = []
        self._heard = 0

    def wall_ns(self) -> int:
        return int((WALL_S + self.now) * 1e9)

    def on(self, driver: CoreDriver) -> "Listener":
        def heard() -> None:
            batch, self._heard = driver.effects[self._heard :], len(driver.effects)
            self.hear(batch, driver.now)

        driver.after_event = heard
        return self

    def hear(self, batch: list[Effect], now: float) -> None:
        self.now = now
        self.minted.outgoing(batch)
        self.pushed += [to_map(self.minted.revoke(e.body)) for e in batch if isinstance(e, Push)]
        for note in (e for e in batch if isinstance(e, Note)):
            said = {**words.event(note), **self.minted.of(note)}
            event = {"seq": 1, "at_wall_s": WALL_S + now, "kind": note.kind, **said}
            self.events.append(event)
            self.telemetry.take(event)
            self.metrics.take(event)

    def show(self, driver: CoreDriver, daemon: DaemonView | None = None) -> None:
        self.now = driver.now
        self.metrics.show(replace(driver.arbiter.status(driver.now), daemon=daemon))

    def spans(self, name: str | None = None) -> list[ReadableSpan]:
        return [s for s in self.exporter.get_finished_spans() if name is None or s.name == name]

    def span(self, name: str) -> ReadableSpan:
        (one,) = self.spans(name)
        return one

    def numbers(self, metric: str) -> dict[tuple[str, ...], float]:
        """Value (of a histogram: its sum) by the labels' values."""
        data = self.reader.get_metrics_data()
        found: dict[tuple[str, ...], float] = {}
        for group in [] if data is None else data.resource_metrics:
            for one in (
                m for scope in group.scope_metrics for m in scope.metrics if m.name == metric
            ):
                for point in one.data.data_points:
                    value = point.sum if hasattr(point, "sum") else point.value
                    found[tuple(str(v) for v in point.attributes.values())] = value
        return found


@pytest.fixture
def heard(driver: CoreDriver) -> Listener:
    return Listener().on(driver)


def parent_of(span: ReadableSpan) -> int | None:
    return None if span.parent is None else span.parent.span_id


def seconds(span: ReadableSpan) -> float:
    assert span.start_time is not None
    assert span.end_time is not None
    return (span.end_time - span.start_time) / 1e9


def failed(span: ReadableSpan) -> str | None:
    return span.status.description if not span.status.is_ok and not span.status.is_unset else None


# -- spans
def test_a_grant_at_once_is_a_load_inside_an_acquire(driver: CoreDriver, heard: Listener) -> None:
    det = driver.consumer("det")
    det.traceparent = HERS
    lease = det.acquire(2 * GIB)
    assert heard.spans() == [], "it goes on until the model is there"
    driver.advance(3.0)
    det.load(lease)
    load, acquire = heard.spans()
    assert [load.name, acquire.name] == ["lease.load", "lease.acquire"]
    assert (f"{acquire.context.trace_id:032x}", f"{parent_of(acquire):016x}") == (TRACE, PARENT)
    assert parent_of(load) == acquire.context.span_id
    assert seconds(acquire) == pytest.approx(3.0, abs=0.01)
    assert seconds(load) == pytest.approx(3.0, abs=0.01)
    assert acquire.attributes["vram.lease_id"] == lease
    assert acquire.attributes["vram.consumer"] == "det"
    assert load.attributes["vram.bytes"] == 2 * GIB


def test_a_handover_is_one_trace_with_every_part_of_it(driver: CoreDriver, heard: Listener) -> None:
    driver.device.lag_s = 0.5
    det, lease = held(driver, "det", 5)
    det.use_begin(lease)
    heard.exporter.clear()
    policy = driver.consumer("policy")
    policy.traceparent = HERS
    wanted = policy.acquire(5 * GIB)
    driver.advance(2.5)
    det.ack(lease, 1.0)
    det.use_end(lease)
    det.unloading(lease)
    driver.advance(1.0)
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    driver.advance(2.0)
    policy.load(wanted)

    acquire, queue = heard.span("lease.acquire"), heard.span("lease.queue")
    evict, verify, load = (
        heard.span("lease.evict"),
        heard.span("lease.verify"),
        heard.span("lease.load"),
    )
    assert len(heard.spans()) == 5
    assert {span.context.trace_id for span in heard.spans()} == {int(TRACE, 16)}
    assert {parent_of(span) for span in (queue, evict, load)} == {acquire.context.span_id}
    assert parent_of(verify) == evict.context.span_id
    assert seconds(evict) == pytest.approx(4.0, abs=0.1)
    assert seconds(verify) == pytest.approx(0.5, abs=0.1), "the lag of the GPU"
    assert seconds(queue) == pytest.approx(seconds(evict), abs=0.1)
    assert seconds(acquire) == pytest.approx(seconds(queue) + 2.0, abs=0.1)
    assert [event.name.rpartition(".")[2] for event in evict.events] == [
        "reminded",
        "revoke_acked",
        "unloading",
    ]
    assert evict.attributes["vram.wanted_by"] == "policy"
    assert evict.attributes["vram.verdict"] == verify.attributes["vram.verdict"] == "verified"
    assert verify.attributes["vram.bytes_before"] == 5 * GIB
    assert verify.attributes["vram.bytes_after"] == 0
    assert not [span.name for span in heard.spans() if failed(span)]
    revokes = [push for push in heard.pushed if push["push"] == "revoke"]
    assert len(revokes) > 2
    named = f"00-{TRACE}-{evict.context.span_id:016x}-"
    assert all(push["traceparent"].startswith(named) for push in revokes), (
        "the unloading is the evict's child"
    )


def test_every_victim_has_a_span_of_its_own(driver: CoreDriver, heard: Listener) -> None:
    one, first = held(driver, "one", 3)
    two, second = held(driver, "two", 3)
    heard.exporter.clear()
    wanted = driver.consumer("policy").acquire(7 * GIB)
    for person, lease in ((one, first), (two, second)):
        driver.until(lambda lease=lease: driver.state(lease) == "revoking")
        person.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    assert {span.attributes["vram.consumer"] for span in heard.spans("lease.evict")} == {
        "one",
        "two",
    }
    assert len({parent_of(span) for span in heard.spans("lease.evict")}) == 1


@pytest.mark.parametrize("how", ["cancel", "timeout", "die"])
def test_a_wait_that_ends_without_a_grant_ends_its_spans(
    driver: CoreDriver, heard: Listener, how: str
) -> None:
    det, lease = held(driver, "det", 5)
    det.use_begin(lease)
    heard.exporter.clear()
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB, wait_timeout_s=2.0)
    driver.advance(1.0)
    if how == "cancel":
        policy.cancel(wanted)
    elif how == "die":
        policy.die()
    driver.advance(1.5)
    queue, acquire, evict = heard.spans()
    names = [queue.name, acquire.name, evict.name]
    assert names == ["lease.queue", "lease.acquire", "lease.evict"]
    word = "wait_timeout" if how == "timeout" else "cancelled"
    assert str(failed(acquire)).startswith(word)
    assert heard.numbers("vram_arbiter.lease.denials") == (
        {("wait_timeout",): 1} if how == "timeout" else {}
    )
    assert seconds(acquire) == pytest.approx(2.0 if how == "timeout" else 1.0, abs=0.01)
    assert evict.context.trace_id == acquire.context.trace_id
    assert [event.name for event in evict.events][-1] == "vram.event.revoke_withdrawn"
    assert heard.numbers("vram_arbiter.lease.evictions") == {}, "nothing was evicted"


def test_what_is_refused_at_once_is_counted_once(driver: CoreDriver, heard: Listener) -> None:
    person = driver.consumer("huge")
    assert person.try_acquire(80 * GIB)
    held(driver, "det", 5, evictable=False)
    assert heard.numbers("vram_arbiter.lease.denials") == {("vram_insufficient",): 1}
    person.try_acquire(1 * GIB, gpu="GPU-7")
    assert heard.numbers("vram_arbiter.lease.denials") == {
        ("vram_insufficient",): 1,
        ("unknown_gpu",): 1,
    }


def test_a_holder_that_dies_while_it_loads_fails_its_spans(
    driver: CoreDriver, heard: Listener
) -> None:
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    det.die()
    driver.advance(1.0)
    assert driver.state(lease) == "over"
    load, acquire = heard.span("lease.load"), heard.span("lease.acquire")
    assert str(failed(load)).startswith("lost: ")
    assert str(failed(acquire)).startswith("lost: ")
    verify = heard.span("lease.verify")
    assert parent_of(verify) is None
    assert heard.numbers("vram_arbiter.lease.evictions") == {}, "it was not revoked"


def test_a_victim_that_is_lost_fails_its_eviction(driver: CoreDriver, heard: Listener) -> None:
    det, lease = held(driver, "det", 5)
    det.use_begin(lease)
    driver.consumer("policy").acquire(5 * GIB)
    det.die()
    driver.advance(1.0)
    evict = heard.span("lease.evict")
    assert str(failed(evict)).startswith("lost: ")
    assert evict.attributes["vram.verdict"] == "verified"


def test_a_lease_that_leaves_by_itself_points_to_its_acquirer(
    driver: CoreDriver, heard: Listener
) -> None:
    det = driver.consumer("det")
    det.traceparent = HERS
    lease = det.acquire(2 * GIB)
    det.load(lease)
    det.unload(lease)
    driver.advance(1.0)
    verify = heard.span("lease.verify")
    assert parent_of(verify) is None
    assert [f"{link.context.trace_id:032x}" for link in verify.links] == [TRACE]


def test_a_return_from_standby_is_a_trace_of_its_own(driver: CoreDriver, heard: Listener) -> None:
    heard_before = heard
    det = driver.consumer("det")
    det.traceparent = HERS
    lease = det.acquire(5 * GIB, standby=True)
    det.load(lease)
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    driver.advance(600.0)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    det.load(lease)
    back = heard_before.spans("lease.acquire")[-1]
    assert (back.attributes["vram.lease_id"], parent_of(back)) == (lease, None)
    assert [f"{link.context.span_id:016x}" for link in back.links] == [PARENT]
    assert seconds(back) < 1.0, "it waited for nothing"
    assert len(heard_before.spans("lease.queue")) == 1, "the policy's"


def test_a_lease_that_is_lost_while_away_leaves_nothing_open(
    driver: CoreDriver, heard: Listener
) -> None:
    det, lease, _, _ = sent_away(driver)
    count = len(heard.spans())
    det.die()
    assert driver.state(lease) == "over"
    heard.telemetry.close(heard.wall_ns())
    assert len(heard.spans()) == count


def test_an_unresolved_verdict_is_an_event_of_its_verification(
    driver: CoreDriver, heard: Listener
) -> None:
    driver.device.lag_s = (
        15.0  # the driver lists a dead process for longer than a verification takes its time
    )
    det, _ = held(driver, "det", 5)
    wanted = driver.consumer("policy").acquire(5 * GIB)
    det.die()
    driver.until(lambda: driver.state(wanted) == "loading")
    verify = heard.span("lease.verify")
    assert [(e.name, dict(e.attributes or {})) for e in verify.events] == [
        ("vram.event.verdict", {"vram.verdict": "contested"})
    ]
    assert seconds(verify) == pytest.approx(15.0, abs=0.5)
    assert heard.numbers("vram_arbiter.lease.evictions") == {("verified",): 1}


def test_a_bad_verdict_fails_the_verification(driver: CoreDriver, heard: Listener) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=100 * MIB)
    driver.consumer("policy").acquire(7 * GIB)
    det.unloading(lease)
    driver.device.set(ProcessKey(99, 1), GIB, driver.now)
    det.hold(100 * MIB)
    det.release(lease)
    driver.advance(11.0)
    assert failed(heard.span("lease.verify")) == "contested"
    assert heard.numbers("vram_arbiter.lease.evictions") == {("contested",): 1}


def test_the_daemons_end_ends_every_span(driver: CoreDriver, heard: Listener) -> None:
    det, lease = held(driver, "det", 5)
    det.use_begin(lease)
    driver.consumer("policy").acquire(5 * GIB)
    driver.consumer("other").acquire(4 * GIB)
    heard.exporter.clear()
    heard.telemetry.close(heard.wall_ns())
    names = sorted(span.name for span in heard.spans())
    assert names == ["lease.acquire", "lease.acquire", "lease.evict", "lease.queue", "lease.queue"]
    ended = [e.name for span in heard.spans() for e in span.events if "daemon" in e.name]
    assert ended == ["vram.event.daemon_stopped"] * 3
    heard.telemetry.close(heard.wall_ns())
    assert len(heard.spans()) == 5


def test_open_spans_are_bounded(
    driver: CoreDriver, heard: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(otel, "OPEN_MAX", 3)
    held(driver, "det", 6)
    heard.exporter.clear()
    for number in range(8):
        driver.consumer(f"w{number}").acquire(6 * GIB)
    gone = heard.spans("lease.acquire")
    assert [span.attributes["vram.consumer"] for span in gone] == [
        f"w{number}" for number in range(5)
    ]
    assert {failed(span) for span in gone} == {"too many spans are open"}


def test_an_unsampled_caller_is_passed_on_and_not_recorded(driver: CoreDriver) -> None:
    heard = Listener(ParentBased(ALWAYS_OFF)).on(driver)
    _, lease = held(driver, "det", 5)
    policy = driver.consumer("policy")
    policy.traceparent = HERS[:-2] + "00"
    policy.acquire(5 * GIB)
    assert heard.spans() == []
    (revoke,) = [push for push in heard.pushed if push["push"] == "revoke"]
    assert (revoke["lease_id"], revoke["traceparent"][3:35], revoke["traceparent"][-2:]) == (
        lease,
        TRACE,
        "00",
    )


def test_a_malformed_traceparent_begins_a_trace(driver: CoreDriver, heard: Listener) -> None:
    det = driver.consumer("det")
    det.traceparent = "00-zz-yy-01"
    lease = det.acquire(2 * GIB)
    det.load(lease)
    assert parent_of(heard.span("lease.acquire")) is None
    det.use_begin(lease)
    assert (heard.events[-1]["kind"], "span_id" in heard.events[-1]) == ("use_began", False)
    det.use_end(lease)
    det.unload(lease)
    driver.advance(1.0)
    assert heard.span("lease.verify").links == ()


def test_events_name_the_span_that_they_belong_to(driver: CoreDriver, heard: Listener) -> None:
    def ids(kind: str) -> tuple[str, str]:
        event = next(one for one in reversed(heard.events) if one["kind"] == kind)
        span = trace.get_current_span(context_of(event)).get_span_context()
        return f"{span.trace_id:032x}", f"{span.span_id:016x}"

    det = driver.consumer("det")
    det.traceparent = HERS
    lease = det.acquire(5 * GIB)
    det.load(lease)
    det.use_begin(lease)
    acquire = heard.span("lease.acquire")
    own = TRACE, f"{acquire.context.span_id:016x}"
    assert ids("granted") == ids("ready") == own
    assert ids("use_began") == (TRACE, PARENT), "the acquirer's own"
    det.use_end(lease)
    driver.consumer("policy").acquire(5 * GIB)
    det.unload(lease)
    driver.advance(1.0)
    evict = f"{heard.span('lease.evict').context.span_id:016x}"
    assert {ids(kind)[1] for kind in ("revoke_asked", "released", "verified")} == {evict}


def test_a_restart_of_the_daemon_ends_the_spans_of_its_former_run(
    driver: CoreDriver, heard: Listener
) -> None:
    held(driver, "det", 5)
    driver.consumer("policy").acquire(5 * GIB)
    heard.exporter.clear()
    heard.telemetry.take({"seq": 9, "at_wall_s": WALL_S + driver.now + 1.0, "kind": "started"})
    assert {span.name for span in heard.spans()} == {"lease.acquire", "lease.queue", "lease.evict"}
    assert not heard.telemetry._waits
    assert not heard.telemetry._leaving


def test_the_wall_clock_may_be_set_back(driver: CoreDriver, heard: Listener) -> None:
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    ready = {**heard.events[-1], "kind": "ready", "at_wall_s": 3.0}
    heard.telemetry.take(ready)
    assert driver.state(lease) == "loading"
    assert {seconds(span) for span in heard.spans()} == {0.0}


# -- a long history
def test_whatever_happens_spans_end_and_nest(busy: CoreDriver) -> None:
    heard = Listener()
    engine = Arbiter(busy.settings, START_S)
    for now, event in busy.events:
        heard.hear(engine.handle(event, now), now)
    states = {view.lease_id: view.state for view in engine.status(busy.now).leases}
    measured = {
        v.lease for gpu in engine.inspect().gpus.values() for v in gpu.verifications.values()
    }
    assert {states.get(lease) for lease in heard.telemetry._waits} <= {"queued", "loading"}
    on_its_way = {
        lease for lease, state in states.items() if state in ("revoking", "unloading", "verifying")
    }
    assert set(heard.telemetry._leaving) <= on_its_way | measured
    heard.telemetry.close(heard.wall_ns())
    spans = heard.spans()
    kinds = {span.name for span in spans}
    assert kinds == {"lease.acquire", "lease.queue", "lease.evict", "lease.verify", "lease.load"}
    by_id = {span.context.span_id: span for span in spans}
    assert len(by_id) == len(spans)
    inside = {
        "lease.queue": "lease.acquire",
        "lease.load": "lease.acquire",
        "lease.evict": "lease.acquire",
        "lease.verify": "lease.evict",
    }
    for span in spans:
        assert seconds(span) >= 0
        if span.parent is not None:
            assert by_id[span.parent.span_id].name == inside[span.name]
            assert span.start_time >= by_id[span.parent.span_id].start_time
        else:
            assert span.name in ("lease.acquire", "lease.verify", "lease.evict")
    granted = [e for e in busy.effects if isinstance(e, Note) and e.kind == "granted"]
    assert sum(heard.numbers("vram_arbiter.lease.grants").values()) == len(granted) > 0


# -- numbers
def test_counts_and_times_of_a_handover(driver: CoreDriver, heard: Listener) -> None:
    det, lease = held(driver, "det", 5)
    det.use_begin(lease)
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB)
    driver.advance(2.0)
    det.use_end(lease)
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    assert heard.numbers("vram_arbiter.lease.grants") == {("det",): 1, ("policy",): 1}
    waits = heard.numbers("vram_arbiter.lease.wait.duration")
    assert waits[("det",)] == pytest.approx(0.0, abs=0.01)
    assert waits[("policy",)] == pytest.approx(2.0, abs=0.1)
    assert heard.numbers("vram_arbiter.handover.duration")[("policy",)] == pytest.approx(
        2.0, abs=0.1
    )
    assert heard.numbers("vram_arbiter.lease.evictions") == {("verified",): 1}


def test_gauges_show_the_present_and_nothing_that_is_old(
    driver: CoreDriver, heard: Listener
) -> None:
    held(driver, "det", 2)
    heard.show(driver)
    assert heard.numbers("vram_arbiter.gpu.charged") == {("GPU-0", "det"): 2 * GIB}
    assert heard.numbers("vram_arbiter.gpu.measured") == {("GPU-0", "det"): 2 * GIB}
    assert heard.numbers("vram_arbiter.gpu.used") == {("GPU-0",): 2 * GIB}
    assert heard.numbers("vram_arbiter.gpu.capacity") == {("GPU-0",): 8 * GIB}
    assert heard.numbers("vram_arbiter.lease.waiters") == {(): 0}
    driver.consumer("policy").acquire(7 * GIB)
    heard.show(driver)
    assert heard.numbers("vram_arbiter.lease.waiters") == {(): 1}
    driver.device.failing = "lost"
    driver.advance(1.1)
    heard.show(driver)
    assert heard.numbers("vram_arbiter.gpu.measured") == {}, "unknown is no number"
    assert heard.numbers("vram_arbiter.gpu.charged") == {("GPU-0", "det"): 2 * GIB}
    heard.now += observer_metrics.STATUS_MAX_AGE_S + 1.0
    charged = heard.numbers("vram_arbiter.gpu.charged")
    assert charged == {}, "an old status knows nothing of the present"
    heard.show(driver)
    heard.metrics.show(None)
    assert heard.numbers("vram_arbiter.lease.waiters") == {}, "nor is there one without an arbiter"


def test_the_sum_over_consumers_is_what_the_gpu_holds(driver: CoreDriver, heard: Listener) -> None:
    """A series with consumer "" for the whole GPU doubled every `sum()`."""
    held(driver, "det", 2)
    driver.device.overhead_bytes = 300 * MIB
    driver.advance(1.1)
    heard.show(driver)
    by_consumer = heard.numbers("vram_arbiter.gpu.measured")
    assert ("GPU-0", "") not in by_consumer
    assert (
        sum(by_consumer.values())
        == heard.numbers("vram_arbiter.gpu.used")[("GPU-0",)]
        == 2 * GIB + 300 * MIB
    )


def test_the_health_of_the_daemon_in_numbers(driver: CoreDriver, heard: Listener) -> None:
    daemon = DaemonView(
        "vram-arbiter 1.0",
        "3.12",
        journal_writes=2,
        journal_write_s=0.102,
        journal_failures=1,
        refusals={"bad_request": 3},
        cpu_user_s=1.5,
        memory_bytes=40 * MIB,
    )
    heard.show(driver, daemon)
    assert heard.numbers("vram_arbiter.journal.healthy") == {(): 1}
    assert heard.numbers("vram_arbiter.journal.writes") == {(): 2}
    assert heard.numbers("vram_arbiter.journal.write.time")[()] == pytest.approx(0.102)
    assert heard.numbers("vram_arbiter.journal.failures") == {(): 1}
    assert heard.numbers("vram_arbiter.request.refusals") == {
        ("bad_request",): 3,
        ("stale_token",): 0,
    }
    assert heard.numbers("process.cpu.time")[("user",)] == 1.5
    assert heard.numbers("process.memory.usage") == {(): 40 * MIB}
    assert heard.numbers("vram_arbiter.drained") == {(): 0}
    assert heard.numbers("vram_arbiter.gpu.pressure") == {("GPU-0",): 0}
    assert heard.numbers("vram_arbiter.build.info") == {("1.0", "3.12"): 1}
    before = heard.numbers("vram_arbiter.gpu.reading_age")[("GPU-0",)]
    heard.now += 3.0
    assert heard.numbers("vram_arbiter.gpu.reading_age")[("GPU-0",)] == pytest.approx(before + 3.0)


def test_names_that_clients_invent_do_not_grow_the_metrics(
    heard: Listener, driver: CoreDriver
) -> None:
    for number in range(observer_metrics.CONSUMERS_MAX + 5):
        person = driver.consumer(f"c{number}")
        lease = person.acquire(MIB)
        person.load(lease)
        person.unload(lease)
        driver.advance(0.1)
    grants = heard.numbers("vram_arbiter.lease.grants")
    assert len(grants) == observer_metrics.CONSUMERS_MAX + 1
    assert grants[(OTHERS,)] == 5
