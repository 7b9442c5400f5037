"""Description of a tabletop scene: sizes, vocabulary, camera places. Data only.

Lengths in meters, angles in radians unless the name says otherwise. Must not know the simulator,
the policies or the arbiter: training scripts, tests and the runner read it alike.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from vram_arbiter.schemas.yamltext import read_yaml, validated

ARM_JOINTS: Final = (
    "shoulder_pan",
    "shoulder_lift",
    "elbow_flex",
    "wrist_flex",
    "wrist_roll",
    "gripper",
)
BASE_JOINTS: Final = ("base_x", "base_y", "base_yaw")
CONTROL_HZ: Final = 30.0
CONTROL_DT_S: Final = 1.0 / CONTROL_HZ
WHOLE: Final = 1e-6  # steps in a control period; what a decimal fraction in a file is off

COLOURS: Final[dict[str, tuple[float, float, float]]] = {
    "red": (0.82, 0.07, 0.07),
    "green": (0.08, 0.58, 0.14),
    "blue": (0.08, 0.20, 0.82),
    "yellow": (0.93, 0.82, 0.08),
    "purple": (0.50, 0.10, 0.62),
    "orange": (0.96, 0.42, 0.03),
}
SHAPES: Final = ("cube", "ball", "cylinder")

# Folded pose in which the arm drives, looks and starts: gripper open, pointing down, clear of table
# and objects.
REST_POSE: Final = (0.0, -1.20, 1.05, 1.35, 0.0, 0.60)


class CameraSpec(BaseModel):
    """A camera: image size in pixels, vertical field of view in degrees, place and aim.

    Place and aim are in its parent's frame; `parent` is `base` (mobile base), `gripper` (the arm's
    last link) or `world`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    parent: Literal["base", "gripper", "world"]
    width_px: int = Field(ge=16, le=1920)
    height_px: int = Field(ge=16, le=1080)
    fovy_deg: float = Field(gt=1.0, lt=150.0)
    pos_m: tuple[float, float, float]
    look_at_m: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    shadows: bool = False
    # multisampling triples a frame's cost in software; small views are averaged down afterwards
    samples: int = Field(default=0, ge=0, le=8)


class SceneConfig(BaseModel):
    """Everything a seed does not decide."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    table_top_z_m: float = 0.20
    table_edge_x_m: float = 0.62
    table_depth_m: float = 0.45
    table_width_m: float = 1.30
    furniture: Literal["table", "counter"] = "table"
    mount_in_base_m: tuple[float, float, float] = (0.08, 0.0, 0.20)
    base_half_size_m: tuple[float, float] = (0.15, 0.14)
    base_front_of_mount_m: float = 0.05
    grasp_spot_in_base_m: tuple[float, float] = (0.325, 0.0)
    object_count: int = Field(default=4, ge=1, le=8)
    object_spacing_m: float = 0.10
    zone_from_edge_m: tuple[float, float] = (0.050, 0.125)
    zone_half_width_m: float = 0.24
    start_x_m: tuple[float, float] = (-0.03, 0.03)
    start_y_m: float = 0.05
    start_yaw_rad: float = 0.06
    timestep_s: float = Field(default=1.0 / 480.0, gt=0.0, le=CONTROL_DT_S)
    cameras: dict[str, CameraSpec] = Field(
        default_factory=lambda: {
            "front": CameraSpec(
                parent="base",
                width_px=480,
                height_px=360,
                fovy_deg=43.0,
                pos_m=(-0.08, 0.20, 0.60),
                look_at_m=(0.467, 0.053, 0.20),
            ),
            "wrist": CameraSpec(
                parent="gripper",
                width_px=320,
                height_px=240,
                fovy_deg=62.0,
                pos_m=(0.015, -0.085, -0.030),
                look_at_m=(0.018, 0.0, -0.100),
                up=(1.0, 0.0, 0.0),
            ),
            "overview": CameraSpec(
                parent="world",
                width_px=640,
                height_px=480,
                fovy_deg=42.0,
                pos_m=(1.00, -1.10, 0.85),
                look_at_m=(0.42, 0.0, 0.20),
                # without multisampling: together they cost a tick's slot on a CPU renderer
                shadows=True,
            ),
        }
    )

    @field_validator("timestep_s")
    @classmethod
    def _divides(cls, timestep_s: float) -> float:
        steps = CONTROL_DT_S / timestep_s
        if abs(steps - round(steps)) > WHOLE:
            raise ValueError(f"1/{CONTROL_HZ:g} s must be a whole number of steps, not {steps:.4g}")
        return timestep_s

    @classmethod
    def load(cls, path: Path | None = None) -> SceneConfig:
        """Read the scene of a YAML file (keys as the fields), or return the built-in one.

        Raises ConfigError with the file's name, line and field.
        """
        return cls() if path is None else validated(cls, read_yaml(path))


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectSpec:
    """One thing on the table. `size_m` is the cube's side, or the diameter of a ball or
    cylinder.
    """

    colour: str
    shape: str
    size_m: float
    height_m: float
    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def name(self) -> str:
        """What a person would call it, e.g. `red cube`."""
        return f"{self.colour} {self.shape}"

    @property
    def rest_z_m(self) -> float:
        """Height of the centre above the surface it stands on."""
        return self.height_m / 2.0


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle in (-pi, pi]."""
    return math.atan2(math.sin(angle_rad), math.cos(angle_rad))
