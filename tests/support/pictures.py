"""Pictures as the wires carry them."""

import io


def encoded(
    kind: str = "PNG",
    size: tuple[int, int] = (8, 6),
    color: tuple[int, int, int] | int = 0,
    mode: str = "RGB",
) -> bytes:
    """Return an encoded picture of one color; width and height in pixels."""
    from PIL import Image

    stream = io.BytesIO()
    Image.new(mode, size, color).save(stream, kind)
    return stream.getvalue()
