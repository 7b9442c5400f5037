"""Inputs of a transformers model: on its device, pictures in its precision."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.manifest.contracts import DetectorContract
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.base import Inputs
from vram_arbiter.sidecars.images import decode, sizes, within

if TYPE_CHECKING:
    from PIL.Image import Image


def picture_of(call: DetectOp, contract: DetectorContract) -> "tuple[Image, Image]":
    """Return a caller's picture, whole and within the limits of call and manifest. Raises
    BadRequest."""
    picture = decode(call.image)
    return picture, within(picture, min(call.max_side, contract.max_side or call.max_side))


def processed(processor: Any, pictures: "Sequence[Image]", **given: Any) -> Inputs:
    """Call a processor with what is `given` for a caller's pictures.

    Raises BadRequest for whatever its arithmetic raises, such as for a picture 200 times as wide
    as high, of which resizing leaves nothing.
    """
    try:
        inputs: Inputs = processor(return_tensors="pt", **given)
    except (ValueError, TypeError, LookupError, ArithmeticError, RuntimeError) as error:
        raise BadRequest(
            f"{type(processor).__name__} cannot read pictures of {sizes(pictures)}: {error}",
            hint="send pictures of an ordinary shape",
        ) from error
    return inputs


def to_model(inputs: Inputs, model: Any) -> Any:
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
