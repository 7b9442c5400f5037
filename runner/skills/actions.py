"""A policy's action vector as commands of this robot.

`ActionPlan.rows` turns a chunk into rows in m and rad, `numbers` turns them back; `Stepper.step`
turns one row into joint targets and a body twist. Nothing here is a limit: every command passes the
safety gate. `action_contract` makes the plans.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.units import Scale
from vram_arbiter.runner.skills.kinematics import REACHED_M, REACHED_RAD, ArmModel, Pose3
from vram_arbiter.runner.skills.motion import bounded
from vram_arbiter.runner.skills.rotations import axis_angle, matrix_of, turn
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest.vocabulary import Rotation
from vram_arbiter.schemas.world import Twist

Row = tuple[float, ...]
Kind = Literal[
    "joint_position",
    "joint_delta",
    "joint_velocity",
    "gripper_switch",
    "cartesian_delta",
    "cartesian_twist",
    "cartesian_pose",
    "base_velocity",
    "composite_mode",
    "terminate",
]

WITHHELD_BELOW = 0.5  # share of a tool step that must be reachable
# a longer step of one tick is a wrong unit, not a motion
STEP_MAX_M = 0.25
STEP_MAX_RAD = 1.0
TERMINATE_ABOVE = 0.5
OPEN_ABOVE = 0.5
BASE_ABOVE = 0.0  # of the composite mode: -1 manipulates, 1 navigates
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


@dataclass(frozen=True, slots=True)
class Command:
    """What the values at `at` of a row do. `frame` gives the axes of a motion of the frame `ee`."""

    kind: Kind
    at: tuple[int, ...]
    joints: tuple[str, ...] = ()
    ee: str = ""
    frame: str = ""
    rotation: Rotation | None = None


@dataclass(frozen=True, slots=True)
class ActionPlan:
    """A contract resolved for one robot.

    `joints` are those that it commands. `scales` turn the policy's numbers into m and rad, `bounds`
    are the ends to which they are clipped before (None: none has any).
    """

    dim: int
    scales: tuple[Scale, ...] | None
    commands: tuple[Command, ...]
    joints: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...] | None = None

    def rows(self, actions: Any) -> list[Row]:
        """Return the rows of a chunk in m and rad.

        Raises ModelError for a wrong shape or numbers that are not finite.
        """
        import numpy as np

        if actions.ndim == 3 and actions.shape[0] == 1:
            actions = actions[0]
        if actions.ndim != 2 or actions.shape[1] != self.dim:
            raise ModelError(f"actions of shape {actions.shape}; (steps, {self.dim}) is expected")
        if not np.isfinite(actions).all():
            raise ModelError(
                "the policy commands numbers that are not finite", hint="its weights are broken"
            )
        if self.bounds is not None:
            actions = np.clip(actions, *np.array(self.bounds).T)
        if self.scales is not None:
            actions = actions * [s.scale for s in self.scales] + [s.offset for s in self.scales]
        return [tuple(map(float, row)) for row in actions]

    def numbers(self, rows: Sequence[Row]) -> tuple[Row, ...]:
        """Return rows of a chunk (m and rad) as the policy's numbers."""
        if self.scales is None:
            return tuple(rows)
        return tuple(
            tuple(scale.of(value) for scale, value in zip(self.scales, row, strict=True))
            for row in rows
        )


# -- one step
@dataclass(slots=True)
class RowStep:
    """What one row asks of the robot. `problem`: how it falls short; `withheld`: nothing moves."""

    targets: dict[str, float]  # rad by joint
    twist: Twist | None = None
    terminated: bool = False
    problem: str = ""
    withheld: bool = False


