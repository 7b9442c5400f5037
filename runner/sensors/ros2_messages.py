"""Picture messages of ROS 2 (`sensor_msgs/Image`, `sensor_msgs/CompressedImage`) as frames.

Pure: no DDS, no clock. Their CDR is written and read here because a general codec makes a Python
list with one integer per byte of every picture, 50 ms of the interpreter for 640 × 480. Nothing is
guessed: a message whose parts contradict each other is a ValueError.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vram_arbiter.runner.sensors.image_header import jpeg_header
from vram_arbiter.schemas.world import FrameEncoding

NANOSECONDS = 1_000_000_000
STAMP_END_NS = 2**31 * NANOSECONDS
SIDE_MAX = 16_384  # pixels
MESSAGE_BYTES_MAX = 256 * 2**20  # 8K pictures with 16 bits a color are 200 MB

_ENCODINGS: Mapping[str, tuple[FrameEncoding, int]] = {
    "bgr8": (FrameEncoding.BGR8, 3),
    "8UC3": (FrameEncoding.BGR8, 3),  # OpenCV's word; its order is blue, green, red
    "rgb8": (FrameEncoding.RGB8, 3),
    "mono8": (FrameEncoding.MONO8, 1),
    "8UC1": (FrameEncoding.MONO8, 1),
    "16UC1": (FrameEncoding.DEPTH16, 2),
}
"""ROS's name → ours, and bytes per pixel. `16UC1` is depth in millimeters (REP 118)."""
_ROS_NAME = {
    FrameEncoding.BGR8: "bgr8",
    FrameEncoding.RGB8: "rgb8",
    FrameEncoding.MONO8: "mono8",
    FrameEncoding.DEPTH16: "16UC1",
}


@dataclass(frozen=True, slots=True)
class RosImage:
    """`sensor_msgs/Image`. `stamp_ns` counts from 1970 by the sender's clock; 0: not stamped."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    is_bigendian: bool
    step: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RosCompressedImage:
    """`sensor_msgs/CompressedImage`."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ImageContent:
    """What a frame takes from either message."""

    encoding: FrameEncoding
    width: int
    height: int
    channels: int
    data: bytes


def picture_of(message: RosImage | RosCompressedImage) -> ImageContent:
    """Return the picture in a message. Raises ValueError with the reason.

    Rows lose their padding, 16-bit values become little-endian.
    """
    if isinstance(message, RosCompressedImage):
        return _compressed(message)
    known = _ENCODINGS.get(message.encoding)
    if known is None:
        raise ValueError(
            f"encoding {message.encoding!r} is not supported, only {', '.join(_ENCODINGS)}"
        )
    encoding, per_pixel = known
    if not (0 < message.width <= SIDE_MAX and 0 < message.height <= SIDE_MAX):
        raise ValueError(f"a picture of {message.width} × {message.height} pixels")
    row, step, rows = message.width * per_pixel, message.step, message.height
    if step < row or len(message.data) != step * rows:
        raise ValueError(
            f"{rows} rows of {step} bytes do not make a {encoding} picture"
            f" of {message.width} × {rows} in {len(message.data)} bytes"
        )
    data = message.data
    if step > row:
        data = b"".join(data[at : at + row] for at in range(0, step * rows, step))
    if per_pixel == 2 and message.is_bigendian:
        swapped = bytearray(data)
        swapped[0::2], swapped[1::2] = data[1::2], data[0::2]
        data = bytes(swapped)
    return ImageContent(encoding, message.width, rows, 3 if per_pixel == 3 else 1, data)


def _compressed(message: RosCompressedImage) -> ImageContent:
    # image_transport writes "rgb8; jpeg compressed bgr8"; plain publishers write "jpeg" or "jpg"
    if "jpeg" not in message.format.lower() and "jpg" not in message.format.lower():
        raise ValueError(f"format {message.format!r} is not supported, only jpeg")
    width, height, channels = jpeg_size(message.data)
    return ImageContent(FrameEncoding.JPEG, width, height, channels, message.data)


