"""Pre- and postprocessing of the compact policy: lerobot's default pipelines.

These batch, move to the device, normalize and unnormalize.
"""

from typing import Any

from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_pre_post_processors,
)
from torch import Tensor

from vram_arbiter.sidecars.models.compact_act.configuration_compact_act import CompactActConfig


def make_compact_act_pre_post_processors(
    config: CompactActConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return both pipelines for a new policy; lerobot's factory finds this function by its name."""
    return make_default_pre_post_processors(  # type: ignore[no-any-return]
        config, dataset_stats, normalizer_device=config.device
    )
