"""A small environment of lerobot for tests: a point that is driven to a mark, known by a plugin."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig


class Point(gymnasium.Env[Any, Any]):
    """Two joints take their targets at once; success is both within 0.05 of the mark."""

    # gymnasium reads it from the class
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    task = task_description = "go there"

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        joints = spaces.Box(-2.0, 2.0, (2,), np.float64)
        self.observation_space = spaces.Dict({"agent_pos": joints, "environment_state": joints})

    def _look(self) -> dict[str, Any]:
        return {"agent_pos": self.at, "environment_state": self.mark}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at, self.mark = np.zeros(2), self.np_random.uniform(-0.9, 0.9, 2)
        return self._look(), {"is_success": False}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at = np.asarray(action, float)
        gap = float(np.abs(self.at - self.mark).max())
        return self._look(), -gap, gap < 0.05, False, {"is_success": gap < 0.05}

    def render(self) -> Any:
        return np.full((32, 32, 3), 100, np.uint8)


gymnasium.register("gym_point/Point-v0", Point, max_episode_steps=5)


@EnvConfig.register_subclass("point")
@dataclass
class PointEnv(EnvConfig):
    task: str | None = "Point-v0"
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (2,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (2,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "action": "action",
            "agent_pos": "observation.state",
            "environment_state": "observation.environment_state",
        }
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"render_mode": "rgb_array"}
