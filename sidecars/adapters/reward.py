"""Reward models through lerobot's classes and processors.

Pictures of a robot at work and its task in, progress and success out.
"""

import importlib
import math
from typing import Any, Literal

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import ScoreOp
from vram_arbiter.sidecars.adapters.base import LEROBOT, ModelCall, OneNetwork
from vram_arbiter.sidecars.checkpoints import load_lerobot
from vram_arbiter.sidecars.images import decode_all, of_one_size
from vram_arbiter.sidecars.quantization import check_weights, nf4_of, quantize_linear
from vram_arbiter.sidecars.weights import Weights, read_config, reason

# own reward types, by lerobot's naming convention
_OWN_MODELS = ("vram_arbiter.sidecars.models.compact_progress",)
BYTES_A_PIXEL = 3


class RewardAdapter(OneNetwork):
    """The op `score`.

    A model that judges every picture (`score(batch)`: progress and success, each (B, T)) answers a
    value a picture; any other reward model of lerobot's answers one, that of the newest picture,
    and no success. Input: (1, T, 3, H, W) floats in 0..1 under the checkpoint's own picture key,
    and `task`. Progress comes out in 0..1, whatever the range of the manifest's model.
    """

    kind: Literal["reward"] = "reward"
    ops = frozenset({"score"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        assert manifest.reward is not None, "the kind requires the block"
        self._manifest = manifest
        self._contract = manifest.reward
        self._weights = weights
        self._config: Any = None
        self._model_class: Any = None
        self._before: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        return ("torch", LEROBOT, "lerobot.rewards.factory", *_OWN_MODELS)

    def prepare(self) -> None:
        from lerobot.configs.rewards import RewardModelConfig
        from lerobot.rewards.factory import get_reward_model_class

        for package in _OWN_MODELS:
            importlib.import_module(package)  # registers itself
        self._config = read_config(RewardModelConfig, self._weights)
        self._model_class = get_reward_model_class(self._config.type)

    def load(self, device: str) -> None:
        self._config.device = device
        self._config.pretrained_path = self._weights.source
        nf4 = nf4_of(self._manifest)
        self._model = load_lerobot(self._model_class, self._weights, self._config, nf4)
        check_weights(self._model, self._manifest)
        quantize_linear(self._model, self._manifest, device)
        self._make_processor()

    def place(self, device: str) -> None:
        self._config.device = device
        super().place(device)
        self._make_processor()

    def _make_processor(self) -> None:
        from lerobot.rewards.factory import make_reward_pre_post_processors

        try:
            self._before, _ = make_reward_pre_post_processors(self._config)
        except (ValueError, ImportError, OSError) as error:
            raise ModelError(
                f"{self._weights.source}: no processors for {self._config.type}: "
                f"{reason(error.__cause__ or error)}",
                hint="install the packages that this reward model needs",
            ) from error

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, ScoreOp)
        if self._contract.instruction_required and not call.task.strip():
            raise BadRequest("score needs a task", hint="add the instruction as `task`")
        progress, success = self._score(_pictures(call), call.task)
        low, high = self._contract.progress_range
        return {
            "ok": True,
            "progress": _shares([(value - low) / (high - low) for value in progress], "progress"),
            "success": _shares(success, "success"),
            "success_threshold": self._contract.success_threshold,
        }

    def _score(self, pictures: Any, task: str) -> tuple[list[float], list[float]]:
        import torch

        try:
            batch = self._before({self._picture_key(): pictures, "task": [task]})
        except ValueError as error:  # the checkpoint's own processor cannot read it
            raise BadRequest(
                f"task: {error}", hint="use the words that this model was trained on"
            ) from error
        with torch.inference_mode():
            if hasattr(self._model, "score"):
                progress, success = self._model.score(batch)
                return progress[0].float().tolist(), success[0].float().tolist()
            return [float(self._model.compute_reward(batch)[-1])], []

    def _picture_key(self) -> str:
        inputs = self._config.input_features
        known = [key for key in inputs if inputs[key].type.value == "VISUAL"]
        if len(known) != 1:
            raise ModelError(
                f"{self._weights.source} looks at {len(known)} cameras",
                hint="a reward sidecar judges one camera's pictures",
            )
        return str(known[0])


def _pictures(call: ScoreOp) -> Any:
    """Return all pictures, oldest first, as one tensor.

    Raises BadRequest for none, too many pixels, or different sizes.
    """
    import numpy as np
    import torch

    if call.frames:
        assert call.width is not None, "the message's own check"
        assert call.height is not None, "the message's own check"
        shape = (-1, call.height, call.width, BYTES_A_PIXEL)
        stack = np.frombuffer(call.frames, np.uint8).reshape(shape)[..., ::-1]
    else:
        taken = of_one_size(decode_all(call.images))
        stack = np.stack([np.asarray(picture) for picture in taken])
    return (
        torch.from_numpy(np.ascontiguousarray(stack)).permute(0, 3, 1, 2).to(torch.float32)[None]
        / 255
    )


def _shares(values: list[float], what: str) -> list[float]:
    """Clip to 0..1 as lerobot does. Raises ModelError for values that are not numbers."""
    if not all(math.isfinite(value) for value in values):
        raise ModelError(
            f"the reward model's {what} is not a number", hint="it gives no opinion about the task"
        )
    return [min(1.0, max(0.0, value)) for value in values]