class Stepper:
    """Plays rows of a plan.

    `longest` are the joints' longest steps (rad), where they are known; `leading`: absolute targets
    are set points far ahead, approached in such steps, as a gripper's always are.
    """

    def __init__(
        self,
        plan: ActionPlan,
        robot: RobotDescription,
        model: ArmModel | None,
        *,
        period_s: float,
        longest: Mapping[str, float] | None = None,
        leading: bool = False,
    ) -> None:
        self._plan = plan
        self._model = model
        self._period_s = period_s
        self._longest = longest or {}
        self._joints = {joint.name: joint for joint in robot.joints}
        # those that are told where to be and take their time to come there
        self._slow = {j.name for j in robot.joints if j.gripper or leading} & self._longest.keys()
        mode = next((c for c in plan.commands if c.kind == "composite_mode"), None)
        self._mode_at = None if mode is None else mode.at[0]
        grippers = {joint.name for joint in robot.joints if joint.gripper}
        self._arm_commands = {
            command
            for command in plan.commands
            if command.kind != "base_velocity" and not grippers.issuperset(command.joints)
        }

    def _turns(self, row: Row) -> tuple[bool, bool]:
        """Return whether a row moves the base, and whether it moves the arm.

        A composite mode, as of robosuite's HybridMobileBase, gives the step to one of them: to the
        base above 0, else to the arm. Grippers move in both.
        """
        if self._mode_at is None:
            return True, True
        base = row[self._mode_at] > BASE_ABOVE
        return base, not base

    def step(self, row: Row, start: Mapping[str, float]) -> RowStep:
        """Return what to do from the joint targets `start` (rad). Raises ModelError for a step
        that no unit explains.
        """
        done = RowStep({})
        base_moves, arm_moves = self._turns(row)
        for command in self._plan.commands:
            if command in self._arm_commands and not arm_moves:
                continue
            values = [row[index] for index in command.at]
            match command.kind:
                case "joint_position":
                    done.targets.update(zip(command.joints, values, strict=True))
                case "joint_delta" | "joint_velocity":
                    per = self._period_s if command.kind == "joint_velocity" else 1.0
                    self._add(done, command.joints, [value * per for value in values], start)
                case "gripper_switch":
                    joint = self._joints[command.joints[0]]
                    done.targets[joint.name] = (
                        joint.upper_rad if values[0] > OPEN_ABOVE else joint.lower_rad
                    )
                case "base_velocity":
                    told = dict(zip(command.joints, values, strict=True)) if base_moves else {}
                    vx, vy, vz, wx, wy, wz = (told.get(name, 0.0) for name in TWIST)
                    done.twist = (vx, vy, vz, wx, wy, wz)
                case "composite_mode":
                    pass  # read above
                case "terminate":
                    done.terminated |= values[0] > TERMINATE_ABOVE
                case _:
                    self._move_tool(done, command, values, start)
        for name in self._slow & done.targets.keys():
            done.targets[name] = bounded(start[name], done.targets[name], self._longest[name])
        return done

    def _add(
        self,
        done: RowStep,
        names: tuple[str, ...],
        steps: Sequence[float],
        start: Mapping[str, float],
    ) -> None:
        """Add steps to joint targets, which end at the joints' stops."""
        for name, step in zip(names, steps, strict=True):
            joint = self._joints[name]
            wanted = start[name] + step
            target = min(max(wanted, joint.lower_rad), joint.upper_rad)
            if target != wanted and abs(target - wanted) > REACHED_RAD:
                done.problem = done.problem or f"{name} is at its stop, {target:.3f} rad"
            done.targets[name] = target

    def _move_tool(
        self, done: RowStep, command: Command, values: Sequence[float], start: Mapping[str, float]
    ) -> None:
        import numpy as np

        if self._model is None:
            raise ModelError(f"{command.kind} without a model of the arm")
        here = self._model.pose(command.ee, start)
        axes = self._model.pose(command.frame, start)
        turning = len(values) > 3
        if command.kind == "cartesian_pose":
            rotation = (
                matrix_of(values[3:], command.rotation)
                if command.rotation is not None
                else axes.matrix.T @ here.matrix
            )
            target = axes.then(Pose3(np.array(values[:3]), rotation))
        else:
            per = self._period_s if command.kind == "cartesian_twist" else 1.0
            step = np.array(values) * per
            target = Pose3(here.xyz + axes.matrix @ step[:3], here.matrix)
            if turning:
                target = Pose3(target.xyz, turn(axes.matrix @ step[3:]) @ here.matrix)
        asked_m = float(np.linalg.norm(target.xyz - here.xyz))
        asked_rad = math.hypot(*axis_angle(target.matrix @ here.matrix.T)) if turning else 0.0
        if command.kind != "cartesian_pose" and (asked_m > STEP_MAX_M or asked_rad > STEP_MAX_RAD):
            raise ModelError(
                f"the policy asks for {asked_m:.2f} m and {asked_rad:.2f} rad in one step",
                hint="its cartesian_delta_scale is not the unit of its deltas",
            )
        found = self._model.reach(command.ee, target, start, turning=turning)
        short_m, short_rad = found.short_m, found.short_rad
        if short_m > 2 * REACHED_M or short_rad > 2 * REACHED_RAD:
            done.problem = (
                f"{command.ee} stops {short_m * 1e3:.1f} mm and {math.degrees(short_rad):.1f}° "
                f"short of a step of {asked_m * 1e3:.1f} mm and {math.degrees(asked_rad):.1f}°: "
                "the arm reaches no further"
            )
            done.withheld |= short_m > max(WITHHELD_BELOW * asked_m, 5 * REACHED_M) or (
                short_rad > max(WITHHELD_BELOW * asked_rad, 5 * REACHED_RAD)
            )
        done.targets.update(self._in_time(done, found.joints, start))

    def _in_time(
        self, done: RowStep, joints: Mapping[str, float], start: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the way to `joints` as far as the slowest of them comes in one period."""
        share = 1.0
        for name, target in joints.items():
            way, longest = abs(target - start[name]), self._longest.get(name, math.inf)
            if way * share > longest:
                share = longest / way
        if share < 1.0 and not done.problem:
            done.problem = f"the step is shortened to {share:.0%}: the joints are not faster"
        return {name: start[name] + share * (to - start[name]) for name, to in joints.items()}
