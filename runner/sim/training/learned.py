"""A learned grab policy in this process, for evaluation and for data sets that the policy drives.

Loads a checkpoint through lerobot's own factory, as the sidecar does. The robot's programs never
use it: they talk to the policy sidecar. Must not know leases, goals or sockets.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.runner.sim.env import SimEnv

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

# registers the demo's policy type; loaded by name, as any lerobot plug-in
OWN_POLICIES = "vram_arbiter.sidecars.models.compact_act"


class LoadedPolicy:
    """A checkpoint with its processors; predicts joint targets from the env's cameras and
    joints.
    """

    def __init__(
        self, folder: Path, plugin: str | None = OWN_POLICIES, execute: int | None = None
    ) -> None:
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        if plugin:
            importlib.import_module(plugin)
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        self._policy = get_policy_class(config.type).from_pretrained(
            folder, config=config, strict=True
        )
        self._before, self._after = make_pre_post_processors(config, pretrained_path=str(folder))
        self._cameras = [key.rsplit(".", 1)[1] for key in config.image_features]
        self.execute = execute or config.n_action_steps

    def reset(self) -> None:
        """Forget the last episode."""
        self._policy.reset()

    def chunk(
        self, env: SimEnv, images: Mapping[str, NDArray[Any]] | None = None
    ) -> list[list[float]]:
        """Return the next joint targets (rad); `images` (RGB by camera) saves rendering them
        again.
        """
        import torch

        observation: dict[str, Tensor] = {
            f"observation.images.{camera}": torch.from_numpy(env.render(camera))
            .permute(2, 0, 1)
            .float()
            / 255
            for camera in self._cameras
        }
        observation["observation.state"] = torch.tensor(list(env.joint_state().values()))
        with torch.inference_mode():
            actions = self._policy.predict_action_chunk(self._before(observation))
            targets = self._after(actions)
        rows: list[list[float]] = targets[0, : self.execute].tolist()
        return rows
