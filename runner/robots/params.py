"""`hal.params` of the adapters."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from vram_arbiter.runner.params import Params, mistakes
from vram_arbiter.runner.robots.lerobot_robot import Estop
from vram_arbiter.runner.robots.units import JointUnit
from vram_arbiter.schemas.findings import did_you_mean, dotted
from vram_arbiter.schemas.manifest.vocabulary import GripperConvention
from vram_arbiter.schemas.plain import JsonMap

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class TwinParams(Params):
    """`params` of the twins. Angles in rad by joint; joints left out start in the rest pose."""

    start_pose_rad: dict[str, Finite] = Field(default_factory=dict)


class JointParams(Params):
    """One joint of a lerobot robot, where lerobot does not describe it: unit, range, maximum
    speed.
    """

    unit: JointUnit | None = None
    lower_rad: Finite | None = None
    upper_rad: Finite | None = None
    max_speed_rad_s: Positive | None = None
    gripper: bool | None = None
    sign: Literal[1, -1] = 1
    offset_rad: Finite = 0.0

    @model_validator(mode="after")
    def _range(self) -> JointParams:
        if (
            self.lower_rad is not None
            and self.upper_rad is not None
            and self.lower_rad >= self.upper_rad
        ):
            raise ValueError("lower_rad must be below upper_rad")
        return self


class EndParams(Params):
    """An end effector: its frame in the model, and the joint that is its gripper."""

    frame: str
    gripper: str | None = None


class UnitParams(Params):
    """Units of skills made for this robot whose manifests do not state them."""

    cartesian_delta_scale: tuple[Positive, ...] | None = None
    gripper_convention: GripperConvention | None = None


class ModelParams(Params):
    """What manifests may speak of: the frames of an MJCF, and the robot's end effectors.

    `model` is a file, or the name of a shipped one; `frames` gives the model's frames other names.
    """

    model: str = ""
    ends: dict[str, EndParams] = Field(default_factory=dict)
    frames: dict[str, str] = Field(default_factory=dict)
    units: UnitParams = UnitParams()


class BaseParams(Params):
    """A base that drives on a plane, by three joints of the model: x, y and yaw."""

    max_speed_m_s: Positive
    max_turn_rad_s: Positive
    frame: str = "base_link"
    world_frame: str = "odom"
    joints: tuple[str, str, str] = ("base_x", "base_y", "base_yaw")


class ModelJointParams(Params):
    """A joint of a model, whose range may be narrowed. Of a slide all numbers are m."""

    max_speed_rad_s: Positive
    lower_rad: Finite | None = None
    upper_rad: Finite | None = None
    gripper: bool = False


class ModelTwinParams(ModelParams):
    """`params` of `mujoco`."""

    joints: Annotated[dict[str, ModelJointParams], Field(min_length=1)]
    base: BaseParams | None = None
    rest_pose_rad: dict[str, Finite] = Field(default_factory=dict)
    start_pose_rad: dict[str, Finite] = Field(default_factory=dict)


class LerobotParams(ModelParams):
    """`params` of `lerobot:TYPE`. `so101_follower` needs none of them."""

    joints: dict[str, JointParams] = Field(default_factory=dict)
    rest_pose_rad: dict[str, Finite] = Field(default_factory=dict)
    estop: Estop = "hold"


def check_joints(given: JsonMap, names: tuple[str, ...], field: str) -> None:
    """Raise ConfigError that names the keys of `given`, at `params.field`, without a joint."""
    unknown = [name for name in given if name not in names]
    if unknown:
        raise mistakes(
            (dotted(("params", field, name)), f"no such joint{did_you_mean(name, names)}")
            for name in unknown
        )
