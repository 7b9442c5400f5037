"""Metrics of the arbiter: counters and histograms from the events of its history, gauges and the
daemon's own counts from its newest status.

The SDK asks for gauges on threads of its own: it is given a finished status, and one that is old is
not shown at all.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from opentelemetry import metrics
from opentelemetry.metrics import CallbackOptions, Observation

from vram_arbiter.clients.observer import figures
from vram_arbiter.clients.observer import names as own
from vram_arbiter.clients.observer.spans import context_of
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry import names
from vram_arbiter.schemas.runtime.telemetry.meters import new_counter, new_histogram
from vram_arbiter.schemas.runtime.telemetry.names import INSTRUMENTS
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import DaemonView, GpuView, SensorsView

STATUS_MAX_AGE_S = 40.0
"""An arbiter that was not heard for so long may be anything: a gap in the curve, not a straight
line. An idle one is asked seldom."""
CONSUMERS_MAX = 200
"""Names of consumers that get curves of their own; clients choose their names, and every curve
lives as long as the observer."""
ASKED_MAX = 4096
OTHERS = "(others)"

REFUSALS_FROM_ZERO = ("stale_token",)
LOSSES = {"expired": "lease_expired", "lost": "lease_lost"}
VERDICTS = ("verified", "residue", "contested", "stale", "unverifiable")

type _Read = Callable[[StatusReply], Iterable[Observation]]
"""A figure as a gauge shows it."""


class LeaseMetrics:
    """`take` each event of the history, `show` each status; None: the arbiter is not reached."""

    def __init__(self, meter: metrics.Meter, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._consumers: set[str] = set()
        self._asked: dict[str, float] = {}  # waiter → when the first holder was revoked for it
        # swapped as a whole: other threads read it
        self._status: tuple[float, StatusReply] | None = None
        count, span = partial(new_counter, meter), partial(new_histogram, meter)
        self._grants = count(own.METRIC_GRANTS)
        self._denials = count(own.METRIC_DENIALS)
        self._wait = span(own.METRIC_WAIT)
        self._evictions = count(own.METRIC_EVICTIONS)
        self._verdicts = count(own.METRIC_VERDICTS)
        self._losses = count(own.METRIC_LOSSES)
        self._ooms = count(own.METRIC_OOMS)
        self._handover = span(own.METRIC_HANDOVER)
        self._evicting: set[str] = set()
        self._begin_at_zero()
        for name, read in self._gauges():
            unit, description, _ = INSTRUMENTS[name]
            meter.create_observable_gauge(name, [self._shown(read)], unit, description)
        for name, read in self._counts():
            unit, description, _ = INSTRUMENTS[name]
            meter.create_observable_counter(name, [self._shown(read)], unit, description)

    def _begin_at_zero(self) -> None:
        """Export the series of rare failures before the first one: Prometheus' `increase` does not
        count a series that begins at 1, and the alert would miss it."""
        self._ooms.add(0)
        for code in LOSSES.values():
            self._losses.add(0, {names.ATTR_ERROR_TYPE: code})
        for verdict in VERDICTS:
            self._verdicts.add(0, {own.ATTR_VERDICT: verdict})

    # -- the present
    def show(self, status: StatusReply | None) -> None:
        self._status = None if status is None else (self._clock(), status)

    def _gauges(self) -> Iterable[tuple[str, _Read]]:
        yield own.METRIC_WAITERS, _one(lambda seen: seen.totals.waiting)
        yield own.METRIC_OLDEST_WAIT, _one(figures.oldest_wait_s)
        yield own.METRIC_CHARGED, self._by_consumer(figures.charged)
        yield own.METRIC_MEASURED, self._by_consumer(figures.measured)
        yield own.METRIC_USED, _by_gpu(lambda gpu: gpu.measured_used_bytes)
        yield own.METRIC_CAPACITY, _by_gpu(lambda gpu: gpu.capacity_bytes)
        yield own.METRIC_PRESSURE, _by_gpu(lambda gpu: gpu.pressure_bytes)
        yield own.METRIC_READABLE, _by_gpu(lambda gpu: int(gpu.measured_used_bytes is not None))
        yield own.METRIC_READING_AGE, _by_gpu(self._age_s)
        yield own.METRIC_UTILIZATION, _sensor(lambda known: known.utilization)
        yield own.METRIC_TEMPERATURE, _sensor(lambda known: known.temperature_c)
        yield own.METRIC_POWER, _sensor(lambda known: known.power_w)
        yield own.METRIC_DRAINED, _one(lambda seen: bool(seen.drained))
        yield own.METRIC_JOURNAL_HEALTHY, _daemon(lambda daemon: daemon.journal_healthy)
        yield own.METRIC_JOURNAL_DOUBTED, _daemon(lambda daemon: daemon.journal_doubted)
        yield own.METRIC_CONFIG_REFUSED, _daemon(lambda daemon: daemon.config_refused)
        yield names.METRIC_MEMORY, _daemon(lambda daemon: daemon.memory_bytes)
        yield own.METRIC_BUILD, _build

    def _counts(self) -> Iterable[tuple[str, _Read]]:
        """What the daemon counts itself, since its start."""
        yield own.METRIC_REFUSALS, _refusals
        yield own.METRIC_JOURNAL_WRITES, _daemon(lambda daemon: daemon.journal_writes)
        yield own.METRIC_JOURNAL_TIME, _daemon(lambda daemon: daemon.journal_write_s)
        yield own.METRIC_JOURNAL_FAILURES, _daemon(lambda daemon: daemon.journal_failures)
        yield names.METRIC_CPU_TIME, _cpu_time

    def _shown(self, read: _Read) -> Callable[[CallbackOptions], Iterable[Observation]]:
        def callback(_: CallbackOptions) -> Iterable[Observation]:
            seen = self._status
            if seen is None or self._clock() - seen[0] > STATUS_MAX_AGE_S:
                return ()
            return list(read(seen[1]))

        return callback

    def _age_s(self, gpu: GpuView) -> float | None:
        if self._status is None or gpu.sample_age_s is None:
            return None
        return gpu.sample_age_s + self._clock() - self._status[0]

    def _by_consumer(self, divide: Callable[[GpuView, StatusReply], Mapping[str, int]]) -> _Read:
        def read(seen: StatusReply) -> Iterable[Observation]:
            for gpu in seen.gpus:
                sums: dict[str, int] = {}
                for consumer, count in divide(gpu, seen).items():
                    name = self._name(consumer)
                    sums[name] = sums.get(name, 0) + count
                for name, count in sums.items():
                    yield Observation(count, {names.ATTR_GPU: gpu.gpu, names.ATTR_CONSUMER: name})

        return read

    # -- what has happened
    def take(self, event: JsonMap) -> None:
        lease_id = str(event.get("lease_id"))
        match event["kind"]:
            case "granted":
                self._granted(event, lease_id)
            case "denied":
                self._asked.pop(lease_id, None)
                self._denials.add(1, {names.ATTR_ERROR_TYPE: event["code"]})
            case "refused":
                times = 1 + event.get("left_out", 0)
                self._denials.add(times, {names.ATTR_ERROR_TYPE: event["code"]})
            case "cancelled":
                self._asked.pop(lease_id, None)
            case "revoke_asked":
                self._evicting.add(lease_id)
                if (waiter := event.get("wanted_by_lease")) and len(self._asked) < ASKED_MAX:
                    self._asked.setdefault(waiter, event["at_wall_s"])
            case "revoke_withdrawn":
                self._evicting.discard(lease_id)
            case "verified":
                self._judged(event, lease_id)
            case "lost" | "expired" as kind:
                self._losses.add(1, {names.ATTR_ERROR_TYPE: LOSSES[kind]})
            case "oom":
                self._ooms.add(1)
            case "started":
                self._asked.clear()
                self._evicting.clear()

    def _granted(self, event: JsonMap, lease_id: str) -> None:
        labels, context = {names.ATTR_CONSUMER: self._name(event["consumer"])}, context_of(event)
        self._grants.add(1, labels, context)
        self._wait.record(event["waited_ms"] / 1e3, labels, context)
        asked_wall_s = self._asked.pop(lease_id, None)
        if asked_wall_s is not None and event["evicted"]:
            handover_s = max(0.0, event["at_wall_s"] - asked_wall_s)
            self._handover.record(handover_s, labels, context)

    def _judged(self, event: JsonMap, lease_id: str) -> None:
        """A verification has a verdict, resolved or not."""
        labels = {own.ATTR_VERDICT: event["verdict"]}
        self._verdicts.add(1, labels)
        if event["resolved"] and lease_id in self._evicting:
            self._evicting.discard(lease_id)
            self._evictions.add(1, labels)

    def _name(self, consumer: str) -> str:
        """Called from several threads: at worst a few more names than the limit are told apart."""
        if consumer in self._consumers:
            return consumer
        if len(self._consumers) >= CONSUMERS_MAX:
            return OTHERS
        self._consumers.add(consumer)
        return consumer


def _one(figure: Callable[[StatusReply], float]) -> _Read:
    """Return the gauge of one figure; a flag is 1 or 0."""

    def read(seen: StatusReply) -> Iterable[Observation]:
        yield Observation(+figure(seen))

    return read


def _by_gpu(figure: Callable[[GpuView], float | None]) -> _Read:
    """Return the gauge of one figure of each GPU; an unknown one (None) has no series."""

    def read(seen: StatusReply) -> Iterable[Observation]:
        for gpu in seen.gpus:
            if (count := figure(gpu)) is not None:
                yield Observation(count, {names.ATTR_GPU: gpu.gpu})

    return read


def _sensor(figure: Callable[[SensorsView], float | None]) -> _Read:
    def read(seen: StatusReply) -> Iterable[Observation]:
        for gpu in seen.gpus:
            if (value := figure(gpu.sensors)) is not None:
                labels = {own.ATTR_HARDWARE_ID: gpu.gpu, own.ATTR_HARDWARE: own.HARDWARE_GPU}
                yield Observation(value, labels)

    return read


def _daemon(figure: Callable[[DaemonView], float]) -> _Read:
    def read(seen: StatusReply) -> Iterable[Observation]:
        if seen.daemon is not None:
            yield Observation(+figure(seen.daemon))

    return read


def _refusals(seen: StatusReply) -> Iterable[Observation]:
    if seen.daemon is not None:
        counts = dict.fromkeys(REFUSALS_FROM_ZERO, 0) | dict(seen.daemon.refusals)
        for code, count in counts.items():
            yield Observation(count, {names.ATTR_ERROR_TYPE: code})


def _cpu_time(seen: StatusReply) -> Iterable[Observation]:
    if seen.daemon is not None:
        yield Observation(seen.daemon.cpu_user_s, {names.ATTR_CPU_MODE: "user"})
        yield Observation(seen.daemon.cpu_system_s, {names.ATTR_CPU_MODE: "system"})


def _build(seen: StatusReply) -> Iterable[Observation]:
    if seen.daemon is not None:
        version = seen.daemon.server.rpartition(" ")[2]
        yield Observation(1, {own.ATTR_VERSION: version, own.ATTR_PYTHON: seen.daemon.python})
