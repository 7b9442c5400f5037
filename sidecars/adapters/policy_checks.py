"""Checks of a policy's checkpoint that lerobot leaves out, or answers with a warning."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.errors import ModelError

if TYPE_CHECKING:
    from lerobot.configs import PolicyFeature
    from torch import Tensor

WEIGHTS: Final = "model.safetensors"
_FLAG: Final = "vqbet.action_head.vqvae_model.discretized"
_STATISTICS: Final[Mapping[str, tuple[str, str]]] = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""What lerobot's kinds of normalization compute with."""


def need_weights(source: str) -> None:
    """Raise ModelError for a folder without weights: GR00T's loader takes that for another format
    and builds a model of 3 billion random numbers."""
    if not (Path(source) / WEIGHTS).is_file():
        raise ModelError(f"{source} has no {WEIGHTS}", hint="check that the checkpoint is complete")


def need_trained(kind: str, source: str) -> None:
    """Raise ModelError for a VQ-BeT whose codes were never trained; lerobot only warns.

    The flag is read from the file, because a model on `meta` has no values."""
    if kind != "vqbet":
        return
    from safetensors import safe_open

    with safe_open(Path(source) / WEIGHTS, "pt") as file:
        names = file.keys()  # it is not a mapping
        if _FLAG in names and not file.get_tensor(_FLAG).item():
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


def need_statistics(
    pipeline: Any, features: "Mapping[str, PolicyFeature]", source: str, *, padded: bool
) -> None:
    """Raise ModelError if a normalizer of a processor cannot convert one of `features`.

    lerobot leaves a feature without statistics unchanged, in other units; with wrong ones it fails,
    or answers nonsense, at the first action. `padded`: the normalizer sees features as wide as it
    says itself.
    """
    for step in pipeline.steps:
        if not hasattr(step, "norm_map"):
            continue
        numbers, chosen = step.state_dict(), step.normalize_observation_keys
        for name, feature in (step.features if padded else features).items():
            mode = step.norm_map.get(feature.type)
            words = None if mode is None else _STATISTICS.get(mode.value)
            if (
                words is None
                or name not in features.keys() & step.features.keys()
                or (chosen is not None and feature.type.value != "ACTION" and name not in chosen)
            ):
                continue  # it is left as it is
            if defect := _defect(numbers, name, feature, words):
                raise ModelError(
                    f"{source}: its {type(step).__name__} cannot convert {name}: {defect}",
                    hint="get the whole checkpoint: values would be in other units than the "
                    "robot's",
                )


def _defect(
    numbers: "Mapping[str, Tensor]", name: str, feature: "PolicyFeature", words: tuple[str, str]
) -> str | None:
    """Return why the statistics `words` of a feature are of no use; None: they are."""
    if lacking := [word for word in words if f"{name}.{word}" not in numbers]:
        return f"no {' and no '.join(lacking)}"
    low, high = (numbers[f"{name}.{word}"] for word in words)
    shapes = {tuple(feature.shape)}
    if feature.type.value == "VISUAL":  # one number a channel
        shapes = {(feature.shape[0], 1, 1), (1, 1, 1)}
    for word, values in zip(words, (low, high), strict=True):
        if tuple(values.shape) not in shapes:
            return f"{word} has shape {tuple(values.shape)}, not {max(shapes)}"
        if not bool(values.isfinite().all()):
            return f"{word} has NaN or infinity"
    # what never moved in training is no defect of an action, which is its mean then, nor of bounds,
    # which lerobot maps to one end of the range; an observation would be divided by almost nothing
    if words[1] == "std":
        still = high <= 0
        some = bool(still.any()) if feature.type.value != "ACTION" else bool(still.all())
        return "std is 0 or less" if some or bool((high < 0).any()) else None
    return f"{words[1]} is below {words[0]}" if bool((high < low).any()) else None
