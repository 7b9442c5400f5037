"""A small progress model in lerobot's own plug-in form for reward models: type `compact_progress`.

Importing this package registers the type; a checkpoint of it then loads like Robometer or SARM:
`RewardModelConfig.from_pretrained`, `get_reward_model_class`, `make_reward_pre_post_processors`.
lerobot's own reward models have backbones of hundreds of megabytes. Module and class names follow
lerobot's convention, which its factory relies on.
"""

from vram_arbiter.sidecars.models.compact_progress.configuration_compact_progress import (
    CompactProgressConfig,
)

__all__ = ["CompactProgressConfig"]
