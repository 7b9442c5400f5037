"""A manifest's action contract, resolved against one robot.

`plan_actions` returns the plan that `actions` plays, and a finding for everything that the robot
cannot do. Pure but for the model's frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from vram_arbiter.runner.protocols import EndEffector, Joint, RobotDescription
from vram_arbiter.runner.robots.units import Scale
from vram_arbiter.runner.skills.actions import TWIST, ActionPlan, Command, Kind
from vram_arbiter.runner.skills.kinematics import ArmModel
from vram_arbiter.runner.skills.units import SAME, of_joint, opening
from vram_arbiter.schemas.control import CARTESIAN_MODES, GRIPPER_MODES, JOINT_MODES, ControlMode
from vram_arbiter.schemas.findings import Path, Problem
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.contracts import ActuatorRequirement
from vram_arbiter.schemas.manifest.io_contracts import ActionContract, ActionSlot
from vram_arbiter.schemas.manifest.vocabulary import ActionRepresentation, GripperConvention

_PATH = ("action_contract",)

_IN_WORDS = {
    ActionRepresentation.DELTA_EE_6D: (6, False),
    ActionRepresentation.DELTA_EE_6D_PLUS_GRIPPER: (6, True),
    ActionRepresentation.DELTA_EE_3D_PLUS_GRIPPER: (3, True),
}
_ALL = (-math.inf, math.inf)
_PLANAR = ("base_x", "base_y", "base_yaw")
_TWISTS = {2: (0, 5), 3: (0, 1, 5), 6: (0, 1, 2, 3, 4, 5)}


class _Misfit(Exception):
    """The one thing that keeps a part of the contract from this robot, and its field."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(message)
        self.problem = Problem(path, message)


