"""The daemon's metrics. Counters and histograms are told what happened; gauges show what the loop
last saw.

Imported only where telemetry is on. The SDK asks for gauges on threads of its own, which must never
touch the core: the loop leaves them a finished picture every PICTURE_S, and a picture that is old
is not shown at all.
"""

import asyncio
import operator
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

type _Read = Callable[[Figures], Iterable[Observation]]
"""A figure of the engine as a gauge shows it."""


class LeaseMetrics:
    """`watch` on the loop's thread begins the pictures, `close` ends them."""

    def __init__(
        self, meter: metrics.Meter, clock: Callable[[], float] = time.monotonic, version: str = ""
    ) -> None:
        self._clock = clock
        self._consumers: set[str] = set()
        # swapped as a whole: other threads read it
        self._picture: tuple[float, Figures] | None = None
        self._timer: asyncio.TimerHandle | None = None
        count, span = meter.create_counter, meter.create_histogram
        self._grants = count(names.METRIC_GRANTS, "{grant}", "Leases granted")
        self._denials = count(names.METRIC_DENIALS, "{denial}", "Leases refused or denied")
        self._wait = span(names.METRIC_WAIT, "s", "From the request to the grant")
        left = "Leases that were asked to leave and measured gone, or not"
        self._evictions = count(names.METRIC_EVICTIONS, "{eviction}", left)
        made_room = "From the first ask to the grant that needed the room"
        self._handover = span(names.METRIC_HANDOVER, "s", made_room)
        self._journal_write = span(
            names.METRIC_JOURNAL_WRITE, "s", "One transaction of the journal"
        )
        failed = "Transactions of the journal that failed"
        self._journal_failures = count(names.METRIC_JOURNAL_FAILURES, "{failure}", failed)
        self._journal_failures.add(0)  # the series exists before the first failure
        for name, unit, what, read in self._gauges():
            meter.create_observable_gauge(name, [self._shown(read)], unit, what)
        labels = {names.ATTR_VERSION: version, names.ATTR_PYTHON: platform.python_version()}
        build = [Observation(1, labels)]
        meter.create_observable_gauge(
            names.METRIC_BUILD, [lambda _: build], "", "Version of the daemon"
        )

    def _gauges(self) -> Iterable[tuple[str, str, str, _Read]]:
        """Name, unit, meaning and reader of each figure that is shown as it is."""
        used, capacity = operator.attrgetter("used_bytes"), operator.attrgetter("capacity_bytes")
        over = operator.attrgetter("pressure_bytes")
        since = "Since the newest successful reading"
        drained, healthy = (
            "while an operator's drain stops grants",
            "while the journal can be written",
        )
        yield names.METRIC_WAITERS, "{lease}", "Leases that wait", _waiters
        yield names.METRIC_CHARGED, "By", "Bytes that are leased", self._charged
        yield names.METRIC_MEASURED, "By", "Bytes that are held, by consumer", self._measured
        yield names.METRIC_USED, "By", "Bytes that are held on the GPU", _by_gpu(used)
        yield names.METRIC_CAPACITY, "By", "Bytes of the GPU", _by_gpu(capacity)
        yield names.METRIC_PRESSURE, "By", "Bytes held beyond what was granted", _by_gpu(over)
        yield names.METRIC_READING_AGE, "s", since, self._reading_age
        yield names.METRIC_DRAINED, "", f"1 {drained}", _flag(lambda seen: seen.drained)
        yield (
            names.METRIC_JOURNAL_HEALTHY,
            "",
            f"1 {healthy}",
            _flag(lambda seen: seen.journal_healthy),
        )

    def granted(
        self, consumer: str, waited_s: float, handover_s: float | None, context: Context
    ) -> None:
        """`handover_s`: from the first revoke to the grant, where an eviction made room. `context`:
        its span, for exemplars."""
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

    def _shown(self, read: _Read) -> Callable[[CallbackOptions], Iterable[Observation]]:
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


def _by_gpu(figure: Callable[[GpuFigures], int | None]) -> _Read:
    """The gauge of one figure of each GPU; an unknown one (None) has no series."""

    def read(figures: Figures) -> Iterable[Observation]:
        for gpu in figures.gpus:
            if (count := figure(gpu)) is not None:
                yield Observation(count, {names.ATTR_GPU: gpu.gpu})

    return read


def _flag(flag: Callable[[Figures], bool]) -> _Read:
    def read(figures: Figures) -> Iterable[Observation]:
        yield Observation(int(flag(figures)))

    return read
