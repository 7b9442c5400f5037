"""Limits of one robot, tightened by the deployment file's `safety` and the skill's `envelope`.

Pure. Envelopes are intersected: the smaller of two numbers, the intersection of two boxes, all
zones. None can widen what the robot itself allows. What an envelope asks for and this runner cannot
enforce is either refused (a workspace without kinematics) or listed in `unkept`, for the operator
to read before the robot moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Protocol, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.yamltext import Mistake, config_error

Vector3 = tuple[float, float, float]
EVERYWHERE: tuple[Vector3, Vector3] = (
    (-math.inf, -math.inf, -math.inf),
    (math.inf, math.inf, math.inf),
)

POSITIVE = (
    "max_ee_speed_m_s",
    "max_joint_speed_factor",
    "max_force_n",
    "max_torque_nm",
    "max_cartesian_step_m",
    "max_base_linear_speed_m_s",
    "max_base_angular_speed_rad_s",
)
"""Fields that the gate enforces; a NaN or a zero among them would disable a check or all motion."""
NEEDS_KINEMATICS = (
    "workspace_box_min_xyz",
    "workspace_box_max_xyz",
    "no_go_zones",
    "max_ee_speed_m_s",
    "max_cartesian_step_m",
)
OF_A_TOPIC = ("e_stop_topic", "e_stop_qos")  # reported once, below


class Kinematics(Protocol):
    """Positions of an arm's parts. Joints in rad by name, points in meters in the arm's base
    frame.
    """

    gripper_lever_m: float
    """From the gripper's axis to its pads: torque over this is the force at the pads."""

    def points(self, joints: Mapping[str, float]) -> Mapping[str, Vector3]:
        """Return the `tool` (between the fingers) and further points that must keep out of no-go
        zones.
        """
        ...


# -- zones
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Zone(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    name: str = ""


class BoxZone(_Zone):
    """A box along the axes of the arm's base frame, in meters."""

    min_xyz: tuple[Finite, Finite, Finite]
    max_xyz: tuple[Finite, Finite, Finite]

    @model_validator(mode="after")
    def _has_an_inside(self) -> Self:
        if any(low >= high for low, high in zip(self.min_xyz, self.max_xyz, strict=True)):
            raise ValueError("min_xyz must be below max_xyz on every axis: nothing is inside")
        return self

    def depth_m(self, point: Vector3) -> float:
        """Return how far inside a point is; negative or 0 outside."""
        sides = zip(point, self.min_xyz, self.max_xyz, strict=True)
        return min(min(value - low, high - value) for value, low, high in sides)


class BallZone(_Zone):
    """A ball in the arm's base frame, in meters."""

    center_xyz: tuple[Finite, Finite, Finite]
    radius_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]

    def depth_m(self, point: Vector3) -> float:
        return self.radius_m - math.dist(point, self.center_xyz)


Zone = BoxZone | BallZone
_ZONE: TypeAdapter[Zone] = TypeAdapter(Zone)


def outside_m(box: tuple[Vector3, Vector3], point: Vector3) -> float:
    """Return how far outside a box a point is; 0 inside."""
    sides = zip(point, *box, strict=True)
    return math.hypot(*(max(low - value, value - high, 0.0) for value, low, high in sides))


# -- limits
@dataclass(frozen=True, slots=True)
class Limits:
    """Limits in radians, meters, seconds, newtons. Infinite: no limit."""

    joints_rad: Mapping[str, tuple[float, float]]
    speeds_rad_s: Mapping[str, float]
    box: tuple[Vector3, Vector3] = EVERYWHERE
    zones: tuple[Zone, ...] = ()
    ee_speed_m_s: float = math.inf
    ee_step_m: float = math.inf
    torque_nm: float = math.inf
    force_n: float = math.inf
    base_speed_m_s: float = 0.0
    base_turn_rad_s: float = 0.0
    unkept: tuple[str, ...] = field(default=())


def own_limits(robot: RobotDescription) -> Limits:
    """Return what the robot itself allows."""
    return Limits(
        joints_rad={joint.name: (joint.lower_rad, joint.upper_rad) for joint in robot.joints},
        speeds_rad_s={joint.name: joint.max_speed_rad_s for joint in robot.joints},
        base_speed_m_s=robot.base.max_speed_m_s if robot.base is not None else 0.0,
        base_turn_rad_s=robot.base.max_turn_rad_s if robot.base is not None else 0.0,
    )


