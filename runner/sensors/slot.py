"""Slot of a camera's newest frame, or of the reason why there is none.

Every reader is built on this, so that all mean the same by `fresh`, `stale`, `interrupted` and
`ended`. Must not know devices, decoders or topics. It holds one frame: a slow consumer sees fewer
frames, never older ones.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Protocol

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.world import SensorFrame

log = logging.getLogger(__name__)

STOP_S = 2.0  # how long `stop` waits for a driver; its thread then ends by itself, deaf
NOT_STARTED = "its reader was not started"
STOPPED = "its reader was stopped"
BROKE_DOWN = "the thread of its reader broke down; its log says why"


class FrameTee(Protocol):
    """Gets every frame as well, on the camera's thread: it must not wait and must not raise."""

    def publish(self, frame: SensorFrame) -> None: ...

    def close(self) -> None: ...


class LatestSlot:
    """The newest frame of one camera under a lock, or the reason why there is none.

    Reads on any thread. `open` returns the feed through which one thread fills it. A replaced feed
    has no effect: a thread that hangs in a driver and returns after a restart cannot deliver an old
    picture.
    """

    def __init__(self, sensor_id: str, max_age_ms: float, clock: Clock) -> None:
        self.sensor_id = sensor_id
        self.max_age_ms = max_age_ms
        self._clock = clock
        self._changed = threading.Condition()
        self._frame: SensorFrame | None = None
        self._reason = NOT_STARTED
        self._ended = True
        self._absent = False
        self._feed: Feed | None = None

    def open(self) -> Feed:
        """Forget what was there and begin anew: no frame until the new feed puts one."""
        with self._changed:
            self._frame, self._reason, self._ended, self._absent = None, "", False, False
            self._feed = Feed(self)
            return self._feed

    def latest(self, max_age_ms: float | None = None) -> SensorFrame:
        """Return the newest frame without waiting.

        Raises FrameStale: none yet, older than `max_age_ms` (None: as configured), or ended.
        """
        limit_ms = self.max_age_ms if max_age_ms is None else max_age_ms
        with self._changed:
            frame = self._frame
            if frame is None:
                raise self._missing()
        age_ms = frame.age_s(self._clock.now_ns()) * 1e3
        if not 0 <= age_ms <= limit_ms:  # said so that a limit of NaN refuses, too
            raise self._too_old(age_ms, limit_ms)
        return frame

    def synced(self, deadline_ns: int, after_ns: int | None = None) -> SensorFrame:
        """Wait for a frame taken after `after_ns` (None: after this call).

        Raises FrameStale at the monotonic `deadline_ns`, and as soon as the source ends.
        """
        begun_ns = self._clock.now_ns()
        after_ns = begun_ns if after_ns is None else after_ns
        with self._changed:
            while True:
                if self._frame is not None and self._frame.stamp_monotonic_ns > after_ns:
                    return self._frame
                left_s = (deadline_ns - self._clock.now_ns()) / 1e9
                if self._ended or (left_s <= 0 and self._frame is None):
                    raise self._missing()
                if left_s <= 0:
                    raise FrameStale(
                        f"camera {self.sensor_id} took no new picture"
                        f" within {(deadline_ns - begun_ns) / 1e6:.0f} ms",
                        hint="look at its rate, or wait longer",
                        details={"sensor_id": self.sensor_id, "reason": self._reason},
                    )
                self._changed.wait(left_s)

    @property
    def ended(self) -> str | None:
        """Why the source gives nothing any more; None while it may still."""
        with self._changed:
            return self._reason if self._ended else None

    def _missing(self) -> FrameStale:
        reason = self._reason or "its first picture has not come yet"
        return FrameStale(
            f"camera {self.sensor_id} has no frame: {reason}",
            hint="nothing moves without a picture; look at the camera"
            if self._ended
            else "it may come back by itself",
            details={
                "sensor_id": self.sensor_id,
                "reason": reason,
                "ended": self._ended,
                "absent": self._absent,
            },
        )

    def _too_old(self, age_ms: float, limit_ms: float) -> FrameStale:
        if age_ms < 0:
            problem = f"is stamped {-age_ms:.0f} ms in the future"
            hint = "stamps must be of this machine's monotonic clock"
        else:
            problem = f"is {age_ms:.0f} ms old, {limit_ms:.0f} ms are accepted"
            hint = "the camera hangs or is slower than max_age_ms allows"
        return FrameStale(
            f"the newest frame of camera {self.sensor_id} {problem}",
            hint=hint,
            details={"sensor_id": self.sensor_id, "age_ms": age_ms, "max_age_ms": limit_ms},
        )

    def _put(self, feed: Feed, frame: SensorFrame) -> bool:
        if frame.sensor_id != self.sensor_id:
            raise ValueError(f"a frame of {frame.sensor_id} in the slot of {self.sensor_id}")
        with self._changed:
            if feed is not self._feed or self._ended:
                return False
            if (
                self._frame is not None
                and frame.stamp_monotonic_ns < self._frame.stamp_monotonic_ns
            ):
                return False
            self._frame, self._reason = frame, ""
            self._changed.notify_all()
            return True

    def _lose(self, feed: Feed, reason: str, *, ended: bool, absent: bool = False) -> bool:
        with self._changed:
            if feed is not self._feed or self._ended:
                return False
            self._frame, self._reason = None, reason
            self._ended, self._absent = ended, absent
            self._changed.notify_all()
            return True


