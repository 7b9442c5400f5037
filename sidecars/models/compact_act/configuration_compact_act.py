"""Configuration of the compact action-chunking policy: sizes, crops, chunk length.

Must not know weights.
"""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("compact_act")
@dataclass
class CompactActConfig(PreTrainedConfig):  # type: ignore[misc]  # lerobot is untyped here
    """Convolutions with a spatial softmax per camera, the joint state, and a chunk of joint
    targets.

    `views` has per image feature the crop (x0, y0, x1, y1 as fractions) and the size (width,
    height) in pixels that it is averaged to; an image may therefore have any size with the camera's
    aspect ratio. `aux_point_dim` is the size of an auxiliary output (the position of the object to
    grab) that is trained along and fed to the action head.
    """

    n_obs_steps: int = 1
    chunk_size: int = 12
    n_action_steps: int = 6
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )
    views: dict[str, list[list[float]]] = field(default_factory=dict)
    channels: list[int] = field(default_factory=lambda: [16, 24, 24, 32])
    keypoints: int = 32
    hidden_dim: int = 256
    aux_point_dim: int = 3
    aux_point_scale_m: float = 0.05
    aux_weight: float = 0.5
    dropout: float = 0.05
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps must lie in 1..chunk_size ({self.chunk_size}), not "
                f"{self.n_action_steps}"
            )
        if self.n_obs_steps != 1:
            raise ValueError(
                f"compact_act looks at one observation, n_obs_steps cannot be {self.n_obs_steps}"
            )

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return AdamW with the configured rate and decay."""
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    def get_scheduler_preset(self) -> None:
        """Return None: the training script has its own schedule."""

    def validate_features(self) -> None:
        """Raise ValueError unless there are images with a view each, a state and an action."""
        if (
            not self.image_features
            or self.robot_state_feature is None
            or self.action_feature is None
        ):
            raise ValueError("compact_act needs at least one image, observation.state and action")
        missing = sorted(set(self.image_features) - set(self.views))
        if missing:
            raise ValueError(f"no view (crop and size) given for {missing}")

    @property
    def observation_delta_indices(self) -> None:
        """Use only the present observation."""

    @property
    def action_delta_indices(self) -> list[int]:
        """Start the chunk at the present step."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """Use no rewards."""
