"""Sizes of compressed pictures, read from their headers without decoding a pixel.

Pure. A decoder trusts these headers and allocates what they ask for, so code that decodes foreign
bytes checks them first.
"""

from __future__ import annotations

import struct

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def jpeg_header(data: bytes) -> tuple[int, int, int]:
    """Return width, height and channels. Raises ValueError for anything but a JPEG."""
    if not data.startswith(b"\xff\xd8"):
        raise ValueError("the data is not a JPEG")
    at = 2
    try:
        while True:
            if data[at] != 0xFF:
                raise ValueError("the JPEG is damaged before its frame header")
            marker = data[at + 1]
            if marker == 0xFF:  # fill byte
                at += 1
            elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
                height, width, channels = struct.unpack_from(">HHB", data, at + 5)
                break
            elif marker in (0xD9, 0xDA):
                raise ValueError("the JPEG has no frame header")
            elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without a segment
                at += 2
            else:
                at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    except (IndexError, struct.error):
        raise ValueError("the JPEG ends before its frame header") from None
    if not (width and height and channels):
        raise ValueError(f"a JPEG of {width} × {height} pixels with {channels} channels")
    return width, height, channels


def png_header(data: bytes) -> tuple[int, int]:
    """Return width and height. Raises ValueError for anything but a PNG."""
    if not data.startswith(PNG_SIGNATURE) or data[12:16] != b"IHDR" or len(data) < 24:
        raise ValueError("the data is not a PNG")
    width, height = struct.unpack_from(">II", data, 16)
    if not (width and height):
        raise ValueError(f"a PNG of {width} × {height} pixels")
    return width, height
