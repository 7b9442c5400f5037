"""The compact action-chunking policy: half a million weights, a chunk of targets in milliseconds.

Each camera has its own small convolution stack and a spatial softmax that locates its features. An
auxiliary head predicts the position of the object to grab in the robot's frame, and the action head
reads all of it together with the joint state. Must not know training code or simulators.
"""

from collections import deque
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional as F

from vram_arbiter.sidecars.models.compact_act.configuration_compact_act import CompactActConfig

POINT_KEY = "observation.point"
"""(B, 3) meters in the base frame; present in training batches only."""


class SpatialSoftmax(nn.Module):  # type: ignore[misc]
    """Expected image coordinates (-1..1) of each feature map, and its strength there."""

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.to_maps = nn.Conv2d(channels, keypoints, 1)
        self.sharpness = nn.Parameter(torch.zeros(keypoints))

    def forward(self, features: Tensor) -> Tensor:
        maps = self.to_maps(features).float()
        batch, count, height, width = maps.shape
        flat = maps.flatten(2)
        weight = F.softmax(flat * self.sharpness.exp()[:, None], dim=-1).view(
            batch, count, height, width
        )
        ys = torch.linspace(-1, 1, height, device=maps.device)
        xs = torch.linspace(-1, 1, width, device=maps.device)
        x = (weight.sum(2) * xs).sum(-1)
        y = (weight.sum(3) * ys).sum(-1)
        strength = torch.tanh(flat.amax(-1) / 8)
        return torch.cat([x, y, strength], dim=-1)


class Eye(nn.Module):  # type: ignore[misc]
    """Convolutions over one camera's view.

    Stride 4 in all, and group norm, so that batch and single frame agree.
    """

    def __init__(self, channels: list[int], keypoints: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        previous = 3
        for index, width in enumerate(channels):
            stride = 2 if index < 2 else 1
            kernel = 5 if index == 0 else 3
            layers += [
                nn.Conv2d(previous, width, kernel, stride=stride, padding=kernel // 2),
                nn.GroupNorm(8, width),
                nn.SiLU(),
            ]
            previous = width
        self.stack = nn.Sequential(*layers)
        self.softmax = SpatialSoftmax(previous, keypoints)

    def forward(self, image: Tensor) -> Tensor:
        return self.softmax(self.stack(image))


class CompactActPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """lerobot policy of type `compact_act`."""

    config_class = CompactActConfig
    name = "compact_act"

    def __init__(self, config: CompactActConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        self._cameras = sorted(config.image_features)
        state_dim = config.robot_state_feature.shape[0]
        self._action_dim = config.action_feature.shape[0]
        self.eyes = nn.ModuleList(Eye(config.channels, config.keypoints) for _ in self._cameras)
        seen = 3 * config.keypoints * len(self._cameras)
        self.where = nn.Sequential(
            nn.Linear(seen + state_dim, config.hidden_dim),
            nn.SiLU(),
            nn.Linear(config.hidden_dim, config.aux_point_dim),
        )
        self.act = nn.Sequential(
            nn.Linear(seen + state_dim + config.aux_point_dim, config.hidden_dim),
            nn.LayerNorm(config.hidden_dim),
            nn.SiLU(),
            nn.Dropout(config.dropout),
            nn.Linear(config.hidden_dim, config.hidden_dim),
            nn.SiLU(),
            nn.Dropout(config.dropout),
            nn.Linear(config.hidden_dim, config.chunk_size * self._action_dim),
        )
        # targets are mostly close to the present joints: a straight path spares the network
        # learning that
        self.carry_on = nn.Linear(state_dim, config.chunk_size * self._action_dim)
        self.register_buffer("point_centre", torch.zeros(config.aux_point_dim))
        self.reset()

    def get_optim_params(self) -> Any:
        """Return all weights with one rate."""
        return self.parameters()

    def reset(self) -> None:
        """Forget the queued actions; call between goals."""
        self._action_queue: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    def view(self, key: str, image: Tensor) -> Tensor:
        """Return the crop of a (B, 3, H, W) image for the policy, averaged to its size."""
        (x0, y0, x1, y1), (width, height) = self.config.views[key]
        rows, columns = image.shape[-2:]
        if (rows, columns) != (int(height), int(width)):
            image = image[
                ..., round(y0 * rows) : round(y1 * rows), round(x0 * columns) : round(x1 * columns)
            ]
            image = F.adaptive_avg_pool2d(image, (int(height), int(width)))
        return image

    def _run(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        seen = [
            eye(self.view(key, batch[key]) * 2 - 1)
            for key, eye in zip(self._cameras, self.eyes, strict=True)
        ]
        state = batch[OBS_STATE]
        known = torch.cat([*seen, state], dim=-1)
        point = self.where(known)
        flat = self.act(torch.cat([known, point], dim=-1)) + self.carry_on(state)
        return flat.view(-1, self.config.chunk_size, self._action_dim), point

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return (B, chunk_size, action_dim), normalized as the postprocessor expects."""
        self.eval()
        return self._run(batch)[0]

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the next action; a new chunk is predicted after `n_action_steps` of the last."""
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch)[:, : self.config.n_action_steps]
            self._action_queue.extend(chunk.transpose(0, 1))
        return self._action_queue.popleft()

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss over the unpadded chunk, plus the auxiliary one if labeled."""
        chunk, point = self._run(batch)
        error = F.smooth_l1_loss(chunk, batch[ACTION], reduction="none", beta=0.1)
        valid = (~batch["action_is_pad"]).unsqueeze(-1).expand_as(error)
        loss = (error * valid).sum() / valid.sum().clamp_min(1)
        parts = {"action": float(loss.detach())}
        if POINT_KEY in batch:
            wanted = (batch[POINT_KEY] - self.point_centre) / self.config.aux_point_scale_m
            aux = F.smooth_l1_loss(point, wanted, beta=0.1)
            parts["point"] = float(aux.detach())
            loss = loss + self.config.aux_weight * aux
        return loss, parts