class Feed:
    """Writing side of a slot, for one run of one reader. Calls return whether they had an
    effect.
    """

    def __init__(self, slot: LatestSlot) -> None:
        self._slot = slot

    def put(self, frame: SensorFrame) -> bool:
        """Make it the newest.

        Without effect if the feed was replaced or ended, or a later frame is there.
        """
        return self._slot._put(self, frame)

    def interrupt(self, reason: str) -> bool:
        """Report that the source is away for now: its last frame is not served any more."""
        return self._slot._lose(self, reason, ended=False)

    def await_source(self, reason: str) -> bool:
        """Report that another program has not started the source yet: it is worth waiting for."""
        return self._slot._lose(self, reason, ended=False, absent=True)

    def end(self, reason: str) -> bool:
        """Report that the source is away for good. The first reason stays."""
        return self._slot._lose(self, reason, ended=True)


class SlotReader(ABC):
    """A `SensorReader` whose thread, bus or listener fills a slot; subclasses provide it.

    They override `_run_begins` and `_run_ends`. `start` and `stop` may be repeated. After `stop`
    every read raises FrameStale; `start` begins anew.
    """

    decodes_on_gpu = False
    """Whether its pictures come from a decoder that takes memory of an NVIDIA GPU."""

    def __init__(
        self, sensor_id: str, max_age_ms: float, clock: Clock, tee: FrameTee | None = None
    ) -> None:
        self.sensor_id = sensor_id
        self.clock = clock
        self.slot = LatestSlot(sensor_id, max_age_ms, clock)
        self._tee = tee
        self._feed: Feed | None = None

    def start(self) -> None:
        """Open the source. A source that cannot be opened may raise or end its feed."""
        if self._feed is not None:
            return
        feed = self._feed = self.slot.open()
        try:
            self._run_begins(feed)
        except BaseException:
            self._feed = None
            feed.end("it could not be started")
            raise

    def read_latest(self, max_age_ms: float | None = None) -> SensorFrame:
        return self.slot.latest(max_age_ms)

    def read_synced(self, deadline_ns: int, after_ns: int | None = None) -> SensorFrame:
        return self.slot.synced(deadline_ns, after_ns)

    def stop(self) -> None:
        """Close the source and the tee. Readers that wait are woken with FrameStale first."""
        feed, self._feed = self._feed, None
        if feed is None:
            return
        feed.end(STOPPED)
        try:
            self._run_ends()
        finally:
            if self._tee is not None:
                self._tee.close()

    def deliver(self, feed: Feed, frame: SensorFrame) -> None:
        """Called by the source's thread for each frame: into the slot first, then to the tee."""
        if feed.put(frame) and self._tee is not None:
            self._tee.publish(frame)

    @abstractmethod
    def _run_begins(self, feed: Feed) -> None:
        """Begin to call `deliver(feed, frame)`, `feed.interrupt` and `feed.end` on a thread of its
        own.
        """

    @abstractmethod
    def _run_ends(self) -> None:
        """Stop calling them and close the source, within a bounded time. The feed is ended
        already.
        """


class ThreadReader(SlotReader):
    """A reader with a thread of its own, which alone touches the source."""

    _stopping = threading.Event()  # of this run
    _thread: threading.Thread | None = None

    def _begin(self, run: Callable[[threading.Event], None]) -> None:
        self._stopping = threading.Event()
        self._thread = threading.Thread(
            target=run, args=(self._stopping,), name=f"camera-{self.sensor_id}", daemon=True
        )
        self._thread.start()

    def _run_ends(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(STOP_S)
            if self._thread.is_alive():
                log.warning(
                    "camera %s: its driver does not let go; the thread is left behind",
                    self.sensor_id,
                )
            self._thread = None
