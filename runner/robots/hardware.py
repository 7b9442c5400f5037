"""A physical robot for the control loop: cameras, joints and motors.

Fails closed: while the joint state or a camera of the skill is stale, the skill is not asked and
nothing is sent, so the motors keep their last target. A stale input that lasts STALE_FAIL_S fails
the goal. Must not know sockets, clients of goals, the arbiter or any make of robot.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Mapping, Sequence

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.robot import Applied, Sensed, StaleInput
from vram_arbiter.runner.protocols import (
    GoalData,
    SafetyGate,
    SensorReader,
    SkillEnded,
    Stepped,
)
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.mobile import with_base
from vram_arbiter.runner.safety.estop_latch import EstopLatch
from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.runner.sensors.pictures import FramePicture
from vram_arbiter.runner.sensors.synced import FrameSet, SyncedCameras
from vram_arbiter.runner.sensors.world_state import JOINT_STATE, WorldStateAggregator
from vram_arbiter.schemas.config.robot import SyncConfig
from vram_arbiter.schemas.errors import (
    BadRequest,
    Cancelled,
    EstopRequested,
    FrameStale,
    StateStale,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, WorldState

log = logging.getLogger(__name__)

FIRST_DATA_S = 15.0  # a network camera negotiates; one that shows nothing by then does not work
FIRST_DATA_SLICE_S = 0.2  # a request to stop is noticed this late while waiting for a camera
FIRST_STATE_TRIES = 5  # a bus may lose its first answers
STALE_FAIL_S = 1.0

MakeGate = Callable[[Stepped], SafetyGate]
"""Gate for one goal: the robot's own, tightened by the skill's envelope."""


class HardwareRobot:
    """Implements `control.robot.Robot` on a HAL and camera readers.

    `readers` come with the greatest age of their frames (ms); `topics` names the cameras that are
    published as well, `detections` those that continuous detectors look at, `sync` those that are
    read together.
    """

    reset_due = False

    def __init__(
        self,
        hal: HalBase,
        readers: Sequence[tuple[SensorReader, float]],
        make_gate: MakeGate,
        *,
        clock: Clock,
        latch: EstopLatch,
        topics: Mapping[str, str] | None = None,
        detections: Sequence[DetectionSlot] = (),
        sync: SyncConfig | None = None,
        first_data_s: float = FIRST_DATA_S,
    ) -> None:
        self.hal = hal
        self.world: WorldState | None = None
        self.detections = tuple(detections)
        self.aggregator = WorldStateAggregator(
            {reader.sensor_id: age_ms for reader, age_ms in readers},
            topics=topics,
            detections=self.detections,
        )
        self._readers = {reader.sensor_id: reader for reader, _ in readers}
        self._synced: SyncedCameras | None = None
        if sync is not None:
            paired = {name: self._readers[name] for name in sync.sensor_ids}
            self._synced = SyncedCameras(paired, sync.max_spread_ms, clock)
        self._make_gate = make_gate
        self._clock = clock
        self._latch = latch
        self._first_data_s = first_data_s
        self._halted = False
        self._stale_since_s: float | None = None

    # -- life
    def open(self, stopping: threading.Event) -> None:
        """Start the cameras, then connect the robot: nothing gets power before it is seen.

        Returns when all of them have given data; a camera whose source another program has not
        started yet is waited for without a limit. Raises FrameStale and StateStale for what stays
        silent, Cancelled once `stopping` is set.
        """
        for sensor in (*self._readers, JOINT_STATE):  # so that `increase` sees the first one
            meters.count(telemetry.METRIC_STALE_READS, {telemetry.ATTR_SENSOR: sensor}, 0)
        for reader in self._readers.values():
            reader.start()
        deadline_ns = self._clock.now_ns() + round(self._first_data_s * 1e9)
        for reader in self._readers.values():
            self._await_first(reader, deadline_ns, stopping)
        if self._synced is not None:
            self._synced.start()
        self.hal.connect()
        with tracing.left_out(None):  # a span without a tick would be a trace of its own
            for _ in range(FIRST_STATE_TRIES):
                if self._read_joints():
                    break
        self.world = self._snapshot()

    def _snapshot(self) -> WorldState:
        """Return the world state, with the base's odometry where the joint state has it."""
        world = self.aggregator.snapshot(self._clock.now_ns())
        base = self.hal.description.base
        return world if base is None else with_base(world, base)

    def _await_first(
        self, reader: SensorReader, deadline_ns: int, stopping: threading.Event
    ) -> None:
        while True:
            if stopping.is_set():
                raise Cancelled("the runner was stopped while it waited for its cameras")
            slice_ns = min(deadline_ns, self._clock.now_ns() + round(FIRST_DATA_SLICE_S * 1e9))
            try:
                reader.read_synced(slice_ns)
                return
            except FrameStale as error:
                now_ns = self._clock.now_ns()
                if error.details.get("absent"):
                    deadline_ns = now_ns + round(self._first_data_s * 1e9)
                elif error.details.get("ended") or now_ns >= deadline_ns:
                    raise
            # a frame may travel longer than a slice and still be young enough
            with contextlib.suppress(FrameStale):
                reader.read_latest()
                return

    def close(self) -> None:
        """Stop the cameras and disconnect; the adapter decides how its motors end. Repeatable."""
        with contextlib.ExitStack() as stack:  # each is stopped, whatever another one raises
            if self._synced is not None:
                stack.callback(self._synced.stop)  # last: stopped cameras wake it
            for reader in self._readers.values():
                stack.callback(reader.stop)
            try:
                self.hal.disconnect()
            except VramError as error:
                log.error("the robot did not disconnect cleanly: %s", error)
            else:
                log.info("%s is disconnected", self.hal.description.name)

    # -- safety
    def admit(self, skill: Stepped) -> SafetyGate:
        gate = self._make_gate(skill)
        self._stale_since_s = None
        return gate

    def stop(self) -> None:
        """Stop the motors; a bus that lost the command gets it again with every call."""
        if (error := self._latch.error) is None or self._halted:
            return
        before = error.message
        try:
            self.hal.estop(str(error.details.get("reason", "")))
        except EstopRequested as told:
            self._latch.amend(told)  # says what became of the motors, too
            error = told
        self._halted = bool(error.details.get("told", True))
        if error.message != before or self._halted:
            log.critical("%s", error)
            tracing.event(telemetry.EVENT_ESTOP, reason=error.message)

    def _stopped_by_hardware(self, error: EstopRequested) -> None:
        self._latch.report(error)
        self._halted = bool(error.details.get("told", True))
        self.stop()

    # -- one tick
    def reset(self) -> Applied:
        """Do nothing: hardware has no scene to prepare."""
        return Applied()

    def sense(self, skill: Stepped | None, *, followed: bool) -> Sensed:
        """Read cameras (on the world state's cadence) and joints; check the skill's inputs."""
        started_s = self._clock.now_s()
        with tracing.span(telemetry.SPAN_SENSORS):
            self._read_cameras()
            self._read_joints()
        sensed_s = self._clock.now_s()
        with tracing.span(telemetry.SPAN_WORLD):
            self.world = self._snapshot()
        return Sensed(
            sensors_ms=(sensed_s - started_s) * 1e3,
            world_state_ms=(self._clock.now_s() - sensed_s) * 1e3,
            stale=None if skill is None else self._stale_input(skill, self.world),
        )

    def _read_cameras(self) -> None:
        if not self.aggregator.due(self._clock.now_ns()):
            return
        paired = () if self._synced is None else self._synced.names
        together: FrameSet | FrameStale = {}
        if self._synced is not None:
            try:
                together = self._synced.latest()
            except FrameStale as error:
                together = error
        for name, reader in self._readers.items():
            try:
                if name not in paired:
                    frame = reader.read_latest()
                elif isinstance(together, FrameStale):
                    raise together
                else:
                    frame = together[name]
            except FrameStale as error:
                self._gave_nothing(name, error)
                gone = bool(error.details.get("ended") or error.details.get("absent"))
                self.aggregator.lose(name, error.message, failed=gone)
            else:
                self._took(name, frame.stamp_monotonic_ns)
                self.aggregator.update_image_frame(frame, self._clock.now_ns())

    def _read_joints(self) -> bool:
        """Update the joint state. Returns whether the robot answered."""
        began_s = self._clock.now_s()
        labels: dict[str, str] = {}
        try:
            with tracing.span(telemetry.SPAN_READ):
                state = self.hal.read_state()
        except EstopRequested as error:
            labels[telemetry.ATTR_ERROR_TYPE] = error.code
            self._stopped_by_hardware(error)
            return False
        except VramError as error:  # one lost answer is harmless: the age of the last one decides
            labels[telemetry.ATTR_ERROR_TYPE] = error.code
            self._gave_nothing(JOINT_STATE, error)
            self.aggregator.note(JOINT_STATE, error.message)
            return False
        finally:
            meters.measure(telemetry.METRIC_HAL_READ, self._clock.now_s() - began_s, labels)
        self._took(JOINT_STATE, state.stamp_ns)
        self.aggregator.update_joint_state(state, self._clock.now_ns())
        return True

    def _gave_nothing(self, sensor: str, error: VramError) -> None:
        meters.count(telemetry.METRIC_STALE_READS, {telemetry.ATTR_SENSOR: sensor})
        tracing.event(telemetry.EVENT_SENSOR_STALE, sensor=sensor, reason=error.message)

    def _took(self, sensor: str, stamp_ns: int) -> None:
        age_s = (self._clock.now_ns() - stamp_ns) / 1e9
        meters.measure(telemetry.METRIC_SENSOR_AGE, age_s, {telemetry.ATTR_SENSOR: sensor})

    def _stale_input(self, skill: Stepped, world: WorldState) -> StaleInput | None:
        needed = (JOINT_STATE, *skill.cameras)
        stale = [name for name in needed if world.diagnostics.get(name) != "ok"]
        if not stale:
            self._stale_since_s = None
            return None
        name, now_s = stale[0], self._clock.now_s()
        what = "the joint state" if name == JOINT_STATE else f"camera {name}"
        problem = f"{what} is stale: {self._why(name)}"
        first = self._stale_since_s is None
        if self._stale_since_s is None:
            self._stale_since_s = now_s
        if now_s - self._stale_since_s < STALE_FAIL_S:
            return StaleInput(problem, first)
        kind = StateStale if name == JOINT_STATE else FrameStale
        error = kind(problem, hint="the robot does not move on outdated inputs")
        return StaleInput(problem, first, error)

    def _why(self, name: str) -> str:
        known = name == JOINT_STATE or name in self._readers
        return self.aggregator.why(name) if known else "this robot has no such camera"

    def apply(self, action: Action | None, *, skill_active: bool) -> Applied:
        if action is None:
            return Applied()
        began_s = self._clock.now_s()
        labels: dict[str, str] = {}
        try:
            self.hal.send_action(action)
        except EstopRequested as error:
            labels[telemetry.ATTR_ERROR_TYPE] = error.code
            self._stopped_by_hardware(error)
        except VramError as error:  # the motors keep their last target
            labels[telemetry.ATTR_ERROR_TYPE] = error.code
            problem = f"{error.code}: {error.message}"
            return Applied(ended=SkillEnded({}, error), problem=problem)
        else:
            return Applied(action_applied=True)
        finally:
            meters.measure(telemetry.METRIC_HAL_SEND, self._clock.now_s() - began_s, labels)
        return Applied()

    # -- for recordings and reports
    def targets(self) -> Mapping[str, float]:
        return self.hal.sent()

    def facts(self) -> GoalData:
        if not self.detections:
            return {}
        return {"detectors": {slot.sensor_id: slot.facts() for slot in self.detections}}

    # -- cameras
    def camera_names(self) -> tuple[str, ...]:
        return tuple(self._readers)

    def snapshot(self, camera: str, max_age_s: float) -> FramePicture:
        """Return the newest frame. Raises FrameStale if it is too old, BadRequest if unknown."""
        if camera not in self._readers:
            raise BadRequest(
                f"unknown camera {camera!r}", hint=f"choose from {', '.join(self._readers)}"
            )
        return FramePicture(self._readers[camera].read_latest(max_age_s * 1e3))


HardwareRunner = ControlLoop[HardwareRobot]
