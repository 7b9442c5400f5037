"""Real small parts of a robot for tests: a camera that shows what the test feeds it, a twin whose
bus can fail, a skill that nods.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from typing import Any

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.protocols import (
    Act,
    DeadlinePolicy,
    Done,
    Goal,
    Joint,
    RobotDescription,
    SensorReader,
    StepOutcome,
)
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.hardware import HardwareRobot, HardwareRunner, MakeGate
from vram_arbiter.runner.robots.kinematic import KinematicTwin
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.safety.estop_latch import EstopLatch
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.runner.sensors import Feed, SlotReader
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import RobotFault
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import Action, FrameEncoding, JointState, SensorFrame, WorldState


def robot_of(*joints: str) -> RobotDescription:
    """A robot of which only the names of its joints are known."""
    free = tuple(Joint(name, -math.inf, math.inf, math.inf) for name in joints)
    return RobotDescription("this world", free, {})


def hardware_runner(
    hal: HalBase,
    readers: Sequence[tuple[SensorReader, float]],
    make_gate: MakeGate,
    *,
    clock: Clock,
    rate_hz: float = 30.0,
    deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
    on_estop: Callable[[str], None] | None = None,
    **of_robot: Any,
) -> HardwareRunner:
    """A control loop on hardware, composed as `vram-runner deploy` does."""
    latch = EstopLatch(on_estop)
    robot = HardwareRobot(hal, readers, make_gate, clock=clock, latch=latch, **of_robot)
    return ControlLoop(
        robot, rate_hz=rate_hz, deadline_policy=deadline_policy, clock=clock, latch=latch
    )


def moving(**targets: float) -> Action:
    """An action of joint targets, rad."""
    return Action(
        control_mode=ControlMode.JOINT_POSITION,
        joint_targets=(tuple(targets.values()),),
        joint_names=tuple(targets),
    )


def frame_at(stamp_ns: int, camera: str = "front", **changes: Any) -> SensorFrame:
    """A gray picture of one pixel."""
    given: dict[str, Any] = {
        "sensor_id": camera,
        "stamp_monotonic_ns": stamp_ns,
        "stamp_wall_ns": stamp_ns,
        "encoding": FrameEncoding.MONO8,
        "width": 1,
        "height": 1,
        "channels": 1,
        "data": b"x",
    }
    return SensorFrame(**given | changes)


class FedCamera(SlotReader):
    """Its source is the test:

    `show` is the camera's thread. With `always` it shows a new picture whenever it is looked at.
    """

    def __init__(
        self, sensor_id: str, clock: Clock, max_age_ms: float = 100.0, *, always: bool = True
    ) -> None:
        super().__init__(sensor_id, max_age_ms, clock)
        self.always = always
        self.feed: Feed | None = None

    def _run_begins(self, feed: Feed) -> None:
        self.feed = feed
        self.show()

    def _run_ends(self) -> None:
        self.feed = None

    def show(self) -> None:
        if (feed := self.feed) is None:  # stopped, by another thread than the one that looks
            return
        self.deliver(
            feed,
            SensorFrame(
                sensor_id=self.sensor_id,
                stamp_monotonic_ns=self.clock.now_ns(),
                stamp_wall_ns=self.clock.wall_ns(),
                encoding=FrameEncoding.BGR8,
                width=2,
                height=1,
                data=bytes([255, 0, 0, 0, 0, 255]),  # blue, then red
            ),
        )

    def read_latest(self, max_age_ms: float | None = None) -> SensorFrame:
        if self.always:
            self.show()
        return super().read_latest(max_age_ms)

    def read_synced(self, deadline_ns: int, after_ns: int | None = None) -> SensorFrame:
        if self.always:
            return self.read_latest()
        return super().read_synced(deadline_ns, after_ns)


class Twin(KinematicTwin):
    """The kinematic SO-101 on a bus that can be cut, with a list of what was sent."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(so101(simulated=True), clock=clock)
        self.silent = False
        self.deaf = False
        self.answers_lost = 0
        self.halts_lost = 0
        self.halt_breaks: Exception | None = None
        self.applied: list[Action] = []
        self.story: list[str] = []

    def _open(self) -> None:
        super()._open()
        self.story.append("connect")

    def _close(self) -> None:
        super()._close()
        self.story.append("disconnect")

    def _halt(self) -> str:
        self.halts_lost -= 1
        if self.halts_lost >= 0:
            raise RobotFault("motor 2 does not answer", hint="look at the cable")
        if self.halt_breaks is not None:
            raise self.halt_breaks
        self.story.append("halt")
        return super()._halt()

    def _read(self) -> JointState:
        self.answers_lost -= 1
        if self.silent or self.answers_lost >= 0:
            raise RobotFault("no answer from motor 3", hint="look at the cable")
        return super()._read()

    def send_action(self, action: Action) -> None:
        if self.deaf:
            raise RobotFault("motor 2 takes nothing", hint="look at the cable")
        super().send_action(action)
        self.applied.append(action)


def twin_runner(
    twin: Twin,
    *cameras: SlotReader,
    clock: Clock,
    max_age_ms: float = 100.0,
    make_gate: MakeGate | None = None,
    **options: Any,
) -> HardwareRunner:
    """Return a runner of the twin, by default with a gate that knows the ranges of its joints;
    `options` are the runner's."""
    ranges = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in twin.description.joints}
    readers = [(camera, max_age_ms) for camera in cameras]
    gate = make_gate or (lambda _: JointRanges(ranges))
    return hardware_runner(twin, readers, gate, clock=clock, **options)


class Nod(SkillBase):
    """Moves the wrist a little with every step (`all_joints`: tells the others to stay); ends after
    `steps`. `on_step` is asked first, with the world that the skill sees.
    """

    def __init__(
        self,
        manifest: RSkillManifest,
        *,
        cameras: tuple[str, ...] = (),
        steps: int | None = None,
        on_step: Callable[[WorldState], None] | None = None,
        all_joints: bool = False,
    ) -> None:
        super().__init__(manifest)
        self.all_joints = all_joints
        self.cameras = cameras
        self.steps = steps
        self.on_step = on_step
        self.taken = 0
        self.begun = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None

    async def _start(self, goal: Goal) -> None:
        self.taken = 0
        self.begun.clear()
        self._loop = asyncio.get_running_loop()

    def _step(self, world: WorldState) -> StepOutcome:
        if self.on_step is not None:
            self.on_step(world)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self.begun.set)
        self.taken += 1
        if self.steps is not None:
            self.fraction = min(1.0, self.taken / self.steps)
            if self.taken > self.steps:
                return Done({"nods": self.steps})
        told = dict(zip(world.joint_state.name, world.joint_state.position, strict=True))
        told["wrist_flex"] += 0.01 if self.taken % 2 else -0.01
        names = tuple(told) if self.all_joints else ("wrist_flex",)
        return Act(
            Action(
                control_mode=ControlMode.JOINT_POSITION,
                joint_targets=(tuple(told[name] for name in names),),
                joint_names=names,
                stamp_ns=world.stamp_ns,
            )
        )