def tighten(
    limits: Limits,
    robot: RobotDescription,
    envelope: SafetyEnvelope,
    name: str,
    kinematics: Kinematics | None,
) -> Limits:
    """Return the intersection of `limits` and `envelope`.

    `name` names the envelope in errors: `safety`, `envelope of lerobot/grab`. Raises ConfigError
    for numbers that limit nothing, an empty workspace, an unreadable zone, and a workspace, zone or
    tool speed where the robot has no kinematics.
    """
    _refuse_what_is_wrong(limits, envelope, name, kinematics)
    box = _intersection(limits.box, envelope)
    factor = min(envelope.max_joint_speed_factor, 1.0)
    tightened = replace(
        limits,
        speeds_rad_s={
            joint.name: min(limits.speeds_rad_s[joint.name], joint.max_speed_rad_s * factor)
            for joint in robot.joints
        },
        torque_nm=min(limits.torque_nm, envelope.max_torque_nm),
        force_n=min(limits.force_n, envelope.max_force_n),
        base_speed_m_s=min(limits.base_speed_m_s, _or_inf(envelope.max_base_linear_speed_m_s)),
        base_turn_rad_s=min(limits.base_turn_rad_s, _or_inf(envelope.max_base_angular_speed_rad_s)),
        unkept=(*limits.unkept, *_unkept(envelope, name, robot, kinematics)),
    )
    if kinematics is None:
        return tightened
    return replace(
        tightened,
        box=box,
        zones=(*limits.zones, *(_ZONE.validate_python(zone) for zone in envelope.no_go_zones)),
        ee_speed_m_s=min(limits.ee_speed_m_s, envelope.max_ee_speed_m_s),
        ee_step_m=min(limits.ee_step_m, _or_inf(envelope.max_cartesian_step_m)),
    )


def _refuse_what_is_wrong(
    limits: Limits, envelope: SafetyEnvelope, name: str, kinematics: Kinematics | None
) -> None:
    problems = []
    for key in POSITIVE:
        value = getattr(envelope, key)
        if value is not None and not value > 0:  # NaN too
            problems.append(Mistake(0, f"{name}.{key}", f"must be above 0, not {value}"))
    low, high = _intersection(limits.box, envelope)
    for axis, least, most in zip("xyz", low, high, strict=True):
        if least > most:
            problems.append(
                Mistake(
                    0,
                    f"{name}.workspace_box_min_xyz",
                    f"the workspace is empty: {axis} {least} > {most}",
                )
            )
    for index, zone in enumerate(envelope.no_go_zones):
        try:
            _ZONE.validate_python(zone)
        except ValidationError as error:
            wrong = [item["msg"] for item in error.errors() if item["type"] == "value_error"]
            text = wrong[0] if wrong else "give min_xyz and max_xyz, or center_xyz and radius_m"
            problems.append(
                Mistake(0, f"{name}.no_go_zones[{index}]", text.removeprefix("Value error, "))
            )
    if kinematics is None:
        asked = [key for key in NEEDS_KINEMATICS if key in envelope.model_fields_set]
        problems += [
            Mistake(
                0,
                f"{name}.{key}",
                "this cannot be enforced: there are no kinematics of this robot"
                " (those of the SO-101 need MuJoCo)",
            )
            for key in asked
            if getattr(envelope, key)
        ]
    if problems:
        raise error_of(problems)


def error_of(problems: list[Mistake]) -> ConfigError:
    return config_error("safety", problems)


def _intersection(
    box: tuple[Vector3, Vector3], envelope: SafetyEnvelope
) -> tuple[Vector3, Vector3]:
    low = envelope.workspace_box_min_xyz or EVERYWHERE[0]
    high = envelope.workspace_box_max_xyz or EVERYWHERE[1]
    return _vector(map(max, box[0], low)), _vector(map(min, box[1], high))


def _or_inf(limit: float | None) -> float:
    return math.inf if limit is None else limit


def _vector(values: Iterable[float]) -> Vector3:
    x, y, z = values
    return x, y, z


def _unkept(
    envelope: SafetyEnvelope, name: str, robot: RobotDescription, kinematics: Kinematics | None
) -> Sequence[str]:
    """Return the given fields that this gate does not enforce."""
    kept = {*POSITIVE, *NEEDS_KINEMATICS, *OF_A_TOPIC}
    found = [
        f"{name}.{key}"
        for key in SafetyEnvelope.model_fields
        if key in envelope.model_fields_set and key not in kept and getattr(envelope, key)
    ]
    if kinematics is None:
        found.append(f"{name}.max_ee_speed_m_s (no kinematics of this robot)")
    without = (
        ("max_torque_nm", robot.tells_efforts, "this robot does not tell efforts"),
        ("max_force_n", robot.tells_efforts, "this robot does not tell efforts"),
        ("max_force_n", kinematics is not None, "no kinematics of this robot"),
        ("e_stop_topic", False, "no topic is listened to: `vram-runner estop` stops the robot"),
    )
    reasons: dict[str, str] = {}
    for key, there, why in without:
        if not there and key in envelope.model_fields_set:
            reasons.setdefault(key, why)
    found += [f"{name}.{key} ({why})" for key, why in reasons.items()]
    return found
