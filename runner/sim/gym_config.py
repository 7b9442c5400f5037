"""Reading of a gymnasium environment's observations and actions (`--env-config FILE`).

A file says what the spaces do not. Nothing is guessed: without `joints` a world state has no
joints, without `success` (and without gymnasium's usual keys) there is no verdict.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from vram_arbiter.schemas.control import JOINT_MODES, ControlMode
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest.vocabulary import EmbodimentTag
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.yamltext import read_yaml, validated

RENDER: Final = "render"  # the camera that is the environment's own `render()`
SUCCESS_KEYS: Final = ("is_success", "success")  # of `info`, where nothing else is said
VECTOR_MODES: Final = (
    *sorted(JOINT_MODES),
    ControlMode.CARTESIAN_DELTA,
    ControlMode.CARTESIAN_TWIST,
    ControlMode.DEX_HAND_JOINT,
)

Index = Annotated[int, Field(ge=0)]
type Held = int | float | tuple[Held, ...] | dict[str, Held]


class GymConfig(BaseModel):
    """Paths into a Dict or Tuple observation are written with dots (`pixels.top`, `views.0`).

    An empty path is the whole observation. `joints` and `velocities` name entries of the vector at
    `state`: a list in its order, or a map from name to index (rad and rad/s). Where several parts
    are at `state`, their numbers follow each other in the space's order. `actions` names the
    numbers of an action, in their order (`runner.sim.gym_spaces`); `control_mode` gives their
    meaning. `hold` is the action that waits, as the environment itself takes it: without one the
    world stands still until an action comes. `success` is `info:KEY` or `return:NUMBER` (rewards of
    the episode, summed). `instruction` is the task in words: policies are told it, and recordings
    have it as the task of their episodes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kwargs: JsonObject = {}
    state: str = ""
    joints: dict[str, Index] = {}
    velocities: dict[str, Index] = {}
    cameras: dict[str, str] = {}
    control_mode: ControlMode = ControlMode.JOINT_POSITION
    actions: tuple[str, ...] = ()
    embodiment_tags: tuple[
        EmbodimentTag, ...
    ] = ()  # which robot it is; skills for others are refused then
    hold: Held | None = None
    success: str = ""
    instruction: str = ""

    @field_validator("joints", "velocities", mode="before")
    @classmethod
    def _in_order(cls, value: object) -> object:
        if isinstance(value, list):
            if len(set(value)) != len(value):
                raise ValueError("names must be unique")
            return {name: index for index, name in enumerate(value)}
        return value

    @field_validator("control_mode")
    @classmethod
    def _vector(cls, mode: ControlMode) -> ControlMode:
        if mode not in VECTOR_MODES:
            raise ValueError(f"an action of several numbers is one of {', '.join(VECTOR_MODES)}")
        return mode

    @field_validator("success")
    @classmethod
    def _rule(cls, rule: str) -> str:
        kind, _, rest = rule.partition(":")
        if rule and not (kind == "info" and rest) and not (kind == "return" and _is_number(rest)):
            raise ValueError("give info:KEY or return:NUMBER")
        return rule

    @model_validator(mode="after")
    def _check(self) -> GymConfig:
        if unknown := sorted(set(self.velocities) - set(self.joints)):
            raise ValueError(f"velocities of {', '.join(unknown)}, which are no joints")
        if self.velocities and len(self.velocities) != len(self.joints):
            raise ValueError("give the velocities of all joints, or of none")
        if len(set(self.actions)) != len(self.actions):
            raise ValueError("names of actions must be unique")
        return self

    @classmethod
    def load(cls, path: Path) -> GymConfig:
        """Read the file. Raises ConfigError with the file's name, line and field."""
        return validated(cls, read_yaml(path))

    def with_success(self, rule: str) -> GymConfig:
        """Return a copy with this rule of success. Raises ConfigError for an invalid one."""
        try:
            return GymConfig.model_validate({**self.model_dump(), "success": rule})
        except ValidationError as error:
            raise ConfigError(
                f"--success {rule}: {error.errors()[0]['msg']}", hint="info:KEY or return:NUMBER"
            ) from error


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
