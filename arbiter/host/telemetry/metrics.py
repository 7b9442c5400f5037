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
from dataclasses import dataclass
from functools import partial

from opentelemetry import metrics
from opentelemetry.context import Context
from opentelemetry.metrics import CallbackOptions, Observation

from vram_arbiter.arbiter.core.model.lease import Verdict
from vram_arbiter.arbiter.core.report.status import Figures, GpuFigures
from vram_arbiter.schemas.runtime.telemetry import names
from vram_arbiter.schemas.runtime.telemetry.instruments import INSTRUMENTS
from vram_arbiter.schemas.runtime.telemetry.meters import new_counter, new_histogram

PICTURE_S = 1.0
PICTURE_MAX_AGE_S = 10.0
"""A loop that is stuck for so long knows nothing of the present: a gap in the curve, not a straight
line."""
CONSUMERS_MAX = 200
"""Names of consumers that get curves of their own; clients choose their names, and every curve
lives as long as the daemon."""
OTHERS = "(others)"

REFUSALS_FROM_ZERO = ("stale_token",)
LOSSES = ("lease_expired", "lease_lost")


@dataclass(frozen=True, slots=True)
class Picture:
    """The present: the engine's figures, and the state of the daemon's own files."""

    engine: Figures
    journal_healthy: bool = True
    journal_doubted: bool = False
    config_refused: bool = False


type _Read = Callable[[Picture], Iterable[Observation]]
"""A figure as a gauge shows it."""


class LeaseMetrics:
    """`watch` on the loop's thread begins the pictures, `close` ends them."""

    def __init__(
        self, meter: metrics.Meter, clock: Callable[[], float] = time.monotonic, version: str = ""
    ) -> None:
        self._clock = clock
        self._consumers: set[str] = set()
        # swapped as a whole: other threads read it
        self._picture: tuple[float, Picture] | None = None
        self._timer: asyncio.TimerHandle | None = None
        count, span = partial(new_counter, meter), partial(new_histogram, meter)
        self._grants = count(names.METRIC_GRANTS)
        self._denials = count(names.METRIC_DENIALS)
        self._refusals = count(names.METRIC_REFUSALS)
        self._wait = span(names.METRIC_WAIT)
        self._evictions = count(names.METRIC_EVICTIONS)
        self._verdicts = count(names.METRIC_VERDICTS)
        self._losses = count(names.METRIC_LOSSES)
        self._ooms = count(names.METRIC_OOMS)
        self._handover = span(names.METRIC_HANDOVER)
        self._journal_write = span(names.METRIC_JOURNAL_WRITE)
        self._journal_failures = count(names.METRIC_JOURNAL_FAILURES)
        self._begin_at_zero()
        for name, read in self._gauges():
            meter.create_observable_gauge(name, [self._shown(read)], *INSTRUMENTS[name][:2])
        labels = {names.ATTR_VERSION: version, names.ATTR_PYTHON: platform.python_version()}
        build = [Observation(1, labels)]
        name = names.METRIC_BUILD
        meter.create_observable_gauge(name, [lambda _: build], *INSTRUMENTS[name][:2])

    def _begin_at_zero(self) -> None:
        """Export the series of rare failures before the first one: Prometheus' `increase` does not
        count a series that begins at 1, and the alert would miss it."""
        self._journal_failures.add(0)
        self._ooms.add(0)
        for code in LOSSES:
            self._losses.add(0, {names.ATTR_ERROR_TYPE: code})
        for code in REFUSALS_FROM_ZERO:
            self._refusals.add(0, {names.ATTR_ERROR_TYPE: code})
        for verdict in Verdict:
            self._verdicts.add(0, {names.ATTR_VERDICT: verdict})

    def _gauges(self) -> Iterable[tuple[str, _Read]]:
        yield names.METRIC_WAITERS, _one(lambda seen: seen.engine.waiters)
        yield names.METRIC_OLDEST_WAIT, _one(lambda seen: seen.engine.oldest_wait_s)
        yield names.METRIC_CHARGED, self._charged
        yield names.METRIC_MEASURED, self._measured
        yield names.METRIC_USED, _by_gpu(lambda gpu: gpu.used_bytes)
        yield names.METRIC_CAPACITY, _by_gpu(lambda gpu: gpu.capacity_bytes)
        yield names.METRIC_PRESSURE, _by_gpu(lambda gpu: gpu.pressure_bytes)
        yield names.METRIC_READABLE, _by_gpu(lambda gpu: int(gpu.used_bytes is not None))
        yield names.METRIC_READING_AGE, self._reading_age
        yield names.METRIC_DRAINED, _one(lambda seen: seen.engine.drained)
        yield names.METRIC_JOURNAL_HEALTHY, _one(lambda seen: seen.journal_healthy)
        yield names.METRIC_JOURNAL_DOUBTED, _one(lambda seen: seen.journal_doubted)
        yield names.METRIC_CONFIG_REFUSED, _one(lambda seen: seen.config_refused)

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
        """A request for a lease ended without one."""
        self._denials.add(1, {names.ATTR_ERROR_TYPE: code})

    def refused(self, code: str) -> None:
        """A request of any kind was refused."""
        self._refusals.add(1, {names.ATTR_ERROR_TYPE: code})

    def judged(self, verdict: str) -> None:
        """A verification has a verdict, resolved or not."""
        self._verdicts.add(1, {names.ATTR_VERDICT: verdict})

    def evicted(self, verdict: str) -> None:
        self._evictions.add(1, {names.ATTR_VERDICT: verdict})

    def lost(self, code: str) -> None:
        """A lease ended without a release: its process died, or its TTL passed."""
        self._losses.add(1, {names.ATTR_ERROR_TYPE: code})

    def out_of_memory(self) -> None:
        """A holder reported a failed allocation."""
        self._ooms.add(1)

    def wrote(self, seconds: float, *, failed: bool) -> None:
        """One transaction of the journal."""
        self._journal_write.record(seconds)
        if failed:
            self._journal_failures.add(1)

    def watch(self, loop: asyncio.AbstractEventLoop, read: Callable[[], Picture | None]) -> None:
        """`read` gives the present, or None when it can no longer be trusted."""
        picture = read()
        self._picture = None if picture is None else (self._clock(), picture)
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

    def _charged(self, seen: Picture) -> Iterable[Observation]:
        for gpu in seen.engine.gpus:
            yield from self._by_consumer(gpu.gpu, gpu.charged)

    def _measured(self, seen: Picture) -> Iterable[Observation]:
        for gpu in seen.engine.gpus:
            if gpu.measured is not None:
                yield from self._by_consumer(gpu.gpu, gpu.measured)

    def _reading_age(self, seen: Picture) -> Iterable[Observation]:
        now = self._clock()
        for gpu in seen.engine.gpus:
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


def _one(figure: Callable[[Picture], float]) -> _Read:
    """Return the gauge of one figure; a flag is 1 or 0."""

    def read(seen: Picture) -> Iterable[Observation]:
        yield Observation(+figure(seen))

    return read


def _by_gpu(figure: Callable[[GpuFigures], int | None]) -> _Read:
    """Return the gauge of one figure of each GPU; an unknown one (None) has no series."""

    def read(seen: Picture) -> Iterable[Observation]:
        for gpu in seen.engine.gpus:
            if (count := figure(gpu)) is not None:
                yield Observation(count, {names.ATTR_GPU: gpu.gpu})

    return read
