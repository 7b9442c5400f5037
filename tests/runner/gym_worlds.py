"""Small gymnasium environments of the tests: a point that is driven to a mark, with named joints, a camera and a word on success."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class Point(gymnasium.Env[Any, Any]):
    """Two joints take their targets at once; success is both within 0.05 of the mark, and ends the episode. The mark follows from the seed."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 — gymnasium's own way

    def __init__(
        self, render_mode: str | None = None, fails_at: int = -1, told: bool = True, mark: Any = None
    ) -> None:
        self.render_mode = render_mode
        self.fails_at, self.told, self.given = fails_at, told, mark
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-2.0, 2.0, (4,), np.float64),
                "pixels": spaces.Dict({"top": spaces.Box(0, 255, (24, 33, 3), np.uint8)}),
            }
        )
        self.resets: list[int | None] = []
        self.taken: list[Any] = []

    def _look(self) -> dict[str, Any]:
        picture = np.zeros((24, 33, 3), np.uint8)
        row, column = ((self.at + 1) * 11).astype(int)
        picture[row, column] = 255
        return {"agent_pos": np.concatenate([self.at, self.mark]), "pixels": {"top": picture}}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.resets.append(seed)
        self.at, self.mark = np.zeros(2), self.np_random.uniform(-0.9, 0.9, 2)
        if self.given is not None:
            self.mark = np.asarray(self.given, float)
        self.steps = 0
        return self._look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.steps == self.fails_at:
            raise ZeroDivisionError("the physics blew up")
        self.taken.append(action)
        self.steps += 1
        self.at = np.asarray(action, float)
        gap = float(np.abs(self.at - self.mark).max())
        return self._look(), -gap, gap < 0.05, False, {"is_success": gap < 0.05} if self.told else {}

    def render(self) -> Any:
        return self._look()["pixels"]["top"]


gymnasium.register("test/Point-v0", Point, max_episode_steps=20)
