"""World state: joint state, camera frames and detections, each fresh or marked as stale.

Fails closed. A component older than its limit is `stale` in `diagnostics`, one whose source failed
is `error`. A camera's frame is then missing from `image_frames`, and both stay so (latched) until
RECOVERY_UPDATES fresh values have come in a row: a camera that flickers must not make the arm jerk.
Nothing is filled in: without any joint state there is no world state. Must not know sensors or
robots; any thread may call it.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.schemas.errors import StateStale
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import (
    DetectedObject,
    Diagnostic,
    JointState,
    SensorFrame,
    WorldState,
)

JOINT_STATE = "joint_state"  # its name among the components; no camera may be called so
RATE_HZ = 30.0
JOINT_MAX_AGE_MS = 100.0
RECOVERY_UPDATES = 3
FUTURE_TOLERANCE_MS = 5.0  # a stamp further ahead is of another clock, and its age unknown
# share of a period by which a caller may be early and still be on the cadence: ticks jitter
EARLY = 0.25
_LATCHED = {"stale": telemetry.EVENT_STALE, "error": telemetry.EVENT_ERROR}


@dataclass(slots=True)
class _Component:
    max_age_ns: int
    stamp_ns: int | None = None
    latched: bool = False
    failed: bool = False  # while latched: its source failed, beyond being late
    fresh_in_a_row: int = 0
    why: str = "nothing has come from it yet"
    note: str = ""  # why its last update failed, while it lives on the value before

    def judge(self, now_ns: int) -> None:
        """Latch it if its newest value is too old."""
        if self.stamp_ns is None or (age_ns := now_ns - self.stamp_ns) <= self.max_age_ns:
            return
        if self.latched:  # the first reason says more than its growing age
            self.fresh_in_a_row = 0
            return
        ages = f"{age_ns / 1e6:.0f} ms old, {self.max_age_ns / 1e6:.0f} ms are accepted"
        self.latch(f"{self.note} ({ages})" if self.note else ages, failed=bool(self.note))

    def latch(self, why: str, *, failed: bool = False) -> None:
        self.latched, self.failed, self.fresh_in_a_row, self.why = True, failed, 0, why

    def update(self, stamp_ns: int, now_ns: int) -> bool:
        """Take the stamp of an update. Returns whether its value is new and may be kept.

        A pause between two updates is judged by snapshots in between: a slow loop asks rarely, and
        what it then measures is fresh.
        """
        if stamp_ns - now_ns > FUTURE_TOLERANCE_MS * 1e6:
            ahead_ms = (stamp_ns - now_ns) / 1e6
            self.latch(
                f"stamped {ahead_ms:.0f} ms in the future;"
                " stamps must be of this machine's monotonic clock"
            )
            return False
        if self.stamp_ns is not None and stamp_ns <= self.stamp_ns:
            return False  # the same value once more, or one that was overtaken
        self.stamp_ns = stamp_ns
        if now_ns - stamp_ns > self.max_age_ns:
            self.judge(now_ns)
            return True
        self.note = ""
        if self.latched:
            self.fresh_in_a_row += 1
            self.latched = self.fresh_in_a_row < RECOVERY_UPDATES
        return True

    @property
    def diagnostic(self) -> Diagnostic:
        if self.latched:
            return "error" if self.failed else "stale"
        return "stale" if self.stamp_ns is None else "ok"


class WorldStateAggregator:
    """`max_age_ms` names the cameras and the age limits of their frames; `topics` where they are
    published.

    It has a cadence of its own: `due` tells when cameras are to be read again, so that a loop of
    200 Hz does not copy pictures 200 times a second. Ages are judged at every snapshot.
    """

    def __init__(
        self,
        max_age_ms: Mapping[str, float],
        *,
        topics: Mapping[str, str] | None = None,
        detections: Sequence[DetectionSlot] = (),
    ) -> None:
        if JOINT_STATE in max_age_ms:
            raise ValueError(f"no camera may be called {JOINT_STATE}")
        self._components = {name: _Component(round(age * 1e6)) for name, age in max_age_ms.items()}
        self._joints = self._components[JOINT_STATE] = _Component(round(JOINT_MAX_AGE_MS * 1e6))
        self._topics = dict(topics or {})
        self._detections = tuple(detections)
        self._period_ns = round(1e9 / RATE_HZ)
        self._next_ns: int | None = None
        self._joint_state: JointState | None = None
        self._frames: dict[str, SensorFrame] = {}
        self._told: dict[str, Diagnostic] = {}  # of the snapshot before
        self._lock = threading.Lock()

    def due(self, now_ns: int) -> bool:
        """Return whether cameras are due, once per slot of the cadence; missed slots are
        skipped.
        """
        early_ns = round(self._period_ns * EARLY)
        with self._lock:
            if self._next_ns is None:
                self._next_ns = now_ns
            if now_ns < self._next_ns - early_ns:
                return False
            missed = max(0, now_ns - self._next_ns) // self._period_ns
            self._next_ns += (missed + 1) * self._period_ns
            return True

    # -- what comes in
    def update_joint_state(self, state: JointState, now_ns: int) -> None:
        """Take a measurement by its own stamp: a bus that repeats its last answer is not fresh."""
        with self._lock:
            if self._joints.update(state.stamp_ns, now_ns):
                self._joint_state = state

    def update_image_frame(self, frame: SensorFrame, now_ns: int) -> None:
        """Take a frame. Raises KeyError for an unknown camera: it has no age limit."""
        with self._lock:
            if self._components[frame.sensor_id].update(frame.stamp_monotonic_ns, now_ns):
                self._frames[frame.sensor_id] = frame

    def lose(self, name: str, why: str, *, failed: bool = False) -> None:
        """Mark a component as stale from now on, whatever its last value's age; `failed`: as an
        error.
        """
        with self._lock:
            self._components[name].latch(why, failed=failed)

    def note(self, name: str, why: str) -> None:
        """Note a failed update. The last value stands until it is too old; then this is the
        reason.
        """
        with self._lock:
            component = self._components[name]
            component.note = why
            if component.stamp_ns is None:
                component.why = why

    # -- what comes out
    def snapshot(self, now_ns: int) -> WorldState:
        """Everything as of now. A component that has just latched is an event of the present span.

        Raises StateStale when no joint state has ever come.
        """
        with self._lock:
            if self._joint_state is None:
                raise StateStale(
                    f"the robot has not said where its joints are: {self._joints.why}",
                    hint="look at the robot's cables and power",
                )
            diagnostics: dict[str, Diagnostic] = {}
            for name, component in self._components.items():
                component.judge(now_ns)
                diagnostics[name] = component.diagnostic
                if component.diagnostic != "ok":
                    self._frames.pop(name, None)
                if component.stamp_ns is not None:
                    age_s = (now_ns - component.stamp_ns) / 1e9
                    meters.measure(
                        telemetry.METRIC_STALENESS, age_s, {telemetry.ATTR_COMPONENT: name}
                    )
            detected: list[DetectedObject] = []
            for slot in self._detections:
                found = slot.fresh(now_ns)
                diagnostics[slot.name] = "stale" if found is None else "ok"
                detected += found or ()
            self._tell(diagnostics)
            return WorldState(
                stamp_ns=now_ns,
                joint_state=self._joint_state,
                images=self._topics,
                image_frames=dict(self._frames),
                detected_objects=tuple(detected),
                diagnostics=diagnostics,
            )

    def _tell(self, diagnostics: dict[str, Diagnostic]) -> None:
        """Report the components that have changed since the snapshot before."""
        for name, said in diagnostics.items():
            before = self._told.get(name)
            if said == before:
                continue
            bad, was_bad = said in _LATCHED, before in _LATCHED
            labels = {telemetry.ATTR_COMPONENT: name}
            meters.shift(telemetry.METRIC_COMPONENTS_STALE, bad - was_bad, labels)
            if bad:
                tracing.event(_LATCHED[said], component=name, reason=self._reason(name))
        self._told = diagnostics

    def _reason(self, name: str) -> str:
        slots = {slot.name: slot for slot in self._detections}
        return slots[name].why if name in slots else self._components[name].why

    def why(self, name: str) -> str:
        """Return why a component is stale, or was last."""
        with self._lock:
            return self._components[name].why
