"""An arm on a mobile base (`runner.sim.env.SimEnv`) as the world of a simulated robot.

Joint targets and base velocities in, joint state and odometry out. Every action passes the same
gate as a robot's, on simulated time. The task comes from outside: `prepare` sets the scene up after
a reset, `judge` checks it after each step. Without a judge an episode neither ends by itself nor
has a verdict.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vram_arbiter.runner.planar import planar_pose
from vram_arbiter.runner.protocols import RobotDescription, SafetyGate, Stepped
from vram_arbiter.runner.safety.gate import RobotGate
from vram_arbiter.runner.safety.limits import Kinematics, Limits
from vram_arbiter.runner.safety.violations import Violation
from vram_arbiter.runner.sim.config import CONTROL_HZ
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.skills.motion import action_of, bounded
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import EnvironmentFailed, InternalError, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import (
    Action,
    JointState,
    SensorFrame,
    WorldState,
)

REACH_SHARE = 0.98  # of the longest step: rounding must not reach the gate


@dataclass(frozen=True, slots=True)
class SimulatedTime:
    """Gate that judges speeds by the simulated clock: the world waits for a slow policy."""

    gate: RobotGate
    arm: SimEnv

    def check(
        self, action: Action, world: WorldState
    ) -> tuple[Action | None, tuple[Violation, ...]]:
        stamp_ns = round(self.arm.time_s * 1e9)
        joints = world.joint_state.model_copy(update={"stamp_ns": stamp_ns})
        return self.gate.check(
            action, world.model_copy(update={"stamp_ns": stamp_ns, "joint_state": joints})
        )


class ArmEnvironment:
    """`robot` describes the arm; without `kinematics` the gate refuses skills that limit the tool.

    `cameras` are for skills, the default one first. After a step `success` is the judge's verdict
    (None: nothing judges), and the episode is `over` once it was positive for `steady` steps in a
    row; 0: never.
    """

    def __init__(
        self,
        arm: SimEnv,
        robot: RobotDescription,
        *,
        kinematics: Kinematics | None = None,
        cameras: tuple[str, ...] = (),
        judge: Callable[[], bool] | None = None,
    ) -> None:
        self.arm = arm
        self.robot = robot
        self.cameras = cameras
        self.seed = 0
        self.success: bool | None = None
        self.over = False
        self.about(prepare=None, judge=judge, steady=1)
        self._in_a_row = 0
        self._targets: dict[str, float] = {}  # last joint targets, rad
        self._random = random.Random(0)
        self._base_frame = robot.base.world_frame if robot.base is not None else "map"
        self._limits = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in robot.joints}
        self._gate = RobotGate(robot, rate_hz=CONTROL_HZ, kinematics=kinematics, sent=self.sent)

    def about(
        self,
        *,
        prepare: Callable[[int], None] | None,
        judge: Callable[[], bool] | None,
        steady: int,
    ) -> None:
        """Set the task of the episodes from the next reset on."""
        self._prepare, self._judge, self._steady = prepare, judge, steady

    def reset(self, seed: int) -> None:
        """Begin the episode that follows from `seed` alone. Raises EnvironmentFailed."""
        self.seed, self.success, self.over = seed, None, False
        try:
            self.arm.reset(seed)
            if self._prepare is not None:
                self._prepare(seed)
        except ValueError as error:  # objects that do not fit, a model that cannot be built
            raise EnvironmentFailed(
                f"the scene of seed {seed} cannot be set up: {error}"
            ) from error
        self._in_a_row = 0
        self._targets = self.arm.joint_state()
        self._random = random.Random(f"actions-{seed}")

    def observe(self, stamp_ns: int, frames: Mapping[str, SensorFrame] | None) -> WorldState:
        positions, velocities = self.arm.joint_state(), self.arm.joint_velocity()
        return WorldState(
            stamp_ns=stamp_ns,
            joint_state=JointState(
                name=tuple(positions),
                position=tuple(positions.values()),
                velocity=tuple(velocities[name] for name in positions),
                stamp_ns=stamp_ns,
            ),
            base_pose=planar_pose(*self.arm.base_pose(), self._base_frame),
            image_frames=dict(frames) if frames is not None else None,
        )

    def step(self, action: Action | None) -> None:
        """Step one period with an action that has passed the gate; None holds.

        Joints that an action leaves out keep their last target: a closed gripper stays closed.
        Raises EnvironmentFailed.
        """
        arm, base = _commands(action)
        if arm is not None:
            self._targets.update(arm)
        try:
            self.arm.step(dict(self._targets) if arm is not None else None, base)
        except (ValueError, KeyError) as error:
            raise EnvironmentFailed(f"the simulator refused a step: {error}") from error
        if self._judge is not None:
            self.success = self._judge()
            self._in_a_row = self._in_a_row + 1 if self.success else 0
            self.over = 0 < self._steady <= self._in_a_row

    def gate(self, skill: Stepped) -> SafetyGate:
        return SimulatedTime(self._gate.for_skill(skill.manifest, skill.cameras), self.arm)

    def limits_for(self, manifest: RSkillManifest) -> Limits:
        """Return what a skill may do here.

        Raises ConfigError for an envelope that cannot be enforced.
        """
        return self._gate.for_skill(manifest, ()).limits

    def action_of(self, raw: Any) -> Action:
        """Convert joint targets (rad): a map by joint name, or a row in the order of the joints."""
        names = tuple(self._limits)
        try:
            if isinstance(raw, Mapping):
                names, row = tuple(map(str, raw)), [float(value) for value in raw.values()]
            else:
                row = [float(value) for value in raw]
        except (TypeError, ValueError) as error:
            raise ModelError(f"expected a row of joint targets, got {raw!r}: {error}") from error
        if not row or len(row) != len(names) or not all(map(math.isfinite, row)):
            raise ModelError(f"an action is {len(names)} finite joint targets in rad, not {row}")
        return action_of(dict(zip(names, row, strict=True)), 0)

    def sample(self) -> Action:
        """Return random targets near the last ones, within one step of the gate."""
        targets = {}
        for name, (low, high) in self._limits.items():
            reach = REACH_SHARE * self._gate.limits.speeds_rad_s[name] / CONTROL_HZ
            there = self._targets[name] + self._random.uniform(-reach, reach)
            targets[name] = min(max(there, low), high)
        return action_of(targets, 0)

    def sent(self) -> Mapping[str, float]:
        """Return the targets that the servos really got."""
        return self._targets

    def toward(self, row: Sequence[float]) -> list[float]:
        """Return joint targets, or as much of the way there as the gate allows in one step.

        For policies whose targets lead the arm.
        """
        most = self._gate.limits.speeds_rad_s
        return [
            bounded(self._targets[name], target, REACH_SHARE * most[name] / CONTROL_HZ)
            for name, target in zip(self._limits, row, strict=True)
        ]


def _commands(
    action: Action | None,
) -> tuple[dict[str, float] | None, tuple[float, float, float] | None]:
    """Arm target by joint name and base velocity of an action; (None, None) holds."""
    if action is None:
        return None, None
    base = None
    if action.body_twist is not None:
        twist = action.body_twist[0]
        base = twist[0], twist[1], twist[5]
    if action.control_mode is ControlMode.BODY_TWIST:
        return None, base
    names = action.joint_names
    if names is None:
        raise InternalError("a joint action reached the simulator without joint names")
    return dict(zip(names, action.rows[0], strict=True)), base
