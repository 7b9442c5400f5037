"""Cameras read together: frames of one moment, as near to each other as the configuration asks.

Cameras run freely: their newest frames may be a whole period apart. A thread of its own waits for
frames taken after one moment (`read_synced`) and then, while they are too far apart, replaces the
oldest one by its camera's next. The control loop takes the newest set without waiting. A set whose
frames are too far apart is never shown.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.protocols import SensorReader
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.world import SensorFrame

SET_S = 1.0  # the longest wait for one set
RETRY_S = 0.05  # after a camera without frames
STOP_S = 2.0
STARTING = "their first frames of one moment have not come yet"

type FrameSet = Mapping[str, SensorFrame]


def read_together(
    readers: Mapping[str, SensorReader], max_spread_ns: int, deadline_ns: int, clock: Clock
) -> FrameSet:
    """Wait for a frame of each camera, all taken after this call and within `max_spread_ns`.

    Raises FrameStale at the monotonic `deadline_ns`, or when a camera ends.
    """
    begun_ns = clock.now_ns()
    frames = {
        name: reader.read_synced(deadline_ns, after_ns=begun_ns) for name, reader in readers.items()
    }
    while (spread_ns := spread_of(frames)) > max_spread_ns:
        oldest = min(frames, key=lambda name: frames[name].stamp_monotonic_ns)
        try:
            frames[oldest] = readers[oldest].read_synced(
                deadline_ns, after_ns=frames[oldest].stamp_monotonic_ns
            )
        except FrameStale as error:
            if error.details.get("ended"):
                raise
            raise FrameStale(
                f"the cameras {', '.join(readers)} took no pictures within"
                f" {max_spread_ns / 1e6:g} ms of each other; the nearest were"
                f" {spread_ns / 1e6:.0f} ms apart",
                hint="look at their rates, or allow a larger sync.max_spread_ms",
                details={"sensor_id": oldest, "spread_ms": spread_ns / 1e6},
            ) from error
    return frames


def spread_of(frames: FrameSet) -> int:
    """Return the nanoseconds between the oldest and the newest frame."""
    stamps = [frame.stamp_monotonic_ns for frame in frames.values()]
    return max(stamps) - min(stamps)


class SyncedCameras:
    """Reads started cameras together, again and again, between `start` and `stop`."""

    def __init__(
        self, readers: Mapping[str, SensorReader], max_spread_ms: float, clock: Clock
    ) -> None:
        self.names = tuple(readers)
        self._readers = dict(readers)
        self._max_spread_ns = round(max_spread_ms * 1e6)
        self._clock = clock
        self._newest: FrameSet | FrameStale = FrameStale(STARTING)
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def latest(self) -> FrameSet:
        """Return the newest set without waiting. Any thread.

        Raises FrameStale: none yet, or the reason why there was none the last time. Whether its
        frames are young enough is for the caller to judge.
        """
        newest = self._newest  # replaced whole
        if isinstance(newest, FrameStale):
            raise newest
        return newest

    def start(self) -> None:
        """Begin, once the cameras are started. Repeatable."""
        if self._thread is None:
            self._stopping.clear()
            self._thread = threading.Thread(target=self._run, name="camera-sync", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End. Stop the cameras first: that wakes a read under way. Repeatable."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(STOP_S)
            self._thread = None
        self._newest = FrameStale(STARTING)

    def _run(self) -> None:
        while not self._stopping.is_set():
            deadline_ns = self._clock.now_ns() + round(SET_S * 1e9)
            try:
                self._newest = read_together(
                    self._readers, self._max_spread_ns, deadline_ns, self._clock
                )
            except FrameStale as error:
                self._newest = error
                self._stopping.wait(RETRY_S)
