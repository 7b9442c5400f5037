"""The scripted grab that demonstrations are recorded from: approach, descend, close, lift.

It reads the ground truth, so no program of the robot may run it; datasets, tests and evaluation do.
"""

from __future__ import annotations

import enum
import math
from dataclasses import replace

from vram_arbiter.runner.robots.so101 import TOOL, so101
from vram_arbiter.runner.sim.config import ARM_JOINTS
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.skills.kinematics import ArmModel, Pose3

OPEN_RAD = 0.80
CLOSED_RAD = -0.10
LOWEST_M = 0.0135  # of the grasp point above the table: the finger tips clear it by 3 mm
PAN_AXIS_X_M = 0.119  # the shoulder's pan axis in the base frame
HOVER_M = 0.060  # of the grasp point above the object's centre
# The open fixed finger is nearer to the grasp point than a turned cube's corner: descend this much
# short of the object's center, towards the arm, and make up for it while closing.
SHY_M = 0.013
LIFT_STRAIGHT_M = 0.04
CARRY_POSE = (0.0, -0.70, 0.45, 0.85, 0.0)
CARRY_REACHED_RAD = 0.06
# Targets lead the arm by at most this much; the servos' lag turns it into a speed of about 0.35
# m/s. Leading from the arm's measured pose, not from its last target, makes the target a function
# of what the cameras and joints show.
LEAD_M = 0.022
LEAD_RAD = 0.13
NARROWEST_HOLD_RAD = 0.12  # the gripper closes beyond this only when nothing is between the fingers
GRIPPING_RAD = 0.62  # and beyond this it is open: the widest ball is held at about 0.4
CLOSE_STEPS = (5, 14)
STILL_RAD_S = 0.15


class Phase(enum.Enum):
    """Where the grab stands."""

    APPROACH = enum.auto()
    DESCEND = enum.auto()
    CLOSE = enum.auto()
    LIFT = enum.auto()
    DONE = enum.auto()


def _arm() -> ArmModel:
    """Return the model of the arm; its wrist does not roll."""
    robot = so101(simulated=True)
    joints = [
        replace(joint, lower_rad=0.0, upper_rad=0.0) if joint.name == "wrist_roll" else joint
        for joint in robot.joints
    ]
    return ArmModel(replace(robot, joints=tuple(joints)))


class GrabExpert:
    """Produces one joint target per control step until `done`; closed loop on the true object pose.

    `offset_m` shifts where the expert believes the object to be, and `retry` False lets it lift an
    empty gripper: together a way to record misses.
    """

    def __init__(
        self,
        env: SimEnv,
        name: str,
        *,
        offset_m: tuple[float, float] = (0.0, 0.0),
        retry: bool = True,
    ) -> None:
        self._env, self._name, self._arm = env, name, _arm()
        self._offset, self._retry = offset_m, retry
        self.phase = Phase.APPROACH
        self._in_phase = 0
        self._object = self._believed()

    @property
    def done(self) -> bool:
        """Whether the lift is finished."""
        return self.phase is Phase.DONE

    def _believed(self) -> tuple[float, float, float]:
        x, y, z = self._env.ground_truth().objects[self._name].position_base
        return x + self._offset[0], y + self._offset[1], z

    def act(self) -> list[float]:
        """Return the next joint target (six angles, rad)."""
        self._in_phase += 1
        if self.phase in (Phase.APPROACH, Phase.DESCEND):
            self._object = self._believed()
        ox, oy, oz = self._object
        gx, gy, gz = self._env.gripper_position()
        heading = math.atan2(oy, ox - PAN_AXIS_X_M)
        sx, sy = ox - SHY_M * math.cos(heading), oy - SHY_M * math.sin(heading)
        low = max(oz, self._env.config.table_top_z_m + LOWEST_M)
        aside = math.hypot(gx - sx, gy - sy)
        self._advance(aside, gz, oz, low)
        match self.phase:
            case Phase.APPROACH:
                return self._towards((sx, sy, oz + HOVER_M), OPEN_RAD)
            case Phase.DESCEND:
                return self._towards((sx, sy, low), OPEN_RAD)
            case Phase.CLOSE:
                return self._towards((ox, oy, low), CLOSED_RAD)
            case Phase.LIFT if gz < low + LIFT_STRAIGHT_M:
                return self._towards((ox, oy, low + LIFT_STRAIGHT_M + 0.03), CLOSED_RAD)
            case _:
                return self._carry()

    def _advance(self, aside: float, gz: float, oz: float, low: float) -> None:
        """Enter the next phase when the present one has done its work, or the first one on
        failure.
        """
        grip = self._env.joint_state()["gripper"]
        match self.phase:
            case Phase.APPROACH if (
                aside < 0.007 and gz - oz < HOVER_M + 0.02 and grip > 0.9 * OPEN_RAD
            ):
                self._enter(Phase.DESCEND)
            case Phase.DESCEND if gz - low < 0.004 and aside < 0.008:
                self._enter(Phase.CLOSE)
            case Phase.DESCEND if aside > 0.012 and gz - low > 0.006:
                self._enter(Phase.APPROACH)
            case Phase.CLOSE:
                least, most = CLOSE_STEPS
                still = abs(self._env.joint_velocity()["gripper"]) < STILL_RAD_S
                if grip < GRIPPING_RAD and (
                    self._in_phase > most or (self._in_phase > least and still)
                ):
                    self._enter(Phase.LIFT)
            case Phase.LIFT | Phase.DONE if (
                self._retry and not NARROWEST_HOLD_RAD < grip < GRIPPING_RAD
            ):
                self._enter(Phase.APPROACH)
            case _:
                pass

    def _enter(self, phase: Phase) -> None:
        self.phase, self._in_phase = phase, 0

    def _carry(self) -> list[float]:
        """Move in joint space to the pose in which a held thing is shown to the cameras."""
        here = list(self._env.joint_state().values())[:5]
        if self.phase is Phase.LIFT and all(
            abs(a - b) < CARRY_REACHED_RAD for a, b in zip(here, CARRY_POSE, strict=True)
        ):
            self._enter(Phase.DONE)
        arm = [
            a + min(max(b - a, -LEAD_RAD), LEAD_RAD) for a, b in zip(here, CARRY_POSE, strict=True)
        ]
        return [*arm, CLOSED_RAD]

    def _towards(self, goal: tuple[float, float, float], grip: float) -> list[float]:
        """Return joint angles for a point on the straight way to the grasp point, within the lead,
        with the fingers down as far as they can.
        """
        import numpy as np
        from scipy.spatial.transform import Rotation

        here = self._env.gripper_position()
        gap = math.dist(here, goal)
        share = 1.0 if gap <= LEAD_M else LEAD_M / gap
        ahead = [a + share * (b - a) for a, b in zip(here, goal, strict=True)]
        joints, mount = self._env.joint_state(), self._env.config.mount_in_base_m
        matrix = self._arm.pose(TOOL, joints).matrix
        upright, _ = Rotation.align_vectors([(0.0, 0.0, 1.0)], [matrix[:, 2]])
        target = Pose3(np.subtract(ahead, mount), upright.as_matrix() @ matrix)
        reached = self._arm.reach(TOOL, target, joints, turning=False).joints
        return [*(reached[name] for name in ARM_JOINTS[:5]), grip]
