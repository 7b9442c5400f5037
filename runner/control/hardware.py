"""`HardwareRunner`: the control loop on a robot. Cameras and joints → world state → skill → safety gate → motors, once per tick.

Everything here runs on the control thread. Fails closed: while the joint state or a camera of the skill is stale the skill is not asked
and nothing is sent, so the motors keep their last target; if that lasts STALE_FAIL_S the goal fails. A skill that has no answer yet holds
the same way. The emergency stop acts before anything else is sent. It knows no sockets, goals' clients or arbiter, and no make of robot.

One tick:
 1. emergency stop  2. posted work  3. cameras (on the world state's cadence) and joints  4. world state  5. stale? then withhold
 6. skill  7. safety gate  8. deadline policy (base)  9. motors
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.loop import Applied, Decision
from vram_arbiter.runner.control.skill_runner import Active, SkillRunner
from vram_arbiter.runner.protocols import (
    DeadlinePolicy,
    Goal,
    Hal,
    SafetyGate,
    SensorReader,
    Skill,
    SkillEnded,
    Stepped,
)
from vram_arbiter.runner.sensors.pictures import FramePicture
from vram_arbiter.runner.sensors.world_state import JOINT_STATE, WorldStateAggregator
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import (
    BadRequest,
    Cancelled,
    EstopRequested,
    FrameStale,
    InternalError,
    StateStale,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action

log = logging.getLogger(__name__)

FIRST_DATA_S = 15.0  # a network camera negotiates; one that shows nothing by then does not work
FIRST_DATA_SLICE_S = 0.2  # how late a request to stop is noticed while waiting for it
FIRST_STATE_TRIES = 5  # a bus may lose its first answers
STALE_FAIL_S = 1.0

MakeGate = Callable[[Stepped], SafetyGate]
"""The gate for one goal: the robot's own, tightened by the skill's envelope."""


class HardwareRunner(SkillRunner):
    """`readers` with the greatest age of their frames (ms); `topics` names those that are published as well.

    `on_estop` hears of an emergency stop at once, on the thread that asks for it: the gate, which then passes nothing any more.
    """

    def __init__(
        self,
        hal: Hal,
        readers: Sequence[tuple[SensorReader, float]],
        make_gate: MakeGate,
        *,
        rate_hz: float = 30.0,
        deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
        clock: Clock | None = None,
        topics: Mapping[str, str] | None = None,
        on_estop: Callable[[str], None] | None = None,
        first_data_s: float = FIRST_DATA_S,
    ) -> None:
        super().__init__(rate_hz=rate_hz, deadline_policy=deadline_policy, clock=clock)
        self.hal = hal
        self._readers = {reader.sensor_id: reader for reader, _ in readers}
        self._make_gate = make_gate
        self._on_estop = on_estop
        self._first_data_s = first_data_s
        self.aggregator = WorldStateAggregator(
            {reader.sensor_id: age_ms for reader, age_ms in readers}, topics=topics
        )
        self._halted = False
        self._stale_since_s: float | None = None
        self._sent: dict[str, float] = {}  # the newest target of each joint, rad

    # -- life --------------------------------------------------------------------------------------------------------
    def activate(self) -> None:
        """Cameras first, then the robot: nothing gets power before it is seen. Returns when all of them have given data.

        Raises FrameStale and StateStale for what stays silent, Cancelled when the runner is to stop meanwhile.
        """
        for reader in self._readers.values():
            reader.start()
        deadline_ns = self.clock.now_ns() + round(self._first_data_s * 1e9)
        for reader in self._readers.values():
            self._await_first(reader, deadline_ns)
        self.hal.connect()
        for _ in range(FIRST_STATE_TRIES):
            if self._read_joints():
                break
        self.world = self.aggregator.snapshot(self.clock.now_ns())

    def _await_first(self, reader: SensorReader, deadline_ns: int) -> None:
        while True:
            if self._stopping:
                raise Cancelled("the runner is to stop while it waits for its cameras")
            slice_ns = min(deadline_ns, self.clock.now_ns() + round(FIRST_DATA_SLICE_S * 1e9))
            try:
                reader.read_synced(slice_ns)
                return
            except FrameStale as error:
                if error.details.get("ended") or self.clock.now_ns() >= deadline_ns:
                    raise
            with suppress(
                FrameStale
            ):  # pictures may take longer on their way than a slice, and still be young enough
                reader.read_latest()
                return

    def deactivate(self) -> None:
        """The motors keep their last target until the adapter disconnects as its hardware wants it. Repeatable."""
        self._end(SkillEnded({}, self.estop or InternalError("the runner is stopping")))
        with contextlib.ExitStack() as stack:  # each is stopped, whatever another one raises
            for reader in self._readers.values():
                stack.callback(reader.stop)
            try:
                self.hal.disconnect()
            except VramError as error:
                log.error("the robot did not disconnect cleanly: %s", error)
            else:
                log.info("%s is disconnected", self.hal.description.name)

    # -- the skill and the emergency stop ------------------------------------------------------------------------------
    def begin_skill(self, skill: Skill, goal: Goal, on_end: Callable[[SkillEnded], None]) -> None:
        super().begin_skill(skill, goal, on_end)
        self._stale_since_s = None

    def request_estop(self, reason: str) -> None:
        super().request_estop(reason)
        if self._on_estop is not None:
            self._on_estop(reason)

    def obey_estop(self) -> EstopRequested | None:
        if self.estop is not None and not self._halted:
            before = self.estop.message
            try:
                self.hal.estop(str(self.estop.details.get("reason", "")))
            except EstopRequested as error:
                self.estop = error  # says what became of the motors, too
            # a bus that lost this one is told again with every tick: the motors still pull
            self._halted = bool(self.estop.details.get("told", True))
            if self.estop.message != before or self._halted:
                log.critical("%s", self.estop)
                tracing.event(telemetry.EVENT_ESTOP, reason=self.estop.message)
        return super().obey_estop()

    # -- pictures ------------------------------------------------------------------------------------------------------
    def camera_names(self) -> tuple[str, ...]:
        """All cameras, the default one first."""
        return tuple(self._readers)

    def snapshot(self, camera: str, max_age_s: float) -> FramePicture:
        """The newest frame. Raises FrameStale when it is older than that, BadRequest for an unknown camera."""
        if camera not in self._readers:
            raise BadRequest(
                f"there is no camera {camera!r}", hint=f"choose from {', '.join(self._readers)}"
            )
        return FramePicture(self._readers[camera].read_latest(max_age_s * 1e3))

    # -- one tick ------------------------------------------------------------------------------------------------------
    def _decide(self, tick_idx: int) -> Decision:
        self.obey_estop()  # 1
        self._take_posted_after_stop()  # 2
        started_s = self.clock.now_s()
        with tracing.span(telemetry.SPAN_SENSORS):  # 3
            self._read_cameras()
            self._read_joints()
        sensed_s = self.clock.now_s()
        with tracing.span(telemetry.SPAN_WORLD):
            self.world = world = self.aggregator.snapshot(self.clock.now_ns())  # 4
        decision = Decision(
            sensors_ms=(sensed_s - started_s) * 1e3,
            world_state_ms=(self.clock.now_s() - sensed_s) * 1e3,
        )
        if (active := self._active) is None:
            return decision
        needed = (JOINT_STATE, *active.skill.cameras)
        if stale := [name for name in needed if world.diagnostics.get(name) != "ok"]:  # 5
            self._withhold_stale(active, stale[0], decision)
        else:
            self._stale_since_s = None
            self._ask_skill(active, world, decision)  # 6, 7
        return decision

    def _read_cameras(self) -> None:
        now_ns = self.clock.now_ns()
        if not self.aggregator.due(now_ns):
            return
        for name, reader in self._readers.items():
            try:
                frame = reader.read_latest()
            except FrameStale as error:
                self.aggregator.lose(name, error.message)
            else:
                self.aggregator.update_image_frame(frame, self.clock.now_ns())

    def _read_joints(self) -> bool:
        """Whether the robot answered."""
        try:
            state = self.hal.read_state()
        except EstopRequested as error:
            self._latched_by_hardware(error)
            return False
        except (
            VramError
        ) as error:  # one answer that a bus loses stops nobody: the age of the last one decides
            self.aggregator.note(JOINT_STATE, error.message)
            return False
        self.aggregator.update_joint_state(state, self.clock.now_ns())
        return True

    def _latched_by_hardware(self, error: EstopRequested) -> None:
        if self.estop is None and self._on_estop is not None:
            self._on_estop(error.message)
        self._latch(error)
        self._halted = bool(error.details.get("told", True))
        self.obey_estop()

    def _withhold_stale(self, active: Active, name: str, decision: Decision) -> None:
        now_s = self.clock.now_s()
        what = "the joint state" if name == JOINT_STATE else f"camera {name}"
        problem = f"{what} is stale: {self._why(name)}"
        decision.safety_violations = (problem,)
        if self._stale_since_s is None:
            self._stale_since_s = now_s
            self.violations.append(problem)
            tracing.event(telemetry.EVENT_STALE, component=name)
        self._withheld(active, problem)
        if now_s - self._stale_since_s < STALE_FAIL_S:
            return
        kind = StateStale if name == JOINT_STATE else FrameStale
        self._end(
            SkillEnded({}, kind(problem, hint="the robot does not move on what is no longer so"))
        )

    def _why(self, name: str) -> str:
        known = name == JOINT_STATE or name in self._readers
        return self.aggregator.why(name) if known else "this robot has no such camera"

    def _remember(self, action: Action) -> None:
        if action.control_mode is ControlMode.JOINT_POSITION:
            names = action.joint_names or self.hal.description.joint_names
            self._sent.update(zip(names, action.rows[0], strict=True))

    def _targets_now(self) -> Mapping[str, float]:
        return self._sent

    def _gate_of(self, skill: Stepped) -> SafetyGate:
        return self._make_gate(skill)

    def _apply(self, decision: Decision) -> Applied:
        if self.obey_estop() is not None or decision.action is None:
            return Applied(action_applied=False)
        try:
            self.hal.send_action(decision.action)  # 9
            self._remember(decision.action)
        except EstopRequested as error:
            self._latched_by_hardware(error)
        except VramError as error:  # the motors keep their last target
            self.violations.append(f"{error.code}: {error.message}")
            self._end(SkillEnded({}, error))
        else:
            return Applied(action_applied=True)
        return Applied(action_applied=False)
