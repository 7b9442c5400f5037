"""Utilization, temperature and power of the GPUs, for those that ask for a status.

They are read in a thread of their own: a sensor that is slow or hangs delays neither a reading of
memory nor an answer, and no decision depends on one.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence

from vram_arbiter.arbiter.host.gpu.probe import GpuProbe
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.views import SensorsView

log = logging.getLogger(__name__)

PERIOD_S = 1.0
"""Sensors are read no more often."""
KEPT_S = 20.0
"""Values that are older are not shown. The observer of an idle arbiter asks every 15 s."""


class SensorReader:
    """`ask` and `known` are called on one thread, the loop's."""

    def __init__(
        self, probe: GpuProbe, gpus: Sequence[GpuId], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._probe = probe
        self._gpus = gpus
        self._clock = clock
        # swapped as a whole by the thread
        self._read: tuple[float, Mapping[GpuId, SensorsView]] = (clock() - KEPT_S, {})
        self._idle = threading.Event()
        self._idle.set()
        self._work: queue.SimpleQueue[bool] = queue.SimpleQueue()  # True: read, False: end
        self._thread: threading.Thread | None = None

    def ask(self) -> None:
        """Have the sensors read, unless they were a moment ago, or are now."""
        if not self._idle.is_set() or self._clock() - self._read[0] < PERIOD_S:
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="sensors", daemon=True)
            self._thread.start()
        self._idle.clear()
        self._work.put(True)

    def known(self) -> Mapping[GpuId, SensorsView]:
        """Return the newest values that are not too old."""
        read_at, found = self._read
        return found if self._clock() - read_at < KEPT_S else {}

    def close(self) -> None:
        """End the thread. A sensor that hangs is not waited for."""
        self._work.put(False)

    def _run(self) -> None:
        while self._work.get():
            asked_at = self._clock()
            try:
                self._read = asked_at, {gpu: self._probe.sensors(gpu) for gpu in self._gpus}
            except Exception:  # outermost loop of a thread: a defect is an unknown value
                log.exception("the sensors cannot be read")
                self._read = asked_at, {}
            self._idle.set()
