"""A manifest's action contract, resolved against one robot.

`plan_actions` returns the plan that `actions` plays, and a finding for everything that the robot
cannot do. Pure but for the model's frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from vram_arbiter.runner.protocols import EndEffector, Joint, RobotDescription
from vram_arbiter.runner.skills.actions import TWIST, ActionPlan, Command, Kind
from vram_arbiter.runner.skills.kinematics import ArmModel
from vram_arbiter.runner.skills.units import SAME, Scale, of_joint, opening
from vram_arbiter.schemas.control import CARTESIAN_MODES, GRIPPER_MODES, JOINT_MODES, ControlMode
from vram_arbiter.schemas.findings import Path, Problem
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.contracts import ActuatorRequirement, ControlModeSemantics
from vram_arbiter.schemas.manifest.io_contracts import ActionContract, ActionSlot
from vram_arbiter.schemas.manifest.vocabulary import (
    ActionRepresentation,
    GripperConvention,
    Rotation,
)

_PATH = ("action_contract",)
_SLOTS = ("action_contract", "slots")

_IN_WORDS = {
    ActionRepresentation.DELTA_EE_6D: (6, False),
    ActionRepresentation.DELTA_EE_6D_PLUS_GRIPPER: (6, True),
    ActionRepresentation.DELTA_EE_3D_PLUS_GRIPPER: (3, True),
}
_ALL = (-math.inf, math.inf)
_PLANAR = ("base_x", "base_y", "base_yaw")


@dataclass(slots=True)
class _Resolver:
    """One contract against one robot; `findings` collects what does not fit."""

    manifest: RSkillManifest
    robot: RobotDescription
    model: ArmModel | None
    findings: list[Problem] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    scales: list[Scale] = field(default_factory=list)
    bounds: dict[int, tuple[float, float]] = field(default_factory=dict)
    commanded: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def wrong(self, path: Path, message: str) -> None:
        self.findings.append(Problem(path, message))

    # -- what the manifest says elsewhere
    def actuator(self, modes: frozenset[ControlMode]) -> ActuatorRequirement | None:
        """Return the manifest's actuator of these modes, if it has one."""
        return next((a for a in self.manifest.actuators_required if a.kind in modes), None)

    def semantics(self, modes: frozenset[ControlMode]) -> ControlModeSemantics | None:
        """Return how the actuator of these modes is meant, if the manifest has one."""
        found = self.actuator(modes)
        return found.control_mode_semantics if found is not None else None

    def gripper_convention(self, slot: ActionSlot | None) -> GripperConvention | None:
        if slot is not None and slot.gripper_convention is not None:
            return slot.gripper_convention
        return stated_convention(self.manifest) or self.robot.units.gripper_convention

    # -- the vector
    def resolve(self, joints: tuple[str, ...]) -> None:
        contract = self.manifest.action_contract
        slots = contract.slots if contract is not None else None
        representation = contract.representation if contract is not None else None
        if contract is not None and slots is not None:
            self.scales = [SAME] * contract.dim
            for index, slot in enumerate(slots):
                self.slot((*_SLOTS, index), slot, contract)
        elif contract is not None and representation in _IN_WORDS:
            self.tool_vector(contract, representation)
        elif representation is ActionRepresentation.CARTESIAN_POSE:
            self.wrong(
                (*_PATH, "representation"),
                "cartesian_pose does not say how it writes the orientation: give slots with"
                " rotation",
            )
        else:
            self.joint_vector(contract, joints)

    def joint_vector(self, contract: ActionContract | None, joints: tuple[str, ...]) -> None:
        dim = contract.dim if contract is not None else len(joints)
        if dim != len(joints):
            self.wrong((*_PATH, "dim"), f"commands {dim} joints, the robot has {len(joints)}")
            return
        velocity = (
            contract is not None
            and contract.representation is ActionRepresentation.JOINT_VELOCITIES
        )
        self.scales = [SAME] * dim
        self.joint_command(
            _PATH,
            tuple(range(dim)),
            joints,
            ControlMode.JOINT_VELOCITY if velocity else ControlMode.JOINT_POSITION,
        )

    def tool_vector(self, contract: ActionContract, representation: ActionRepresentation) -> None:
        width, with_gripper = _IN_WORDS[representation]
        if contract.dim != width + with_gripper:
            self.wrong(
                (*_PATH, "dim"),
                f"is {contract.dim}; {representation} has {width + with_gripper} values",
            )
            return
        if len({end.frame for end in self.robot.ends}) != 1:
            self.wrong(
                (*_PATH, "representation"),
                f"{representation} moves the one end effector of a robot; {self.robot.name} has"
                f" {len(self.robot.ends) or 'none'}: give slots with ee and frame",
            )
            return
        semantics = self.semantics(CARTESIAN_MODES)
        frame = semantics.reference_frame if semantics is not None else None
        if frame is None:
            self.wrong(
                (*_PATH, "representation"),
                f"the frame of {representation} is not stated: give an actuator of kind"
                " cartesian_delta its reference_frame, or slots",
            )
            return
        self.scales = [SAME] * contract.dim
        end = self.robot.ends[0]
        self.tool_command(
            _PATH, tuple(range(width)), ControlMode.CARTESIAN_DELTA, end.name, frame, None, contract
        )
        if with_gripper:
            self.gripper_command(
                _PATH, width, ControlMode.GRIPPER_POSITION, end.name, self.gripper_convention(None)
            )

    def slot(self, path: Path, slot: ActionSlot, contract: ActionContract) -> None:
        at = tuple(range(slot.range[0], slot.range[1] + 1))
        mode = slot.control_mode
        if slot.terminate:
            self.commands.append(Command("terminate", at))
            return
        if mode is None:  # discarded
            return
        if slot.input_bounds is not None:
            for index in at:
                self.bounds[index] = slot.input_bounds
        if mode in JOINT_MODES:
            self.joint_slot(path, at, slot.joint_names, mode)
        elif mode in CARTESIAN_MODES:
            self.tool_command(
                path, at, mode, slot.ee or "", slot.frame or "", slot.rotation, contract
            )
        elif mode in GRIPPER_MODES:
            if len(at) != 1:
                self.wrong((*path, "range"), f"covers {len(at)} values; a gripper takes one")
                return
            self.gripper_command(path, at[0], mode, slot.ee or "", self.gripper_convention(slot))
        elif mode is ControlMode.BODY_TWIST:
            self.twist_slot(path, at, slot.frame or "")
        elif mode is ControlMode.COMPOSITE_MODE:
            self.notes.append(
                f"{Problem(path, '').field}: composite_mode changes nothing: arm and base are"
                " driven at once, and the arm's frames move with the base"
            )
        else:
            self.wrong(
                (*path, "control_mode"),
                f"{mode} cannot be sent: {self.robot.name} is driven by joint positions",
            )

    # -- joints
    def joint_slot(
        self,
        path: Path,
        at: tuple[int, ...],
        names: tuple[str, ...],
        mode: ControlMode,
    ) -> None:
        base = self.robot.base
        if names and set(names) & set(base.joints if base is not None else _PLANAR):
            self.base_joints(path, at, names, mode)
            return
        semantics = self.semantics(JOINT_MODES)
        order = names or (semantics.joint_order if semantics is not None else None)
        wanted = tuple(order or self.robot.joint_names)
        if len(wanted) != len(at):
            self.wrong(
                (*path, "range"),
                f"covers {len(at)} values for {len(wanted)} joints: give joint_names",
            )
            return
        self.joint_command(path, at, wanted, mode)

    def base_joints(
        self,
        path: Path,
        at: tuple[int, ...],
        names: tuple[str, ...],
        mode: ControlMode,
    ) -> None:
        base = self.robot.base
        if base is None:
            self.wrong(
                (*path, "joint_names"),
                f"drives a base ({', '.join(names)}); {self.robot.name} has none",
            )
        elif mode is not ControlMode.JOINT_VELOCITY:
            self.wrong((*path, "control_mode"), f"a base is driven by velocities, not by {mode}")
        elif unknown := [name for name in names if name not in base.joints]:
            self.wrong(
                (*path, "joint_names"),
                f"mixes the base's joints with {', '.join(unknown)}; the base has"
                f" {', '.join(base.joints)}",
            )
        else:
            places = [(0, 1, 5)[base.joints.index(name)] for name in names]
            self.drive(path, at, places)

    def joint_command(
        self,
        path: Path,
        at: tuple[int, ...],
        names: tuple[str, ...],
        mode: ControlMode,
    ) -> None:
        known = {joint.name: joint for joint in self.robot.joints}
        if unknown := [name for name in names if name not in known]:
            self.wrong(
                path,
                f"moves {', '.join(unknown)}; the robot has {', '.join(known) or 'no joints'}",
            )
            return
        if mode is ControlMode.JOINT_TORQUE:
            self.wrong(
                (*path, "control_mode"),
                f"joint_torque cannot be sent: {self.robot.name} is driven by joint positions",
            )
            return
        semantics = self.semantics(frozenset({ControlMode.JOINT_POSITION}))
        delta = semantics is not None and semantics.mode == "delta"
        kind: Kind = "joint_delta" if delta else "joint_position"
        if mode is ControlMode.JOINT_VELOCITY:
            kind = "joint_velocity"
        for index, name in enumerate(names):
            scale = self.joint_scale(path, known[name])
            self.scales[at[index]] = scale if kind == "joint_position" else Scale(scale.scale)
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
        contract = self.manifest.action_contract
        units = contract.joint_units if contract is not None else None
        scale = of_joint(joint, units, stated_convention(self.manifest))
        if isinstance(scale, str):
            self.wrong(path, scale)
            return SAME
        return scale

    def claim(self, path: Path, names: tuple[str, ...]) -> None:
        for name in names:
            if name in self.commanded:
                self.wrong(path, f"commands {name} a second time")
            self.commanded[name] = path

    # -- tools and grippers
    def end(self, path: Path, name: str) -> EndEffector | None:
        """Return the end effector of that name, or a frame of the model as one."""
        found = next((end for end in self.robot.ends if end.name == name), None)
        if found is None and self.model is not None and self.model.has(name):
            return EndEffector(name, name)
        if found is None:
            known = ", ".join(end.name for end in self.robot.ends) or "none"
            self.wrong((*path, "ee"), f"no end effector {name!r}; the robot has {known}")
        return found

    def frame(self, path: Path, name: str) -> bool:
        if self.model is not None and not self.model.has(name):
            self.wrong((*path, "frame"), no_frame(name, self.model))
            return False
        return self.model is not None

    def tool_command(
        self,
        path: Path,
        at: tuple[int, ...],
        mode: ControlMode,
        ee: str,
        frame: str,
        rotation: Rotation | None,
        contract: ActionContract,
    ) -> None:
        if self.model is None:
            self.wrong(
                (*path, "control_mode") if path != _PATH else (*_PATH, "representation"),
                f"{mode} needs a model of {self.robot.name} for its kinematics; there is none",
            )
            return
        end = self.end(path, ee)
        if not self.frame(path, frame) or end is None:
            return
        if not self.model.has(end.frame):
            self.wrong((*path, "ee"), no_frame(end.frame, self.model))
            return
        turning = len(at) > 3
        widths: tuple[int, ...] = (3, 6)
        if mode is ControlMode.CARTESIAN_POSE:
            widths = (3,) if rotation is None else (3 + rotation.width,)
        if len(at) not in widths:
            self.wrong(
                (*path, "range"),
                f"covers {len(at)} values; {mode} has {' or '.join(map(str, widths))}"
                + (" (a pose with an orientation needs rotation)" if widths == (3,) else ""),
            )
            return
        movers = self.model.movers(end.frame)
        if len(movers) < (6 if turning else 3):
            self.wrong(
                path,
                f"{mode} of {6 if turning else 3} degrees of freedom; the {len(movers)} joints"
                f" that move {end.frame} cannot follow it",
            )
            return
        if mode is ControlMode.CARTESIAN_DELTA:
            self.delta_scale(path, at, contract)
        self.claim(path, movers)
        kind: Kind = mode.value  # type: ignore[assignment]
        self.commands.append(Command(kind, at, movers, end.frame, frame, rotation))

    def delta_scale(self, path: Path, at: tuple[int, ...], contract: ActionContract) -> None:
        scale = contract.cartesian_delta_scale or self.robot.units.cartesian_delta_scale
        if scale is None or len(scale) < len(at):
            self.wrong(
                (*_PATH, "cartesian_delta_scale"),
                "is not stated, and a unit of the delta may be anything: give m and rad per unit"
                " (1 where the policy answers in m and rad) here or in hal.params.units",
            )
            return
        for index, factor in zip(at, scale, strict=False):
            self.scales[index] = Scale(factor)

    def gripper_command(
        self,
        path: Path,
        at: int,
        mode: ControlMode,
        ee: str,
        convention: GripperConvention | None,
    ) -> None:
        end = self.end(path, ee)
        if end is None:
            return
        joint = next((j for j in self.robot.joints if j.name == end.gripper), None)
        if joint is None:
            self.wrong((*path, "ee"), f"{ee} has no gripper that this robot moves")
            return
        self.gripper_value(path, at, joint, mode, convention)

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
            self.wrong(
                path,
                f"{mode} does not say which number is open: give gripper_convention here or in"
                " actuators_required, or in hal.params.units",
            )
            return
        self.claim(path, (joint.name,))
        if mode is ControlMode.GRIPPER_BINARY:
            scale = opening(convention)
            if scale is None:
                self.wrong(path, f"{convention} is no convention of a gripper that is on or off")
                return
            self.scales[at] = scale
            self.commands.append(Command("gripper_switch", (at,), (joint.name,)))
            return
        found = of_joint(joint, None, convention)
        if isinstance(found, str):
            self.wrong(path, found)
            return
        semantics = self.semantics(GRIPPER_MODES)
        delta = semantics is not None and semantics.mode == "delta"
        self.scales[at] = Scale(found.scale) if delta else found
        self.commands.append(
            Command("joint_delta" if delta else "joint_position", (at,), (joint.name,))
        )

    # -- the base
    def twist_slot(self, path: Path, at: tuple[int, ...], frame: str) -> None:
        places = {2: (0, 5), 3: (0, 1, 5), 6: (0, 1, 2, 3, 4, 5)}.get(len(at))
        if self.robot.base is None:
            self.wrong((*path, "control_mode"), f"{self.robot.name} has no base to drive")
        elif frame != self.robot.base.frame:
            self.wrong(
                (*path, "frame"),
                f"{frame!r}: the base is driven in its own frame, {self.robot.base.frame!r}",
            )
        elif places is None:
            self.wrong(
                (*path, "range"),
                f"covers {len(at)} values; a twist has 2 (vx, wz), 3 (vx, vy, wz) or 6",
            )
        else:
            self.drive(path, at, list(places))

    def drive(self, path: Path, at: tuple[int, ...], places: list[int]) -> None:
        """Command the base: value `at[i]` is entry `places[i]` of the twist."""
        self.claim(path, ("the base",))
        order = sorted(range(len(at)), key=lambda i: places[i])
        names = tuple(TWIST[places[i]] for i in order)
        self.commands.append(Command("base_velocity", tuple(at[i] for i in order), names))


def stated_convention(manifest: RSkillManifest) -> GripperConvention | None:
    """Return how the manifest's gripper actuator counts, if it has one."""
    for actuator in manifest.actuators_required:
        if actuator.kind in GRIPPER_MODES:
            return actuator.control_mode_semantics.gripper_convention
    return None


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
        resolver.wrong((*_PATH, "slots"), "command nothing")
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
        tuple(resolver.notes),
    )
    return plan, resolver.findings
