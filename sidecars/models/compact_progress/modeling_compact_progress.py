"""The compact progress model: a hundred thousand weights that judge each picture by itself.

The words steer every layer of the picture's convolutions, so that another instruction for the same
picture is another question. Must not know training code or simulators.
"""

from typing import Any

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor, nn
from torch.nn import functional as F

from vram_arbiter.sidecars.models.compact_progress.configuration_compact_progress import (
    CompactProgressConfig,
)

WORDS_KEY = "observation.words"
"""(B, colors + shapes) ones where the instruction has the word."""
PROGRESS_KEY = "progress"
SUCCESS_KEY = "success"
"""(B, T) labels; present in training batches only."""


class Steered(nn.Module):  # type: ignore[misc]
    """Convolution with feature maps that the words scale and shift."""

    def __init__(self, inward: int, outward: int, stride: int, word_dim: int) -> None:
        super().__init__()
        self.convolve = nn.Conv2d(inward, outward, 3, stride=stride, padding=1)
        self.normalise = nn.GroupNorm(8, outward)
        self.steer = nn.Linear(word_dim, 2 * outward)

    def forward(self, maps: Tensor, words: Tensor) -> Tensor:
        scale, shift = self.steer(words)[:, :, None, None].chunk(2, dim=1)
        return F.silu(self.normalise(self.convolve(maps)) * (1 + scale) + shift)


class CompactProgressRewardModel(PreTrainedRewardModel):  # type: ignore[misc]
    """lerobot reward model of type `compact_progress`."""

    config_class = CompactProgressConfig
    name = "compact_progress"

    def __init__(self, config: CompactProgressConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        self.words = nn.Sequential(
            nn.Linear(len(config.colours) + len(config.shapes), config.word_dim), nn.SiLU(),
            nn.Linear(config.word_dim, config.word_dim), nn.SiLU(),
        )  # fmt: skip
        layers, previous = [], 3
        for index, width in enumerate(config.channels):
            layers.append(Steered(previous, width, 2 if index < 3 else 1, config.word_dim))
            previous = width
        self.layers = nn.ModuleList(layers)
        self.to_maps = nn.Conv2d(previous, config.keypoints, 1)
        self.judge = nn.Sequential(
            nn.Linear(3 * config.keypoints + previous + config.word_dim, config.hidden_dim),
            nn.LayerNorm(config.hidden_dim),
            nn.SiLU(),
            nn.Dropout(config.dropout),
            nn.Linear(config.hidden_dim, 2),
        )

    def logits(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return logits of progress and success, (B, T) each; pictures (B, T, 3, H, W) in 0..1."""
        pictures = batch[self.config.image_key]
        if pictures.ndim == 4:
            pictures = pictures[:, None]
        count, times = pictures.shape[:2]
        width, height = self.config.size_px
        flat = pictures.flatten(0, 1)
        if flat.shape[-2:] != (height, width):
            flat = F.adaptive_avg_pool2d(flat, (height, width))
        words = self.words(batch[WORDS_KEY]).repeat_interleave(times, dim=0)
        maps = flat * 2 - 1
        for layer in self.layers:
            maps = layer(maps, words)
        seen = torch.cat([_places(self.to_maps(maps)), maps.mean((2, 3)), words], dim=-1)
        judged = self.judge(seen).view(count, times, 2)
        return judged[..., 0], judged[..., 1]

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def score(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return progress and probability of success, each (B, T) in 0..1: one value a picture."""
        self.eval()
        progress, success = self.logits(batch)
        return progress.sigmoid(), success.sigmoid()

    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the progress at the newest picture, (B,), as lerobot asks for it."""
        return self.score(batch)[0][:, -1]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss against the labels."""
        progress, success = self.logits(batch)
        far = F.smooth_l1_loss(progress.sigmoid(), batch[PROGRESS_KEY], beta=0.1)
        held = F.binary_cross_entropy_with_logits(success, batch[SUCCESS_KEY])
        return 4 * far + held, {"progress": float(far.detach()), "success": float(held.detach())}


def _places(maps: Tensor) -> Tensor:
    """Return expected image coordinates (-1..1) of each map, and its strength there."""
    flat = maps.flatten(2)
    weight = flat.softmax(-1).view(maps.shape)
    ys = torch.linspace(-1, 1, maps.shape[2], device=maps.device)
    xs = torch.linspace(-1, 1, maps.shape[3], device=maps.device)
    x = (weight.sum(2) * xs).sum(-1)
    y = (weight.sum(3) * ys).sum(-1)
    return torch.cat([x, y, torch.tanh(flat.amax(-1) / 8)], dim=-1)
