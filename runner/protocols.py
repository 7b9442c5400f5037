"""Interfaces between the parts of the runner: loop, skills, robot or simulator, safety gate.

Shapes only. Two threads meet in a skill: its `async` methods run on the event loop, `step` and
`wants_frames` on the control thread, which must never wait for the network beyond the bound that a
skill states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

from vram_arbiter.runner.safety.violations import Violation
from vram_arbiter.schemas.errors import EstopRequested, TransientError, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import GripperConvention
from vram_arbiter.schemas.world import (
    Action,
    CameraModel,
    RunResult,
    SensorFrame,
    TickResult,
    WorldState,
)

type GoalData = dict[str, Any]
"""Fields of a goal's or a run's result: a JSON object."""
type GoalParams = Mapping[str, Any]
"""Parameters of a goal, as its skill defines them: a JSON object."""


class DeadlineMissed(TransientError):
    """A tick took longer than its slot under the policy RAISE. Stays inside the runner's
    process.
    """

    code: ClassVar[str] = "deadline_missed"


class DeadlinePolicy(StrEnum):
    """Fate of an action that was ready too late: applied and counted, withheld, or the end of the
    run.
    """

    WARN = "warn"
    DROP = "drop"
    RAISE = "raise"


# -- skills
@dataclass(frozen=True, slots=True)
class SkillKey:
    """Key of residency: a skill of the same key is reused and reset, another key replaces it."""

    rskill_id: str
    revision: str = ""

    def __str__(self) -> str:
        return f"{self.rskill_id}@{self.revision}" if self.revision else self.rskill_id


@dataclass(frozen=True, slots=True)
class Goal:
    """One accepted goal.

    `deadline_s` is resolved (seconds from acceptance); `max_ticks` counts ticks with the robot.
    `from_here`: the operator gives it back, and it goes on where the robot is.
    """

    goal_id: str
    rskill_id: str
    revision: str = ""
    prompt: str = ""
    params: GoalParams = field(default_factory=dict)
    deadline_s: float = 0.0
    max_ticks: int | None = None
    traceparent: str | None = None
    from_here: bool = False


@dataclass(frozen=True, slots=True)
class ChunkStart:
    """How a chunk came: seconds from its request to its answer, and whether it was there when it
    was due (None: the goal's first, which is waited for in any case).
    """

    latency_s: float
    in_time: bool | None
    over_budget: bool = False


@dataclass(frozen=True, slots=True)
class Act:
    """Apply this one-step action now.

    `chunk` comes with the first action of a chunk. `problem` says how the action falls short of
    what was asked for. `operator`: a person moves the robot.
    """

    action: Action
    chunk_index: int | None = None
    chunk: ChunkStart | None = None
    problem: str = ""
    operator: bool = False


@dataclass(frozen=True, slots=True)
class Hold:
    """Nothing to apply this tick (an answer is under way): keep the pose.

    `withheld`: there was an action, and it cannot be carried out; `reason` is a violation.
    `standing`: an action was due in the middle of a motion, and there was none. `operator`: a
    person has the robot.
    """

    reason: str
    withheld: bool = False
    standing: bool = False
    operator: bool = False


@dataclass(frozen=True, slots=True)
class Done:
    """The skill ran to its end; `data` goes into the goal's result."""

    data: GoalData = field(default_factory=dict)
    operator: ClassVar[bool] = False


StepOutcome = Act | Hold | Done


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a goal is: 0..1, a word for its state, and a detail for people."""

    fraction: float
    state: str
    tick_idx: int = 0
    detail: str = ""


class Stepped(Protocol):
    """Skill as the control loop sees it. Without a manifest the robot's own limits apply."""

    @property
    def manifest(self) -> RSkillManifest | None: ...

    @property
    def key(self) -> SkillKey: ...

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that `step` needs when `wants_frames` is true."""
        ...

    def wants_frames(self) -> bool: ...

    def step(self, world: WorldState) -> StepOutcome: ...

    @property
    def fraction(self) -> float: ...


@runtime_checkable
class Paced(Protocol):
    """A skill with a clock of its own, which stands while its actions are withheld."""

    def withheld(self) -> None:
        """The last step's action was not applied. Control thread."""
        ...


class Skill(Stepped, Protocol):
    """A skill that a goal can run. Life: `start` → `step`… → `finish` per goal, then `release`.

    `start` resets it whatever happened before. `step` raises a VramError to fail the goal; the
    robot then holds.
    """

    phase: str
    """How far a start is that has not ended, in words; empty: not known."""

    @property
    def holds_gpu(self) -> bool:
        """Whether it takes the resident slot. GPU-free skills neither take it nor displace a
        skill.
        """
        ...

    async def start(self, goal: Goal) -> None: ...

    async def finish(self) -> None: ...

    async def release(self) -> None: ...


@dataclass(frozen=True, slots=True)
class SkillEnded:
    """How a skill left the control thread: by itself (`error` None) or by a typed error."""

    data: GoalData
    error: VramError | None = None


# -- recording a goal
@dataclass(frozen=True, slots=True)
class GoalTick:
    """One finished tick in which a goal's skill was asked. Immutable: any thread may read it.

    `targets` are the joint targets in force, rad by joint: a joint without a new target keeps its
    last; a joint without any is missing. `base_velocity` is the base's command (m/s, m/s, rad/s),
    None without a base. `intervention`: an operator had the robot.
    """

    goal: Goal
    world: WorldState
    result: TickResult
    targets: Mapping[str, float]
    base_velocity: tuple[float, float, float] | None = None
    intervention: bool = False


class TickSink(Protocol):
    """Receives every tick of a goal and its end, on the control thread: it must never wait."""

    def tick(self, tick: GoalTick) -> None: ...

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        """After the goal's last tick. None: the arm was taken back (canceled, or the deadline)."""
        ...

    def facts(self) -> GoalData:
        """Return the counts so far, for the run's result. Any thread."""
        ...


# -- robot, simulator, safety
class SafetyGate(Protocol):
    """Decides on every single action before it reaches a motor."""

    def check(
        self, action: Action, world: WorldState
    ) -> tuple[Action | None, tuple[Violation, ...]]:
        """Return the action to apply (possibly clamped within the tolerance) or None, and the
        violations; with None the first one is the reason.
        """
        ...


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint of a robot: its range (rad) and the greatest speed that its motor makes (rad/s).

    A gripper is closed at its lower end and open at its upper one. All numbers of a `linear` joint
    are m and m/s.
    """

    name: str
    lower_rad: float
    upper_rad: float
    max_speed_rad_s: float
    gripper: bool = False
    linear: bool = False


@dataclass(frozen=True, slots=True)
class MobileBase:
    """A platform that drives on a plane: its greatest speed (m/s) and turn (rad/s).

    Its pose is that of `frame` in `world_frame`; `joints` are what manifests call its x, y and yaw.
    The arm's model begins at `mount_m` in `frame`.
    """

    max_speed_m_s: float
    max_turn_rad_s: float
    frame: str = "base_link"
    world_frame: str = "map"
    joints: tuple[str, str, str] = ("base_x", "base_y", "base_yaw")
    mount_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tells_twist: bool = False  # whether the world state has its velocity


@dataclass(frozen=True, slots=True)
class EndEffector:
    """What a manifest calls an end effector: its frame in the robot's model, and its gripper."""

    name: str
    frame: str
    gripper: str | None = None


@dataclass(frozen=True, slots=True)
class PolicyUnits:
    """Units of skills made for this robot whose manifests do not state them.

    `cartesian_delta_scale`: m and rad per unit of a cartesian delta.
    """

    cartesian_delta_scale: tuple[float, ...] | None = None
    gripper_convention: GripperConvention | None = None


@dataclass(frozen=True, slots=True)
class RobotDescription:
    """A robot as skills and the safety gate see it. Joints in the robot's own order."""

    name: str
    joints: tuple[Joint, ...]
    rest_pose_rad: Mapping[str, float]
    simulated: bool = False
    tells_efforts: bool = (
        False  # whether its joint state has efforts: limits of torque and force are kept by them
    )
    base: MobileBase | None = None
    model: str = ""  # an MJCF file, or the built-in "so101"; without it there are no frames
    ends: tuple[EndEffector, ...] = ()
    frames: Mapping[str, str] = field(default_factory=dict)  # other names of the model's frames
    units: PolicyUnits = PolicyUnits()

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)