@dataclass(slots=True)
class _Resolver:
    """One contract against one robot, slot by slot; `findings` collects what does not fit."""

    manifest: RSkillManifest
    robot: RobotDescription
    model: ArmModel | None
    findings: list[Problem] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    scales: list[Scale] = field(default_factory=list)
    bounds: dict[int, tuple[float, float]] = field(default_factory=dict)
    commanded: set[str] = field(default_factory=set)

    def attempt(self, step: Callable[..., None], *given: Any) -> None:
        """Resolve a part of the contract; a finding if it does not fit."""
        try:
            step(*given)
        except _Misfit as misfit:
            self.findings.append(misfit.problem)

    def actuator(self, modes: frozenset[ControlMode]) -> ActuatorRequirement | None:
        """Return the manifest's actuator of these modes, if it has one."""
        return next((a for a in self.manifest.actuators_required if a.kind in modes), None)

    def is_delta(self, modes: frozenset[ControlMode]) -> bool:
        """Return whether the actuator of these modes is told steps."""
        found = self.actuator(modes)
        return found is not None and found.control_mode_semantics.mode == "delta"

    # -- the vector
    def resolve(self, joints: tuple[str, ...]) -> None:
        contract = self.manifest.action_contract
        if contract is None:
            contract = ActionContract.model_construct(dim=len(joints))
        self.scales = [SAME] * contract.dim
        if contract.slots is not None:
            for index, slot in enumerate(contract.slots):
                self.attempt(self.slot, (*_PATH, "slots", index), slot)
        elif contract.representation in _IN_WORDS:
            self.attempt(self.tool_vector, contract, contract.representation)
        else:
            self.attempt(self.joint_vector, contract, joints)

    def joint_vector(self, contract: ActionContract, joints: tuple[str, ...]) -> None:
        if contract.representation is ActionRepresentation.CARTESIAN_POSE:
            raise _Misfit(
                (*_PATH, "representation"),
                "cartesian_pose does not say how it writes the orientation: give slots with"
                " rotation",
            )
        if contract.dim != len(joints):
            said = f"commands {contract.dim} joints, the robot has {len(joints)}"
            raise _Misfit((*_PATH, "dim"), said)
        velocity = contract.representation is ActionRepresentation.JOINT_VELOCITIES
        mode = ControlMode.JOINT_VELOCITY if velocity else ControlMode.JOINT_POSITION
        self.joint_command(_PATH, tuple(range(contract.dim)), joints, mode)

    def tool_vector(self, contract: ActionContract, representation: ActionRepresentation) -> None:
        """Resolve a vector that is described by a word, as the slots that it stands for."""
        width, with_gripper = _IN_WORDS[representation]
        path = (*_PATH, "representation")
        if contract.dim != width + with_gripper:
            said = f"is {contract.dim}; {representation} has {width + with_gripper} values"
            raise _Misfit((*_PATH, "dim"), said)
        if len({end.frame for end in self.robot.ends}) != 1:
            raise _Misfit(
                path,
                f"{representation} moves the one end effector of a robot; {self.robot.name} has"
                f" {len(self.robot.ends) or 'none'}: give slots with ee and frame",
            )
        arm = self.actuator(CARTESIAN_MODES)
        frame = None if arm is None else arm.control_mode_semantics.reference_frame
        if frame is None:
            raise _Misfit(
                path,
                f"the frame of {representation} is not stated: give an actuator of kind"
                " cartesian_delta its reference_frame, or slots",
            )
        end, mode = self.robot.ends[0].name, ControlMode.CARTESIAN_DELTA
        arm_slot = ActionSlot(range=(0, width - 1), control_mode=mode, ee=end, frame=frame)
        self.tool_slot(_PATH, arm_slot, mode)
        if with_gripper:
            mode = ControlMode.GRIPPER_POSITION
            gripper = ActionSlot(range=(width, width), control_mode=mode, ee=end)
            self.gripper_slot(_PATH, gripper, mode)

    def slot(self, path: Path, slot: ActionSlot) -> None:
        at, mode = _places(slot), slot.control_mode
        if slot.terminate:
            self.commands.append(Command("terminate", at))
            return
        if mode is None:  # discarded
            return
        if slot.input_bounds is not None:
            self.bounds |= dict.fromkeys(at, slot.input_bounds)
        if mode in JOINT_MODES:
            self.joint_slot(path, slot, mode)
        elif mode in CARTESIAN_MODES:
            self.tool_slot(path, slot, mode)
        elif mode in GRIPPER_MODES:
            self.gripper_slot(path, slot, mode)
        elif mode is ControlMode.BODY_TWIST:
            self.twist_slot(path, slot)
        elif mode is ControlMode.COMPOSITE_MODE:
            self.commands.append(Command("composite_mode", at))
        else:
            self.cannot_send(path, mode)

    def cannot_send(self, path: Path, mode: ControlMode) -> None:
        said = f"{mode} cannot be sent: {self.robot.name} is driven by joint positions"
        raise _Misfit((*path, "control_mode"), said)

    # -- joints
    def joint_slot(self, path: Path, slot: ActionSlot, mode: ControlMode) -> None:
        at, names, base = _places(slot), slot.joint_names, self.robot.base
        if set(names) & set(base.joints if base is not None else _PLANAR):
            self.base_joints(path, slot, mode)
            return
        arm = self.actuator(JOINT_MODES)
        order = names or (arm.control_mode_semantics.joint_order if arm is not None else None)
        wanted = tuple(order or self.robot.joint_names)
        if len(wanted) != len(at):
            said = f"covers {len(at)} values for {len(wanted)} joints: give joint_names"
            raise _Misfit((*path, "range"), said)
        self.joint_command(path, at, wanted, mode)

    def base_joints(self, path: Path, slot: ActionSlot, mode: ControlMode) -> None:
        base, names = self.robot.base, slot.joint_names
        if base is None:
            said = f"drives a base ({', '.join(names)}); {self.robot.name} has none"
            raise _Misfit((*path, "joint_names"), said)
        if mode is not ControlMode.JOINT_VELOCITY:
            said = f"a base is driven by velocities, not by {mode}"
            raise _Misfit((*path, "control_mode"), said)
        if unknown := [name for name in names if name not in base.joints]:
            raise _Misfit(
                (*path, "joint_names"),
                f"mixes the base's joints with {', '.join(unknown)}; the base has"
                f" {', '.join(base.joints)}",
            )
        places = tuple((0, 1, 5)[base.joints.index(name)] for name in names)
        self.drive(path, _places(slot), places)

    def joint_command(
        self, path: Path, at: tuple[int, ...], names: tuple[str, ...], mode: ControlMode
    ) -> None:
        known = {joint.name: joint for joint in self.robot.joints}
        if unknown := [name for name in names if name not in known]:
            said = f"moves {', '.join(unknown)}; the robot has {', '.join(known) or 'no joints'}"
            raise _Misfit(path, said)
        if mode is ControlMode.JOINT_TORQUE:
            self.cannot_send(path, mode)
        delta = self.is_delta(frozenset({ControlMode.JOINT_POSITION}))
        kind: Kind = "joint_delta" if delta else "joint_position"
        if mode is ControlMode.JOINT_VELOCITY:
            kind = "joint_velocity"
        for index, name in zip(at, names, strict=True):
            scale = self.joint_scale(path, known[name])
            self.scales[index] = scale if kind == "joint_position" else Scale(scale.scale)
        gripper = self.actuator(GRIPPER_MODES)
        apart: tuple[int, ...] = ()  # grippers that do not go as the other joints do
        if gripper is not None and not (
            kind == "joint_position"
            and gripper.kind is ControlMode.GRIPPER_POSITION
            and gripper.control_mode_semantics.mode == "absolute"
        ):
            apart = tuple(i for i, name in enumerate(names) if known[name].gripper)
            for i in apart:
                convention = gripper.control_mode_semantics.gripper_convention
                self.gripper_value(path, at[i], known[names[i]], gripper.kind, convention)
        if rest := [i for i in range(len(names)) if i not in apart]:
            moved = tuple(names[i] for i in rest)
            self.claim(path, moved)
            self.commands.append(Command(kind, tuple(at[i] for i in rest), moved))

    def joint_scale(self, path: Path, joint: Joint) -> Scale:
        try:
            return scale_of(joint, self.manifest)
        except ValueError as error:
            raise _Misfit(path, str(error)) from error

    def claim(self, path: Path, names: tuple[str, ...]) -> None:
        if again := [name for name in names if name in self.commanded]:
            raise _Misfit(path, f"commands {', '.join(again)} a second time")
        self.commanded.update(names)

    # -- tools and grippers
    def end(self, path: Path, name: str) -> EndEffector:
        """Return the end effector of that name, or a frame of the model as one."""
        found = next((end for end in self.robot.ends if end.name == name), None)
        if found is None and self.model is not None and self.model.has(name):
            return EndEffector(name, name)
        if found is None:
            known = ", ".join(end.name for end in self.robot.ends) or "none"
            raise _Misfit((*path, "ee"), f"no end effector {name!r}; the robot has {known}")
        return found

    def tool_slot(self, path: Path, slot: ActionSlot, mode: ControlMode) -> None:
        at, frame, rotation, model = _places(slot), slot.frame or "", slot.rotation, self.model
        if model is None:
            raise _Misfit(
                (*path, "control_mode" if path != _PATH else "representation"),
                f"{mode} needs a model of {self.robot.name} for its kinematics; there is none",
            )
        end = self.end(path, slot.ee or "")
        for part, name in (("frame", frame), ("ee", end.frame)):
            if not model.has(name):
                raise _Misfit((*path, part), no_frame(name, model))
        widths: tuple[int, ...] = (3, 6)
        if mode is ControlMode.CARTESIAN_POSE:
            widths = (3,) if rotation is None else (3 + rotation.width,)
        if len(at) not in widths:
            raise _Misfit(
                (*path, "range"),
                f"covers {len(at)} values; {mode} has {' or '.join(map(str, widths))}"
                + (" (a pose with an orientation needs rotation)" if widths == (3,) else ""),
            )
        movers, freedom = model.movers(end.frame), 6 if len(at) > 3 else 3
        if len(movers) < freedom:
            raise _Misfit(
                path,
                f"{mode} of {freedom} degrees of freedom; the {len(movers)} joints"
                f" that move {end.frame} cannot follow it",
            )
        if mode is ControlMode.CARTESIAN_DELTA:
            self.delta_scale(at)
        self.claim(path, movers)
        kind: Kind = mode.value  # type: ignore[assignment]
        self.commands.append(Command(kind, at, movers, end.frame, frame, rotation))

    def delta_scale(self, at: tuple[int, ...]) -> None:
        contract = self.manifest.action_contract
        stated = contract.cartesian_delta_scale if contract is not None else None
        scale = stated or self.robot.units.cartesian_delta_scale
        if scale is None or len(scale) < len(at):
            raise _Misfit(
                (*_PATH, "cartesian_delta_scale"),
                "is not stated, and a unit of the delta may be anything: give m and rad per unit"
                " (1 where the policy answers in m and rad) here or in hal.params.units",
            )
        for index, factor in zip(at, scale, strict=False):
            self.scales[index] = Scale(factor)

    def gripper_slot(self, path: Path, slot: ActionSlot, mode: ControlMode) -> None:
        if slot.width != 1:
            raise _Misfit((*path, "range"), f"covers {slot.width} values; a gripper takes one")
        end = self.end(path, slot.ee or "")
        joint = next((j for j in self.robot.joints if j.name == end.gripper), None)
        if joint is None:
            raise _Misfit((*path, "ee"), f"{slot.ee} has no gripper that this robot moves")
        stated = slot.gripper_convention or stated_convention(self.manifest)
        convention = stated or self.robot.units.gripper_convention
        self.gripper_value(path, slot.range[0], joint, mode, convention)

    def gripper_value(
        self,
        path: Path,
        at: int,
        joint: Joint,
        mode: ControlMode,
        convention: GripperConvention | None,
    ) -> None:
        """Command one gripper by one value."""
        if convention is None:
            raise _Misfit(
                path,
                f"{mode} does not say which number is open: give gripper_convention here or in"
                " actuators_required, or in hal.params.units",
            )
        self.claim(path, (joint.name,))
        kind: Kind = "joint_delta" if self.is_delta(GRIPPER_MODES) else "joint_position"
        try:
            if mode is ControlMode.GRIPPER_BINARY:
                kind, scale = "gripper_switch", opening(convention)
            else:
                scale = of_joint(joint, None, convention)
        except ValueError as error:
            raise _Misfit(path, str(error)) from error
        self.scales[at] = Scale(scale.scale) if kind == "joint_delta" else scale
        self.commands.append(Command(kind, (at,), (joint.name,)))

    # -- the base
    def twist_slot(self, path: Path, slot: ActionSlot) -> None:
        base = self.robot.base
        if base is None:
            raise _Misfit((*path, "control_mode"), f"{self.robot.name} has no base to drive")
        if slot.frame != base.frame:
            said = f"{slot.frame!r}: the base is driven in its own frame, {base.frame!r}"
            raise _Misfit((*path, "frame"), said)
        if slot.width not in _TWISTS:
            said = f"covers {slot.width} values; a twist has 2 (vx, wz), 3 (vx, vy, wz) or 6"
            raise _Misfit((*path, "range"), said)
        self.drive(path, _places(slot), _TWISTS[slot.width])

    def drive(self, path: Path, at: tuple[int, ...], places: tuple[int, ...]) -> None:
        """Command the base: value `at[i]` is entry `places[i]` of the twist."""
        self.claim(path, ("the base",))
        order = sorted(range(len(at)), key=lambda i: places[i])
        names = tuple(TWIST[places[i]] for i in order)
        self.commands.append(Command("base_velocity", tuple(at[i] for i in order), names))


