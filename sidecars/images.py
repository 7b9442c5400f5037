"""Pictures from the wire: PNG or JPEG bytes to a bounded RGB picture.

The decoder's work is read from the bytes before it starts (pixels, scans of a JPEG, chunks of a
PNG), because a few kilobytes can ask for minutes. Must not know models or wires.
"""

import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vram_arbiter.schemas.errors import BadRequest

if TYPE_CHECKING:
    from PIL import Image

PIXELS_MAX = 4096 * 4096  # 50 MB as RGB; a robot's cameras have a tenth
SIDE_MAX = 16_384
SCANS_MAX = 12  # scans of a JPEG: progressive encoders write 6 to 10, each a pass over all pixels
SEGMENTS_MAX = 1_000  # segments before a JPEG's picture; cameras and editors write a few dozen
CHUNKS_MAX = 8_192  # chunks of a PNG: 16 MiB in the 8 KiB chunks of libpng are 2,048

_HINT = "send PNG (or JPEG) bytes of an RGB picture"
_PNG = b"\x89PNG\r\n\x1a\n"
# Bits by color type. Not 16 of gray: Pillow cuts them off at 255 instead of scaling them.
_PNG_DEPTHS = {0: (1, 2, 4, 8), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_JPEG = b"\xff\xd8"
_JPEG_SCAN = 0xDA
_JPEG_FRAMES = {
    0xC0,
    0xC1,
    0xC2,
}  # baseline, extended, progressive; Huffman-coded, as cameras write
_JPEG_SEGMENTS = {0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0)}  # tables, comments, application data


@dataclass(frozen=True, slots=True)
class Header:
    """Size and work of a picture, as its bytes declare them."""

    width: int
    height: int
    scans: int = 1  # passes over all pixels


def header(data: bytes) -> Header:
    """Read size and work of one picture without decoding it.

    Raises BadRequest for bytes that are not PNG or JPEG, or that ask for more work than their
    pixels justify.
    """
    try:
        if data.startswith(_PNG):
            found = _png(data)
        elif data.startswith(_JPEG):
            found = _jpeg(data)
        else:
            raise BadRequest("the image cannot be decoded: neither PNG nor JPEG", hint=_HINT)
    except (struct.error, IndexError):
        raise BadRequest("the image cannot be decoded: it is cut short", hint=_HINT) from None
    if not (0 < found.width <= SIDE_MAX and 0 < found.height <= SIDE_MAX):
        raise BadRequest(
            f"a picture of {found.width} x {found.height} pixels; a side has 1 to {SIDE_MAX}",
            hint="send a smaller one",
        )
    return found


def _png(data: bytes) -> Header:
    length, kind, width, height, depth, color, _, _, _ = struct.unpack_from(">I4sIIBBBBB", data, 8)
    if (length, kind) != (13, b"IHDR"):
        raise BadRequest("the image cannot be decoded: a PNG begins with IHDR", hint=_HINT)
    if depth not in _PNG_DEPTHS.get(color, ()):
        raise BadRequest(
            f"a PNG of color type {color} with {depth} bits a sample",
            hint="send 8 bits a sample: RGB, gray or palette",
        )
    at, chunks = 8, 0
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        at += 12 + length
        chunks += 1
        if chunks > CHUNKS_MAX:
            raise BadRequest(
                f"a PNG of more than {CHUNKS_MAX} chunks", hint="write it with larger ones"
            )
    return Header(width, height)


def _jpeg(data: bytes) -> Header:
    at, size = len(_JPEG), (0, 0)
    for _ in range(SEGMENTS_MAX):
        if data[at] != 0xFF:
            raise BadRequest(
                "the image cannot be decoded: a JPEG's segments do not join", hint=_HINT
            )
        kind = data[at + 1]
        if kind == 0xFF:  # padding
            at += 1
            continue
        if kind == _JPEG_SCAN:
            break
        (length,) = struct.unpack_from(">H", data, at + 2)
        if kind in _JPEG_FRAMES:
            if size != (0, 0):
                raise BadRequest("a JPEG of more than one frame", hint=_HINT)
            height, width = struct.unpack_from(">HH", data, at + 5)
            size = width, height
        elif kind not in _JPEG_SEGMENTS:
            raise BadRequest(
                f"a JPEG with the segment 0x{kind:02x}", hint="send a baseline or progressive one"
            )
        at += 2 + length
    else:
        raise BadRequest(f"a JPEG of more than {SEGMENTS_MAX} segments", hint=_HINT)
    # Coded pixels never contain this pair of bytes, so no decoder can find more scans.
    scans = data.count(b"\xff\xda", at)
    if scans > SCANS_MAX:
        raise BadRequest(
            f"a JPEG of {scans} scans; at most {SCANS_MAX} are decoded",
            hint="send a baseline JPEG, or a PNG",
        )
    return Header(*size, scans)


def decode(data: bytes) -> "Image.Image":
    """Decode one picture.

    Raises BadRequest for anything but a PNG or JPEG of `PIXELS_MAX` pixels.
    """
    return decode_all([data])[0]


def decode_all(images: Sequence[bytes]) -> list["Image.Image"]:
    """Decode pictures that have at most `PIXELS_MAX` pixels together.

    All headers are read before any picture is decoded. Raises BadRequest as `decode`.
    """
    from PIL import Image

    headers = [header(data) for data in images]
    if sum(one.width * one.height for one in headers) > PIXELS_MAX:
        raise BadRequest(
            f"{len(images)} pictures of {sizes(headers)} have more than {PIXELS_MAX} pixels",
            hint="send fewer, or smaller ones",
        )
    decoded = []
    for data, said in zip(images, headers, strict=True):
        try:
            picture = Image.open(io.BytesIO(data), formats=("PNG", "JPEG"))
            if picture.size != (said.width, said.height):  # the header was of another picture
                raise ValueError(f"{picture.size} is not the size in its header")
            decoded.append(picture.convert("RGB"))
        except Exception as error:  # noqa: BLE001  a decoder meets unforeseen bytes
            raise BadRequest(f"the image cannot be decoded: {error}", hint=_HINT) from None
    return decoded


def of_one_size(pictures: "Sequence[Image.Image]") -> "Sequence[Image.Image]":
    """Return the pictures. Raises BadRequest unless all have the size of the first."""
    if len({picture.size for picture in pictures}) > 1:
        raise BadRequest(
            f"pictures of different sizes: {sizes(pictures)}", hint="send one camera's pictures"
        )
    return pictures


def sizes(pictures: "Sequence[Header | Image.Image]") -> str:
    """Return the different sizes of pictures in words, such as `640 x 480, 80 x 60`."""
    return ", ".join(sorted({f"{picture.width} x {picture.height}" for picture in pictures}))


def within(picture: "Image.Image", max_side: int) -> "Image.Image":
    """Return the picture with its longest side at most `max_side` pixels."""
    from PIL import Image

    scale = max_side / max(picture.size)
    if scale >= 1:
        return picture
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    return picture.resize(size, Image.Resampling.BILINEAR)
