"""Inputs of a transformers model: on its device, pictures in its precision."""

from collections.abc import Mapping
from typing import Any


def to_model(inputs: Mapping[str, Any], model: Any) -> Any:
    """Return a processor's inputs on the model's device, pictures in the model's type.

    Processors make float32, which a layer of 16 bits refuses. Other numbers, such as the seconds
    between frames, keep their precision.
    """
    from transformers import BatchFeature

    pictures = {name: value for name, value in inputs.items() if name.startswith("pixel_values")}
    return BatchFeature(
        {
            **BatchFeature(dict(inputs)).to(model.device),
            **BatchFeature(pictures).to(model.device, model.dtype),
        }
    )