def _places(slot: ActionSlot) -> tuple[int, ...]:
    return tuple(range(slot.range[0], slot.range[1] + 1))


def stated_convention(manifest: RSkillManifest) -> GripperConvention | None:
    """Return how the manifest's gripper actuator counts, if it has one."""
    for actuator in manifest.actuators_required:
        if actuator.kind in GRIPPER_MODES:
            return actuator.control_mode_semantics.gripper_convention
    return None


def scale_of(joint: Joint, manifest: RSkillManifest) -> Scale:
    """Return the map of a joint's numbers in the manifest's vectors. Raises ValueError."""
    contract = manifest.action_contract
    units = contract.joint_units if contract is not None else None
    return of_joint(joint, units, stated_convention(manifest))


def no_frame(name: str, model: ArmModel) -> str:
    """Say that a frame is missing, with those that there are."""
    return f"no frame {name!r}; the model has {', '.join(model.frames)}"


def needs_frames(manifest: RSkillManifest) -> bool:
    """Return whether the action contract speaks of frames."""
    contract = manifest.action_contract
    if contract is None:
        return False
    if contract.slots is None:
        return contract.representation in _IN_WORDS
    return any(slot.control_mode in CARTESIAN_MODES for slot in contract.slots)


def plan_actions(
    manifest: RSkillManifest,
    robot: RobotDescription,
    joints: tuple[str, ...],
    model: ArmModel | None,
) -> tuple[ActionPlan, list[Problem]]:
    """Return the plan, and a finding for each part that this robot cannot do.

    `joints` is the order of joints where the manifest gives none; `model` is needed for frames. A
    plan with findings must not be used.
    """
    resolver = _Resolver(manifest, robot, model)
    resolver.resolve(joints)
    if not resolver.commands and not resolver.findings:
        resolver.findings.append(Problem((*_PATH, "slots"), "command nothing"))
    commanded = dict.fromkeys(
        name
        for command in resolver.commands
        if command.kind != "base_velocity"
        for name in command.joints
    )
    plan = ActionPlan(
        len(resolver.scales),
        None if set(resolver.scales) <= {SAME} else tuple(resolver.scales),
        tuple(resolver.commands),
        tuple(commanded),
        tuple(resolver.bounds.get(index, _ALL) for index in range(len(resolver.scales)))
        if resolver.bounds
        else None,
    )
    return plan, resolver.findings
