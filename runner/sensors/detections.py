"""Newest detections of one continuous detector, or the reason why there are none.

Fails closed: detections count from the time their picture was taken, are absent once that is longer
ago than the age limit, and absent at once when the detector is evicted or fails. "Nothing found"
(fresh, empty) and "did not look" (None) stay apart. Must not know a detector, its socket or its
lease; any thread may call it.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.world import DETECTOR_PREFIX, DetectedObject


class DetectionSlot:
    """The detections in the newest picture of one camera that a detector has answered for."""

    def __init__(self, sensor_id: str, max_age_ms: float) -> None:
        self.sensor_id = sensor_id
        self.name = DETECTOR_PREFIX + sensor_id
        self.max_age_s = max_age_ms / 1e3
        self._lock = threading.Lock()
        self._objects: tuple[DetectedObject, ...] | None = None
        self._stamp_ns = 0
        self._why = "it has not looked yet"
        self._note = ""  # why the last look failed, while the one before is still fresh
        self._looks = self._stale = self._lost = 0

    def put(self, objects: Sequence[DetectedObject], stamp_ns: int, now_ns: int) -> bool:
        """Take the answer about a picture that was taken at `stamp_ns` (monotonic).

        Returns whether it is fresh; a late answer counts as stale and is dropped.
        """
        with self._lock:
            self._looks += 1
            self._note = ""
            if not self._fresh(stamp_ns, now_ns):
                self._outdated(stamp_ns, now_ns)
                return False
            self._objects, self._stamp_ns, self._why = tuple(objects), stamp_ns, ""
            return True

    def lose(self, why: str) -> None:
        """Withdraw the detections at once: the detector was evicted, or failed."""
        with self._lock:
            if self._objects is not None:
                self._lost += 1
            self._objects, self._why = None, why

    def note(self, why: str) -> None:
        """Note a look that failed for want of a picture; the last detections age by themselves."""
        with self._lock:
            self._note = why
            if self._objects is None:
                self._why = why

    def fresh(self, now_ns: int) -> tuple[DetectedObject, ...] | None:
        """Return the detections, possibly none, or None where there is no fresh look."""
        with self._lock:
            if self._objects is not None and not self._fresh(self._stamp_ns, now_ns):
                self._outdated(self._stamp_ns, now_ns)
            return self._objects

    @property
    def why(self) -> str:
        """Return why there are no detections; "" while there are."""
        with self._lock:
            return self._why

    def facts(self) -> JsonObject:
        """Return the counts: looks that were answered, those that were or became stale before the
        next one, and those withdrawn by an eviction or a failure.
        """
        with self._lock:
            return {"looks": self._looks, "stale": self._stale, "withdrawn": self._lost}

    def _fresh(self, stamp_ns: int, now_ns: int) -> bool:
        return 0 <= now_ns - stamp_ns <= self.max_age_s * 1e9

    def _outdated(self, stamp_ns: int, now_ns: int) -> None:
        ages = f"{(now_ns - stamp_ns) / 1e6:.0f} ms old, {self.max_age_s * 1e3:.0f} ms are accepted"
        self._objects = None
        self._why = f"{self._note} ({ages})" if self._note else ages
        self._stale += 1
        meters.count(telemetry.METRIC_STALE_DETECTIONS, {telemetry.ATTR_SENSOR: self.sensor_id})
