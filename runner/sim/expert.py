"""The scripted grab that demonstrations are recorded from: approach, descend, close, lift.

It reads the ground truth, so no program of the robot may run it; datasets, tests and evaluation do.
"""

from __future__ import annotations

import enum
import math
from typing import Any

from runner.sim.config import ARM_JOINTS, CONTROL_DT_S, REST_POSE
from runner.sim.env import SimEnv
from runner.sim.kinematics import ArmKinematics

OPEN_RAD = 0.75
CLOSED_RAD = -0.10
PAN_AXIS_X_M = 0.119  # the shoulder's pan axis in the base frame
HOVER_M = 0.060  # of the grasp point above the object's centre
# The open fixed finger is nearer to the grasp point than a turned cube's corner: descend this much short of the object's
# centre, towards the arm, and make up for it while closing.
SHY_M = 0.009
LIFT_STRAIGHT_M = 0.04
CARRY_POSE = (0.0, -0.70, 0.45, 0.85, 0.0)
CARRY_SPEED_RAD_S = 1.8
SPEED_M_S = 0.30
CLOSE_STEPS = 9
GRIPPER_SPEED_RAD_S = 4.0


class Phase(enum.Enum):
    """Where the grab stands."""

    APPROACH = enum.auto()
    DESCEND = enum.auto()
    CLOSE = enum.auto()
    LIFT = enum.auto()
    DONE = enum.auto()


class GrabExpert:
    """Produces one joint target per control step until `done`; closed loop on the true object pose.

    `offset_m` shifts where the expert believes the object to be: a way to record misses.
    """

    def __init__(
        self, env: SimEnv, kinematics: ArmKinematics, name: str, offset_m: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._env, self._kinematics, self._name, self._offset = env, kinematics, name, offset_m
        self.phase = Phase.APPROACH
        self._in_phase = 0
        self._joints = list(env.joint_state().values())
        self._reference = env.gripper_position()
        self._object = self._believed()

    @property
    def done(self) -> bool:
        """Whether the lift is finished."""
        return self.phase is Phase.DONE

    @property
    def lifting(self) -> bool:
        """Whether the object should be between the fingers by now."""
        return self.phase in (Phase.LIFT, Phase.DONE)

    def _believed(self) -> tuple[float, float, float]:
        x, y, z = self._env.ground_truth().objects[self._name].position_base
        return x + self._offset[0], y + self._offset[1], z

    def act(self) -> list[float]:
        """The next joint target (six angles, rad)."""
        self._in_phase += 1
        if self.phase in (Phase.APPROACH, Phase.DESCEND):
            self._object = self._believed()
        ox, oy, oz = self._object
        gx, gy, gz = self._env.gripper_position()
        heading = math.atan2(oy, ox - PAN_AXIS_X_M)
        sx, sy = ox - SHY_M * math.cos(heading), oy - SHY_M * math.sin(heading)
        low = max(oz, self._floor_z())
        aside = math.hypot(gx - sx, gy - sy)
        if self.phase is Phase.APPROACH and aside < 0.010 and gz - oz < HOVER_M + 0.02:
            self._enter(Phase.DESCEND)
        if self.phase is Phase.DESCEND and gz - low < 0.004 and aside < 0.008:
            self._enter(Phase.CLOSE)
        if self.phase is Phase.CLOSE and self._in_phase > CLOSE_STEPS:
            self._enter(Phase.LIFT)
        match self.phase:
            case Phase.APPROACH:
                return self._towards((sx, sy, oz + HOVER_M), OPEN_RAD)
            case Phase.DESCEND:
                blocked = aside > 0.03 and gz - oz < 0.03
                return self._towards((sx, sy, oz + HOVER_M if blocked else low), OPEN_RAD)
            case Phase.CLOSE:
                return self._towards((ox, oy, low), CLOSED_RAD)
            case Phase.LIFT if gz < low + LIFT_STRAIGHT_M:
                return self._towards((ox, oy, low + LIFT_STRAIGHT_M + 0.02), CLOSED_RAD)
            case _:
                return self._carry()

    def _carry(self) -> list[float]:
        """Joint-space move to the pose in which a held thing is shown to the cameras."""
        stride = CARRY_SPEED_RAD_S * CONTROL_DT_S
        arm = [
            here + min(max(there - here, -stride), stride)
            for here, there in zip(self._joints[:5], CARRY_POSE, strict=True)
        ]
        if arm == list(CARRY_POSE):
            self._enter(Phase.DONE)
        self._joints = [*arm, CLOSED_RAD]
        return list(self._joints)

    def _floor_z(self) -> float:
        return self._env.config.table_top_z_m + 0.0135

    def _enter(self, phase: Phase) -> None:
        if phase is not self.phase:
            self.phase, self._in_phase = phase, 0

    def _towards(self, goal: tuple[float, float, float], grip: float) -> list[float]:
        """Move the reference at a bounded speed towards the goal and solve for it."""
        stride = SPEED_M_S * CONTROL_DT_S
        here = self._reference
        gap = math.dist(here, goal)
        share = 1.0 if gap <= stride else stride / gap
        self._reference = (
            here[0] + share * (goal[0] - here[0]),
            here[1] + share * (goal[1] - here[1]),
            here[2] + share * (goal[2] - here[2]),
        )
        joints, _ = self._kinematics.solve(self._reference, self._joints)
        grip_stride = GRIPPER_SPEED_RAD_S * CONTROL_DT_S
        joints[5] = self._joints[5] + min(max(grip - self._joints[5], -grip_stride), grip_stride)
        self._joints = joints
        return joints


class RestController:
    """Brings the arm back to the rest pose at a bounded joint speed, first opening what it holds when asked."""

    def __init__(self, start: dict[str, float], *, speed_rad_s: float = 1.6) -> None:
        self._target = [start[n] for n in ARM_JOINTS]
        self._stride = speed_rad_s * CONTROL_DT_S

    def act(self) -> list[float]:
        """The next joint target; the same pose again once at rest."""
        self._target = [
            here + min(max(there - here, -self._stride), self._stride)
            for here, there in zip(self._target, REST_POSE, strict=True)
        ]
        return list(self._target)

    @property
    def done(self) -> bool:
        """Whether the target has arrived at the rest pose."""
        return all(abs(a - b) < 1e-6 for a, b in zip(self._target, REST_POSE, strict=True))


def run_expert(env: SimEnv, expert: GrabExpert, *, max_steps: int = 150, settle_steps: int = 6) -> bool:
    """Let the expert finish; whether its object is held at the end."""
    for _ in range(max_steps):
        env.step(expert.act())
        if expert.done:
            break
    for _ in range(settle_steps):
        env.step(expert.act())
    held: Any = env.held_object()
    return held is not None
