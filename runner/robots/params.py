"""`hal.params` of the adapters: their fields, and how a mistake in them is told.

Every mistake is a ConfigError that names the field.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vram_arbiter.runner.robots.lerobot_robot import Estop
from vram_arbiter.runner.robots.units import JointUnit
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import Path, did_you_mean, dotted, problems_of
from vram_arbiter.schemas.manifest.vocabulary import GripperConvention
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.yamltext import Mistake, config_error

SOURCE = "deployment"  # of mistakes, until the deployment file gives them its name and lines
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Params(BaseModel):
    """Base of all: an unknown field is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class TwinParams(Params):
    """`params` of the twins. Angles in rad by joint; joints left out start in the rest pose."""

    start_pose_rad: dict[str, Finite] = {}


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
    ends: dict[str, EndParams] = {}
    frames: dict[str, str] = {}
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
    rest_pose_rad: dict[str, Finite] = {}
    start_pose_rad: dict[str, Finite] = {}


class LerobotParams(ModelParams):
    """`params` of `lerobot:TYPE`. `so101_follower` needs none of them."""

    joints: dict[str, JointParams] = {}
    rest_pose_rad: dict[str, Finite] = {}
    estop: Estop = "hold"


def wrong(path: Path, problem: str, section: str = "hal") -> ConfigError:
    """Return one mistake below a section of the file."""
    return config_error(SOURCE, [Mistake(0, dotted((section, *path)), problem)])


def read_params[T: Params](kind: type[T], config: HalConfig) -> T:
    """Return `hal.params`. Raises ConfigError with every mistake."""
    try:
        return kind.model_validate(config.params)
    except ValidationError as error:
        problems = [
            Mistake(0, f"hal.params.{found.field}", found.message)
            for found in problems_of(error, kind, config.params)
        ]
        raise config_error(SOURCE, problems) from error


def check_joints(given: JsonMap, names: tuple[str, ...], path: Path) -> None:
    """Raise ConfigError for each key of `given`, at `path`, that is no joint."""
    problems = [
        Mistake(
            0, dotted(("hal", "params", *path, name)), f"no such joint{did_you_mean(name, names)}"
        )
        for name in given
        if name not in names
    ]
    if problems:
        raise config_error(SOURCE, problems)
