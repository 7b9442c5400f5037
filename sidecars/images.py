"""Pictures from the wire: PNG or JPEG bytes from strangers to a bounded RGB picture."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from schemas.errors import BadRequest

if TYPE_CHECKING:
    from PIL import Image

PIXELS_MAX = 4096 * 4096  # 50 MB as RGB; a robot's cameras have a tenth
FORMATS = ("PNG", "JPEG")


def decode(data: bytes) -> "Image.Image":
    """Decode one picture. Raises BadRequest for anything that is no PNG or JPEG of at most `PIXELS_MAX` pixels."""
    return decode_all([data])[0]


def decode_all(images: Sequence[bytes]) -> list["Image.Image"]:
    """Decode pictures that have at most `PIXELS_MAX` pixels together: all headers are read before any picture is, for a few kilobytes can
    say gigabytes. Raises BadRequest as `decode`."""
    from PIL import Image, UnidentifiedImageError

    try:
        pictures = [Image.open(io.BytesIO(data), formats=FORMATS) for data in images]  # the headers only
        if sum(picture.width * picture.height for picture in pictures) > PIXELS_MAX:
            sizes = ", ".join(sorted({f"{picture.width} x {picture.height}" for picture in pictures}))
            raise BadRequest(
                f"{len(images)} pictures of {sizes} have more than {PIXELS_MAX} pixels",
                hint="send fewer, or smaller ones",
            )
        return [picture.convert("RGB") for picture in pictures]
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadRequest(
            f"the image cannot be decoded: {error}", hint="send PNG (or JPEG) bytes of an RGB picture"
        ) from None


def within(picture: "Image.Image", max_side: int) -> "Image.Image":
    """The picture with its longest side at most `max_side` pixels, shrunk if it has to be."""
    from PIL import Image

    scale = max_side / max(picture.size)
    if scale >= 1:
        return picture
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    return picture.resize(size, Image.Resampling.BILINEAR)