def message_of(
    picture: ImageContent, stamp_ns: int, frame_id: str
) -> RosImage | RosCompressedImage:
    """Return the ROS message for a picture.

    Raises ValueError for an encoding that ROS does not have.
    """
    if not 0 <= stamp_ns < STAMP_END_NS:
        raise ValueError("ROS has no stamp for this time: its seconds end in 2038")
    if picture.encoding is FrameEncoding.JPEG:
        return RosCompressedImage(stamp_ns, frame_id, "jpeg", picture.data)
    name = _ROS_NAME.get(picture.encoding)
    if name is None:
        raise ValueError(f"{picture.encoding} has no name in ROS")
    step = len(picture.data) // picture.height
    return RosImage(
        stamp_ns, frame_id, picture.height, picture.width, name, False, step, picture.data
    )


def jpeg_size(data: bytes) -> tuple[int, int, int]:
    """Return width, height and channels of a whole JPEG in color or gray. Raises ValueError."""
    width, height, channels = jpeg_header(data)
    if channels not in (1, 3):
        raise ValueError(f"a JPEG of {width} × {height} pixels with {channels} channels")
    if b"\xff\xd9" not in data[-64:]:  # cameras pad after the end mark
        raise ValueError("the JPEG was cut off")
    return width, height, channels


# -- CDR
class _Writer:
    def __init__(self) -> None:
        self.parts: list[bytes] = [b"\x00\x01\x00\x00"]  # plain CDR, little-endian
        self.size = 0

    def put(self, kind: str, *values: Any) -> None:
        width = struct.calcsize(kind[0])
        pad = -self.size % width
        packed = b"\x00" * pad + struct.pack("<" + kind, *values)
        self.parts.append(packed)
        self.size += len(packed)

    def blob(self, data: bytes) -> None:
        self.put("I", len(data))
        self.parts.append(data)
        self.size += len(data)

    def text(self, text: str) -> None:
        self.blob(text.encode() + b"\x00")

    def header(self, stamp_ns: int, frame_id: str) -> None:
        self.put("i", stamp_ns // NANOSECONDS)
        self.put("I", stamp_ns % NANOSECONDS)
        self.text(frame_id)

    def done(self) -> bytes:
        return b"".join(self.parts)


class _Reader:
    """Offsets count from the end of the four bytes that say how the rest is encoded."""

    def __init__(self, data: bytes) -> None:
        if (
            len(data) < 4 or data[0] != 0 or data[1] not in (0, 1, 6, 7)
        ):  # CDR and CDR 2, plain, both byte orders
            raise ValueError("the message is in an encoding other than plain CDR")
        self.data = memoryview(data)[4:]
        self.order = "<" if data[1] & 1 else ">"
        self.at = 0

    def number(self, kind: str) -> int:
        width = struct.calcsize(kind)
        self.at += -self.at % width
        if self.at + width > len(self.data):
            raise ValueError("the message ends too early")
        value: int = struct.unpack_from(self.order + kind, self.data, self.at)[0]
        self.at += width
        return value

    def blob(self) -> bytes:
        length = self.number("I")
        if self.at + length > len(self.data):
            raise ValueError("the message ends too early")
        blob = bytes(self.data[self.at : self.at + length])
        self.at += length
        return blob

    def text(self) -> str:
        return self.blob().rstrip(b"\x00").decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        stamp_ns = self.number("i") * NANOSECONDS
        return stamp_ns + self.number("I"), self.text()


def write_cdr(message: RosImage | RosCompressedImage) -> bytes:
    """Return the message's bytes on the wire, after the four bytes that name their encoding."""
    writer = _Writer()
    writer.header(message.stamp_ns, message.frame_id)
    if isinstance(message, RosImage):
        writer.put("II", message.height, message.width)
        writer.text(message.encoding)
        writer.put("B", int(message.is_bigendian))
        writer.put("I", message.step)
    else:
        writer.text(message.format)
    writer.blob(message.data)
    return writer.done()


def read_image(data: bytes) -> RosImage:
    """Read `sensor_msgs/Image`. Raises ValueError."""
    reader = _Reader(data)
    stamp_ns, frame_id = reader.header()
    height, width = reader.number("I"), reader.number("I")
    encoding = reader.text()
    big, step = bool(reader.number("B")), reader.number("I")
    return RosImage(stamp_ns, frame_id, height, width, encoding, big, step, reader.blob())


def read_compressed(data: bytes) -> RosCompressedImage:
    """Read `sensor_msgs/CompressedImage`. Raises ValueError."""
    reader = _Reader(data)
    stamp_ns, frame_id = reader.header()
    return RosCompressedImage(stamp_ns, frame_id, reader.text(), reader.blob())
