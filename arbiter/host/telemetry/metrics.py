"""The daemon's metrics. Counters and histograms are told what happened; gauges show what the loop
last saw.

Imported only where telemetry is on. The SDK asks for gauges on threads of its own, which must never
touch the core: the loop leaves them a finished picture every PICTURE_S, and a picture that is old
is not shown at all.
"""

import asyncio
import platform
import time
from collections.abc import Callable, Iterable, Mapping

from opentelemetry import metrics
from opentelemetry.context import Context
from opentelemetry.metrics import CallbackOptions, Observation

from vram_arbiter.arbiter.core.report.status import Figures, GpuFigures
from vram_arbiter.schemas.runtime.telemetry import names as names

PICTURE_S = 1.0
PICTURE_MAX_AGE_S = 10.0
"""A loop that is stuck for so long knows nothing of the present: a gap in the curve, not a straight
line."""
CONSUMERS_MAX = 200
"""Names of consumers that get curves of their own; clients choose their names, and every curve
lives as long as the daemon."""
OTHERS = "(others)"


class LeaseMetrics:
    """`watch` on the loop's thread begins the pictures, `close` ends them."""

    def __init__(
        self, meter: metrics.Meter, clock: Callable[[], float] = time.monotonic, version: str = ""
    ) -> None:
        self._clock = clock
        self._consumers: set[str] = set()
        self._picture: tuple[float, Figures] | None = (
            None  # swapped as a whole: read by other threads
        )
        self._timer: asyncio.TimerHandle | None = None
        self._grants = meter.create_counter(names.METRIC_GRANTS, "{grant}", "Leases granted")
        self._denials = meter.create_counter(
            names.METRIC_DENIALS, "{denial}", "Leases refused or denied"
        )
        self._wait = meter.create_histogram(names.METRIC_WAIT, "s", "From the request to the grant")
        self._evictions = meter.create_counter(
            names.METRIC_EVICTIONS,
            "{eviction}",
            "Leases that were asked to leave and measured gone, or not",
        )
        self._handover = meter.create_histogram(
            names.METRIC_HANDOVER, "s", "From the first ask to the grant that needed the room"
        )
        for name, read, unit, what in (
            (names.METRIC_WAITERS, _waiters, "{lease}", "Leases that wait"),
            (names.METRIC_CHARGED, self._charged, "By", "Bytes that are leased"),
            (names.METRIC_MEASURED, self._measured, "By", "Bytes that are held, by consumer"),
            (
                names.METRIC_USED,
                _by_gpu(lambda gpu: gpu.used_bytes),
                "By",
                "Bytes that are held on the GPU",
            ),
            (
                names.METRIC_CAPACITY,
                _by_gpu(lambda gpu: gpu.capacity_bytes),
                "By",
                "Bytes of the GPU",
            ),
            (
                names.METRIC_PRESSURE,
                _by_gpu(lambda gpu: gpu.pressure_bytes),
                "By",
                "Bytes held beyond what was granted",
            ),
            (
                names.METRIC_READING_AGE,
                self._reading_age,
                "s",
                "Since the newest successful reading",
            ),
            (
                names.METRIC_DRAINED,
                _flag(lambda figures: figures.drained),
                "",
                "1 while an operator's drain stops grants",
            ),
            (
                names.METRIC_JOURNAL_HEALTHY,
                _flag(lambda figures: figures.journal_healthy),
                "",
                "1 while the journal can be written",
            ),
        ):
            meter.create_observable_gauge(name, [self._shown(read)], unit, what)
        self._journal_write = meter.create_histogram(
            names.METRIC_JOURNAL_WRITE, "s", "One transaction of the journal"
        )
        self._journal_failures = meter.create_counter(
            names.METRIC_JOURNAL_FAILURES, "{failure}", "Transactions of the journal that failed"
        )
        self._journal_failures.add(0)  # the series exists before the first failure
        build = Observation(
            1, {names.ATTR_VERSION: version, names.ATTR_PYTHON: platform.python_version()}
        )
        meter.create_observable_gauge(
            names.METRIC_BUILD, [lambda _: [build]], "", "Version of the daemon"
        )

    def granted(
        self, consumer: str, waited_s: float, handover_s: float | None, context: Context
    ) -> None:
        labels = {names.ATTR_CONSUMER: self._name(consumer)}
        self._grants.add(1, labels, context)
        self._wait.record(waited_s, labels, context)
        if handover_s is not None:
            self._handover.record(handover_s, labels, context)

    def denied(self, code: str) -> None:
        self._denials.add(1, {names.ATTR_REASON: code})

    def evicted(self, verdict: str) -> None:
        self._evictions.add(1, {names.ATTR_VERDICT: verdict})

    def wrote(self, seconds: float, *, failed: bool) -> None:
        """One transaction of the journal."""
        self._journal_write.record(seconds)
        if failed:
            self._journal_failures.add(1)

    def watch(self, loop: asyncio.AbstractEventLoop, read: Callable[[], Figures | None]) -> None:
        """`read` gives the figures of the core, or None when they can no longer be trusted."""
        figures = read()
        self._picture = None if figures is None else (self._clock(), figures)
        self._timer = loop.call_later(PICTURE_S, self.watch, loop, read)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._picture = None

    def _shown(
        self, read: Callable[[Figures], Iterable[Observation]]
    ) -> Callable[[CallbackOptions], Iterable[Observation]]:
        def callback(_: CallbackOptions) -> Iterable[Observation]:
            picture = self._picture
            if picture is None or self._clock() - picture[0] > PICTURE_MAX_AGE_S:
                return ()
            return list(read(picture[1]))

        return callback

    def _charged(self, figures: Figures) -> Iterable[Observation]:
        for gpu in figures.gpus:
            yield from self._by_consumer(gpu.gpu, gpu.charged)

    def _measured(self, figures: Figures) -> Iterable[Observation]:
        for gpu in figures.gpus:
            if gpu.measured is not None:
                yield from self._by_consumer(gpu.gpu, gpu.measured)

    def _reading_age(self, figures: Figures) -> Iterable[Observation]:
        now = self._clock()
        for gpu in figures.gpus:
            if gpu.read_at is not None:
                yield Observation(max(0.0, now - gpu.read_at), {names.ATTR_GPU: gpu.gpu})

    def _by_consumer(self, gpu: str, amounts: Mapping[str, int]) -> Iterable[Observation]:
        sums: dict[str, int] = {}
        for consumer, count in amounts.items():
            name = self._name(consumer)
            sums[name] = sums.get(name, 0) + count
        for name, count in sums.items():
            yield Observation(count, {names.ATTR_GPU: gpu, names.ATTR_CONSUMER: name})

    def _name(self, consumer: str) -> str:
        """Called from several threads: at worst a few more names than the limit are told apart."""
        if consumer in self._consumers:
            return consumer
        if len(self._consumers) >= CONSUMERS_MAX:
            return OTHERS
        self._consumers.add(consumer)
        return consumer


def _waiters(figures: Figures) -> Iterable[Observation]:
    yield Observation(figures.waiters)


def _by_gpu(
    figure: Callable[[GpuFigures], int | None],
) -> Callable[[Figures], Iterable[Observation]]:
    """The gauge of one figure of each GPU; an unknown one (None) has no series."""

    def read(figures: Figures) -> Iterable[Observation]:
        for gpu in figures.gpus:
            if (count := figure(gpu)) is not None:
                yield Observation(count, {names.ATTR_GPU: gpu.gpu})

    return read


def _flag(flag: Callable[[Figures], bool]) -> Callable[[Figures], Iterable[Observation]]:
    def read(figures: Figures) -> Iterable[Observation]:
        yield Observation(int(flag(figures)))

    return read
