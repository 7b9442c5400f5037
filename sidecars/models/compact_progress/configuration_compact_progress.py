"""Configuration of the compact progress model: its picture, its words, its sizes.

Must not know weights.
"""

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.rewards import RewardModelConfig
from lerobot.utils.constants import OBS_IMAGES


@RewardModelConfig.register_subclass("compact_progress")
@dataclass
class CompactProgressConfig(RewardModelConfig):  # type: ignore[misc]  # lerobot is untyped here
    """One camera's pictures, and an instruction that names one object by color and shape.

    The words are those of `colours` and `shapes`. `size_px` (width, height) is what pictures are
    averaged to; they may have any size with that aspect ratio.
    """

    image_key: str = OBS_IMAGES + ".wrist"
    size_px: list[int] = field(default_factory=lambda: [96, 72])
    colours: list[str] = field(default_factory=list)
    shapes: list[str] = field(default_factory=list)
    channels: list[int] = field(default_factory=lambda: [16, 32, 48, 64])
    word_dim: int = 32
    keypoints: int = 24
    hidden_dim: int = 128
    dropout: float = 0.1
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        width, height = self.size_px
        self.input_features = {
            self.image_key: PolicyFeature(type=FeatureType.VISUAL, shape=(3, height, width))
        }

    def validate_features(self) -> None:
        """Raise ValueError without words: an instruction could not name an object."""
        if not self.colours or not self.shapes:
            raise ValueError(
                "compact_progress needs `colours` and `shapes`: the words of instructions"
            )
