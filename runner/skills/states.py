"""From the robot's state to a policy's state vector, as the manifest's contract says.

`plan_state` resolves the contract against the robot once, with a finding for everything that the
robot cannot tell. A vector is complete and fresh, or a typed error: nothing is filled in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.units import Scale
from vram_arbiter.runner.skills.action_contract import no_frame, scale_of
from vram_arbiter.runner.skills.kinematics import ArmModel, Pose3
from vram_arbiter.runner.skills.rotations import matrix_of, numbers
from vram_arbiter.runner.skills.units import SAME
from vram_arbiter.schemas.errors import StateStale
from vram_arbiter.schemas.findings import Path, Problem
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.io_contracts import StateBindings, StateContract
from vram_arbiter.schemas.manifest.vocabulary import JOINT_SPACE_LAYOUTS, Rotation
from vram_arbiter.schemas.world import WorldState

Kind = Literal[
    "joint_positions", "joint_velocities", "fingers", "ee_pose", "base_pose", "base_twist"
]
_PATH = ("state_contract",)
BASE_POSE, BASE_TWIST, JOINT_STATE = "base_pose", "base_twist", "joint_state"


@dataclass(frozen=True, slots=True)
class Part:
    """One stretch of the vector. The pose of the frame `ee` is given in `frame`."""

    kind: Kind
    path: Path
    joints: tuple[str, ...] = ()
    scales: tuple[Scale, ...] = ()
    ee: str = ""
    frame: str = ""
    rotation: Rotation | None = None

    @property
    def width(self) -> int:
        match self.kind:
            case "joint_positions" | "joint_velocities":
                return len(self.joints)
            case "fingers":
                return 2
            case "base_twist":
                return 3
        return 3 + (self.rotation.width if self.rotation is not None else 0)


@dataclass(frozen=True, slots=True)
class StatePlan:
    """A contract resolved for one robot. `joints` are those that it reads."""

    parts: tuple[Part, ...]
    base_frame: str
    world_frame: str

    @property
    def width(self) -> int:
        return sum(part.width for part in self.parts)

    def vector(
        self, world: WorldState, measured: Mapping[str, float], model: ArmModel | None
    ) -> list[float]:
        """Return the values. `measured` are the joints' positions (rad).

        Raises StateStale for a part that the world state lacks or marks as stale.
        """
        found: list[float] = []
        for part in self.parts:
            match part.kind:
                case "joint_positions":
                    found += [
                        scale.of(measured[name])
                        for name, scale in zip(part.joints, part.scales, strict=True)
                    ]
                case "fingers":
                    values = [measured[name] for name in part.joints]
                    found += [values[0], -values[0]] if len(values) == 1 else values
                case "joint_velocities":
                    speeds = _speeds(world, part.joints)
                    found += [
                        speed / scale.scale
                        for speed, scale in zip(speeds, part.scales, strict=True)
                    ]
                case "base_twist":
                    twist = _given(world, BASE_TWIST)
                    found += [twist[0], twist[1], twist[5]]
                case "base_pose":
                    found += _written(_base(world, self.world_frame), part.rotation)
                case "ee_pose":
                    found += _written(self._tool(world, measured, model, part), part.rotation)
        return found

    def _tool(
        self,
        world: WorldState,
        measured: Mapping[str, float],
        model: ArmModel | None,
        part: Part,
    ) -> Pose3:
        if model is None:
            raise StateStale(f"the pose of {part.ee} needs a model of the arm")
        if part.frame == self.world_frame != "":
            base = _base(world, self.world_frame)
            return base.then(model.pose(part.ee, measured, within=self.base_frame))
        return model.pose(part.ee, measured, within=part.frame)


# -- reading the world
def _given(world: WorldState, name: str) -> Any:
    value = getattr(world, name)
    if value is None or name in world.stale:
        raise StateStale(
            f"the {name.replace('_', ' ')} is {'missing' if value is None else 'stale'}",
            hint="nothing moves on a state that is not known",
        )
    return value


def _base(world: WorldState, frame: str) -> Pose3:
    import numpy as np

    pose = _given(world, BASE_POSE)
    if pose.frame_id != frame:
        raise StateStale(f"the base pose is given in {pose.frame_id!r}, not in {frame!r}")
    return Pose3(np.array(pose.xyz), matrix_of(pose.quat_xyzw, Rotation.QUAT_XYZW))


def _speeds(world: WorldState, names: tuple[str, ...]) -> list[float]:
    state = world.joint_state
    if JOINT_STATE in world.stale:
        raise StateStale("the joint state is stale", hint="nothing moves on an old state")
    known = dict(zip(state.name, state.velocity, strict=False))
    if missing := [name for name in names if name not in known]:
        raise StateStale(f"the robot tells no speed of {', '.join(missing)}")
    return [known[name] for name in names]


def _written(pose: Pose3, rotation: Rotation | None) -> list[float]:
    values = [float(value) for value in pose.xyz]
    return values + list(numbers(pose.matrix, rotation) if rotation is not None else ())


# -- resolving
def needs_frames(contract: StateContract | None) -> bool:
    """Return whether a state contract speaks of frames."""
    return _has(contract, "ee_pose")


def reads_poses(contract: StateContract | None) -> bool:
    """Return whether a state contract has a pose, of a frame or of the base."""
    return _has(contract, "ee_pose", BASE_POSE)


def _has(contract: StateContract | None, *kinds: str) -> bool:
    if contract is None:
        return False
    if contract.parts is not None:
        return any(part.kind in kinds for part in contract.parts)
    return contract.layout in LAYOUTS


def plan_state(
    manifest: RSkillManifest,
    robot: RobotDescription,
    joints: tuple[str, ...],
    model: ArmModel | None,
) -> tuple[StatePlan, list[Problem]]:
    """Return the plan, and a finding for each part that this robot cannot tell.

    `joints` is the order of joints where the manifest gives none; `model` is needed for frames. A
    plan with findings must not be used.
    """
    contract = manifest.state_contract or StateContract()
    findings: list[Problem] = []
    parts: list[Part] = []
    if contract.parts is not None:
        for index, said in enumerate(contract.parts):
            parts.append(
                Part(
                    said.kind,
                    (*_PATH, "parts", index),
                    said.joints or (joints if said.kind.startswith("joint_") else ()),
                    ee=said.ee or "",
                    frame=said.frame or "",
                    rotation=said.rotation,
                )
            )
    elif contract.layout in LAYOUTS and contract.bindings is not None:
        parts += _layout(contract.layout, contract.bindings)
    elif contract.layout is None or contract.layout in JOINT_SPACE_LAYOUTS:
        parts.append(Part("joint_positions", _PATH, joints))
    else:
        findings.append(
            Problem(
                (*_PATH, "layout"),
                f"{contract.layout!r} is unknown here; say what is in it with parts",
            )
        )
    resolved = [_resolve(part, manifest, robot, model, findings) for part in parts]
    base = robot.base
    plan = StatePlan(tuple(resolved), base.frame if base else "", base.world_frame if base else "")
    if contract.dim is not None and not findings and contract.dim != plan.width:
        findings.append(
            Problem(
                (*_PATH, "dim"), f"is {contract.dim}; this robot's state has {plan.width} values"
            )
        )
    return plan, findings


def _layout(name: str, bindings: StateBindings) -> list[Part]:
    """Return the parts of a named task-space layout."""
    path = (*_PATH, "bindings")
    quaternion = (
        Rotation.QUAT_WXYZ if bindings.quaternion_convention == "wxyz" else Rotation.QUAT_XYZW
    )
    world = bindings.world_frame or ""
    fingers = Part("fingers", (*path, "gripper_qpos_joints"), bindings.gripper_qpos_joints)
    base = Part("base_pose", path, frame=world, rotation=quaternion)
    tool = Part(
        "ee_pose",
        path,
        ee=bindings.eef_frame or "",
        frame=bindings.base_frame or "",
        rotation=quaternion,
    )
    in_world = Part(
        "ee_pose",
        path,
        ee=bindings.eef_frame or "",
        frame=world,
        rotation=Rotation.AXIS_ANGLE,
    )
    known = {"tool": tool, "base": base, "fingers": fingers, "tool in world": in_world}
    return [known[part] for part in LAYOUTS[name]]


LAYOUTS: dict[str, tuple[str, ...]] = {
    "human300_16d": ("tool", "base", "fingers"),
    "rc365": ("tool", "fingers", "base"),
    "libero_eef8d": ("tool in world", "fingers"),
}
"""Task-space layouts in the order of the checkpoint: poses with a quaternion, in `libero_eef8d`
with axis times angle; one gripper joint stands for two fingers, as [v, -v]."""


def _resolve(
    part: Part,
    manifest: RSkillManifest,
    robot: RobotDescription,
    model: ArmModel | None,
    findings: list[Problem],
) -> Part:
    """Return the part with the units of its joints and its end effector's frame."""
    known = {joint.name: joint for joint in robot.joints}

    def wrong(message: str, field: str = "") -> None:
        findings.append(Problem((*part.path, field) if field else part.path, message))

    if unknown := [name for name in part.joints if name not in known]:
        wrong(f"reads {', '.join(unknown)}; the robot has {', '.join(known) or 'no joints'}")
        return part
    base = robot.base
    match part.kind:
        case "joint_positions" | "joint_velocities":
            try:
                scales = tuple(scale_of(known[name], manifest) for name in part.joints)
            except ValueError as error:
                wrong(str(error))
                scales = (SAME,) * len(part.joints)
            return replace(part, scales=scales)
        case "fingers":
            if len(part.joints) not in (1, 2):
                wrong(f"names {len(part.joints)} joints; a gripper has 1, or 2 fingers")
        case "base_pose" | "base_twist":
            if base is None:
                wrong(f"asks for the state of a base; {robot.name} has none")
            elif part.kind == "base_pose" and part.frame != base.world_frame:
                wrong(f"asks for the base in {part.frame!r}; it is known in {base.world_frame!r}")
            elif part.kind == "base_twist" and not base.tells_twist:
                wrong(f"{robot.name} does not tell how fast its base drives")
        case "ee_pose":
            if model is None:
                wrong(f"the pose of {part.ee} needs a model of {robot.name}; there is none")
                return part
            ends = {end.name: end.frame for end in robot.ends}
            end = part.ee if model.has(part.ee) else ends.get(part.ee, part.ee)
            if not model.has(end):
                wrong(no_frame(end, model))
            if not (model.has(part.frame) or (base and part.frame == base.world_frame)):
                wrong(no_frame(part.frame, model))
            elif base and part.frame == base.world_frame and not model.has(base.frame):
                wrong(no_frame(base.frame, model))
            return replace(part, ee=end)
    return part
