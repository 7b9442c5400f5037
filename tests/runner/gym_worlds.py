"""Small gymnasium environments of the tests: a point that is driven to a mark, with named joints, a
camera and a word on success; and a hand, whose actions and observations are of all kinds.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class Point(gymnasium.Env[Any, Any]):
    """Two joints take their targets at once; success is both within 0.05 of the mark, and ends the
    episode. The mark follows from the seed.
    """

    # gymnasium reads it from the class
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        fails_at: int = -1,
        told: bool = True,
        mark: Any = None,
        width: int = 33,
    ) -> None:
        self.render_mode = render_mode
        self.fails_at, self.told, self.given = fails_at, told, mark
        self.width = width
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-2.0, 2.0, (4,), np.float64),
                "pixels": spaces.Dict({"top": spaces.Box(0, 255, (24, width, 3), np.uint8)}),
            }
        )
        self.resets: list[int | None] = []
        self.taken: list[Any] = []

    def _look(self) -> dict[str, Any]:
        picture = np.zeros((24, self.width, 3), np.uint8)
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
        return (
            self._look(),
            -gap,
            gap < 0.05,
            False,
            {"is_success": gap < 0.05} if self.told else {},
        )

    def render(self) -> Any:
        return self._look()["pixels"]["top"]


gymnasium.register("test/Point-v0", Point, max_episode_steps=20)


class Hand(gymnasium.Env[Any, Any]):
    """An arm of two numbers, a gripper of three positions, two lamps, and a gait and a gear.

    Success is the arm within 0.3 of the target and the gripper closed (1). It tells what it was
    given in the next observation.
    """

    # gymnasium reads it from the class
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.action_space = spaces.Dict(
            {
                "arm": spaces.Box(-1.0, 1.0, (2,), np.float32),
                "gripper": spaces.Discrete(3, start=-1),
                "lamps": spaces.MultiBinary(2),
                "walk": spaces.Tuple((spaces.MultiDiscrete([2, 4]), spaces.Discrete(2))),
            }
        )
        self.observation_space = spaces.Dict(
            {
                "arm": spaces.Box(-np.inf, np.inf, (2,), np.float64),
                "gripper": spaces.Discrete(3, start=-1),
                "heat": spaces.Box(0, 255, (4, 4), np.uint8),
                "order": spaces.Text(20),
                "views": spaces.Tuple(
                    (spaces.Box(0, 255, (16, 16, 3), np.uint8), spaces.MultiBinary(2))
                ),
            }
        )
        self.taken: list[Any] = []

    def _look(self) -> dict[str, Any]:
        last = self.taken[-1]
        view = np.full((16, 16, 3), 20 * len(self.taken), np.uint8)
        return {
            "arm": self.target - last["arm"].astype(float),
            "gripper": last["gripper"],
            "heat": np.zeros((4, 4), np.uint8),
            "order": "close",
            "views": (view, last["lamps"]),
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.target = self.np_random.uniform(-1, 1, 2)
        self.taken = [{"arm": np.zeros(2, np.float32), "gripper": 0, "lamps": np.zeros(2, np.int8)}]
        return self._look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.taken.append(action)
        gap = float(np.abs(self.target - action["arm"]).max())
        success = gap < 0.3 and action["gripper"] == 1
        return self._look(), -gap, success, False, {"is_success": success}

    def render(self) -> Any:
        return np.full((20, 24, 3), 10 * len(self.taken), np.uint8)


gymnasium.register("test/Hand-v0", Hand, max_episode_steps=6)
