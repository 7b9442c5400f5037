"""Checks of a policy's checkpoint that lerobot leaves out, or answers with a warning."""

from pathlib import Path
from typing import Any

from vram_arbiter.schemas.errors import ModelError


def need_weights(source: str) -> None:
    """Raise ModelError for a folder without weights: GR00T's loader takes that for another format
    and builds a model of 3 billion random numbers."""
    if not (Path(source) / "model.safetensors").is_file():
        raise ModelError(
            f"{source} has no model.safetensors", hint="check that the checkpoint is complete"
        )


def need_trained(policy: Any, source: str) -> None:
    """Raise ModelError for a VQ-BeT whose codes were never trained; lerobot only warns."""
    vqbet = getattr(policy, "vqbet", None)
    if vqbet is not None and not vqbet.action_head.vqvae_model.discretized.item():
        raise ModelError(
            f"{source}: the quantizer of its actions is not trained: `discretized` is false",
            hint="train past n_vqvae_training_steps",
        )


def need_absolute(after: Any, source: str) -> None:
    """Raise ModelError for a GR00T whose postprocessor decodes actions relative to the state."""
    if any(getattr(step, "use_relative_action", False) for step in after.steps):
        raise ModelError(
            f"{source}: its postprocessor decodes relative actions, which are not served",
            hint="use a checkpoint with absolute actions",
        )
