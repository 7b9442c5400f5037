"""Benchmarks of the field by name (`--env pusht`): the environment, and how it is to be read.

An entry says what an environment's own spaces leave open: camera and number names as lerobot's
policies know them, length of an episode, control rate and task text, all as in lerobot's own
configurations. The packages are the operator's to install; nothing of them is imported before the
world is made.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from vram_arbiter.runner.sim.gym_config import GymConfig
from vram_arbiter.schemas.errors import ConfigError

_ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
_BOTH_ARMS = [f"{side}_{joint}" for side in ("left", "right") for joint in _ARM]
_PUSHT = GymConfig.model_validate(
    {
        "kwargs": {
            "obs_type": "pixels_agent_pos",
            "observation_width": 96,
            "observation_height": 96,
            "visualization_width": 384,
            "visualization_height": 384,
            "max_episode_steps": 300,
        },
        "state": "agent_pos",
        "joints": ["x", "y"],  # of the pusher, in the environment's own pixels
        "actions": ["x", "y"],
        "cameras": {"image": "pixels"},
        "success": "info:is_success",
    }
)
_ALOHA = GymConfig.model_validate(
    {
        "kwargs": {
            "obs_type": "pixels_agent_pos",
            "max_episode_steps": 400,  # gym-aloha itself ends an episode after 300
        },
        "state": "agent_pos",
        "joints": _BOTH_ARMS,
        "actions": _BOTH_ARMS,
        "cameras": {"top": "pixels.top"},
        "success": "info:is_success",
        "embodiment_tags": ["aloha"],
    }
)


@dataclass(frozen=True, slots=True)
class Preset:
    """One benchmark: what `gymnasium.make` is asked for, and what the package is called."""

    env_id: str
    package: str
    module: str
    config: GymConfig
    max_steps: int
    control_hz: float
    instruction: str


PRESETS: Final[Mapping[str, Preset]] = {
    "pusht": Preset(
        "gym_pusht:gym_pusht/PushT-v0",
        "gym-pusht",
        "gym_pusht",
        _PUSHT,
        300,
        10.0,
        "push the T-shaped block onto the T-shaped target",
    ),
    "aloha-insertion": Preset(
        "gym_aloha:gym_aloha/AlohaInsertion-v0",
        "gym-aloha",
        "gym_aloha",
        _ALOHA,
        400,
        50.0,
        "insert the peg into the socket",
    ),
    "aloha-transfer-cube": Preset(
        "gym_aloha:gym_aloha/AlohaTransferCube-v0",
        "gym-aloha",
        "gym_aloha",
        _ALOHA,
        400,
        50.0,
        "pick up the cube with the right arm and transfer it to the left arm",
    ),
}

LIBERO: Final = "libero"


def preset_of(name: str) -> Preset | None:
    """Return the benchmark of this name; None for a name that is none.

    Raises ConfigError for one whose package is not installed, or that is not played here.
    """
    if name.startswith(LIBERO):
        raise ConfigError(
            f"--env {name}: LIBERO (package hf-libero) is not played here: its policies"
            " move an end effector by 7 numbers from a state of 8, and a world here has the same"
            " names for both",
            hint="run `lerobot-eval --env.type=libero` under `vramctl run`, in an environment with"
            " `pip install 'lerobot[libero]'`",
        )
    preset = PRESETS.get(name)
    if preset is not None and importlib.util.find_spec(preset.module) is None:
        raise ConfigError(
            f"--env {name} needs the package {preset.package}, which is not installed",
            hint=f"pip install {preset.package}",
        )
    return preset