class Picture(Protocol):
    """One picture of a camera; its colors may be decoded only when they are read."""

    @property
    def rgb(self) -> Any:
        """Colors: uint8, height × width × 3. Raises FrameStale, ModelError."""
        ...

    @property
    def stamp_ns(self) -> int: ...

    @property
    def model(self) -> CameraModel | None:
        """Where the camera stood when the picture was taken, if that is known."""
        ...


# -- the runner
class Work(Protocol):
    """Takes callables for the control thread, from any thread."""

    def post[T](self, work: Callable[[], T]) -> Future[T]: ...

    def close(self) -> None: ...


class InferenceRunner(Protocol):
    """A loop that turns observations into actions at a rate, on hardware or in a simulator.

    `control.loop.ControlLoop` implements it. `post` to its mailbox whatever is not said to be for
    any thread; `caption` and what it tells are replaced whole, so that any thread may read them.
    """

    caption: tuple[str, ...]
    tick_idx: int
    deadline_misses: int
    save_dir: str | None

    @property
    def mailbox(self) -> Work: ...

    @property
    def rate_hz(self) -> float: ...

    def activate(self) -> None: ...

    def tick(self) -> TickResult: ...

    def run(self, max_ticks: int | None = None) -> RunResult: ...

    def deactivate(self) -> None: ...

    def request_stop(self) -> None:
        """End the run before its next tick. Any thread."""
        ...

    # -- goals
    @property
    def progress(self) -> Progress: ...

    def begin_skill(
        self, skill: Stepped, goal: Goal, on_end: Callable[[SkillEnded], None]
    ) -> None: ...

    def end_skill(self) -> GoalData: ...

    def follow(self, sink: TickSink, save_dir: str | None = None) -> None:
        """Report the ticks of all goals to `sink` as well, from before the first goal on."""
        ...

    # -- emergency stop
    @property
    def estop(self) -> EstopRequested | None: ...

    @property
    def estop_ns(self) -> int: ...

    def request_estop(self, reason: str) -> None:
        """Latch the stop. Any thread."""
        ...

    def obey_estop(self) -> EstopRequested | None: ...

    # -- what others look at
    @property
    def world(self) -> WorldState | None: ...

    def camera_names(self) -> tuple[str, ...]: ...

    def snapshot(self, camera: str, max_age_s: float) -> Picture: ...


# -- cameras
class SensorReader(Protocol):
    """One camera. `start` and `stop` on one thread, reads on any.

    `read_latest` returns the newest frame without waiting; it raises FrameStale when there is none,
    or it is older than `max_age_ms` (None: the configured age). `read_synced` waits for a frame
    taken after `after_ns` (None: the call), until the monotonic `deadline_ns`; then FrameStale. A
    source that
    ended or broke raises FrameStale with the reason: its last frame is never served again.
    """

    sensor_id: str

    def start(self) -> None: ...

    def read_latest(self, max_age_ms: float | None = None) -> SensorFrame: ...

    def read_synced(self, deadline_ns: int, after_ns: int | None = None) -> SensorFrame: ...

    def stop(self) -> None: ...
