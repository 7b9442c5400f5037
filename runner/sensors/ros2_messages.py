"""Picture messages of ROS 2 (`sensor_msgs/Image`, `sensor_msgs/CompressedImage`) as frames.

No clock and no network. Nothing is guessed: a message whose parts contradict each other is a
ValueError.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from vram_arbiter.runner.sensors.image_header import jpeg_header
from vram_arbiter.runner.sensors.ros2_types import RosMessage
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
NANOSECONDS = 1_000_000_000
STAMP_END_NS = 2**31 * NANOSECONDS
SIDE_MAX = 16_384  # pixels

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


def stamp_of(stamp_ns: int) -> RosMessage:
    """Return `builtin_interfaces/Time`. Raises ValueError: ROS has no stamp for it."""
    if not 0 <= stamp_ns < STAMP_END_NS:
        raise ValueError("ROS has no stamp for this time: its seconds end in 2038")
    return {"sec": stamp_ns // NANOSECONDS, "nanosec": stamp_ns % NANOSECONDS}


def stamp_ns_of(message: RosMessage) -> int:
    """Return the header's time, from 1970 by the sender's clock; 0: not stamped."""
    stamp = message["header"]["stamp"]
    return int(stamp["sec"] * NANOSECONDS + stamp["nanosec"])


@dataclass(frozen=True, slots=True)
class ImageContent:
    """What a frame takes from either message."""

    encoding: FrameEncoding
    width: int
    height: int
    channels: int
    data: bytes


def picture_of(kind: str, message: RosMessage) -> ImageContent:
    """Return the picture in a message. Raises ValueError with the reason.

    Rows lose their padding, 16-bit values become little-endian.
    """
    if kind == COMPRESSED:
        return _compressed(message)
    known = _ENCODINGS.get(message["encoding"])
    if known is None:
        raise ValueError(
            f"encoding {message['encoding']!r} is not supported, only {', '.join(_ENCODINGS)}"
        )
    encoding, per_pixel = known
    width, rows, step = message["width"], message["height"], message["step"]
    if not (0 < width <= SIDE_MAX and 0 < rows <= SIDE_MAX):
        raise ValueError(f"a picture of {width} × {rows} pixels")
    row, data = width * per_pixel, message["data"]
    if step < row or len(data) != step * rows:
        raise ValueError(
            f"{rows} rows of {step} bytes do not make a {encoding} picture"
            f" of {width} × {rows} in {len(data)} bytes"
        )
    if step > row:
        data = b"".join(data[at : at + row] for at in range(0, step * rows, step))
    if per_pixel == 2 and message["is_bigendian"]:
        swapped = bytearray(data)
        swapped[0::2], swapped[1::2] = data[1::2], data[0::2]
        data = bytes(swapped)
    return ImageContent(encoding, width, rows, 3 if per_pixel == 3 else 1, data)


def _compressed(message: RosMessage) -> ImageContent:
    # image_transport writes "rgb8; jpeg compressed bgr8"; plain publishers write "jpeg" or "jpg"
    form = message["format"].lower()
    if "jpeg" not in form and "jpg" not in form:
        raise ValueError(f"format {message['format']!r} is not supported, only jpeg")
    width, height, channels = jpeg_size(message["data"])
    return ImageContent(FrameEncoding.JPEG, width, height, channels, message["data"])


def message_of(frame: SensorFrame) -> tuple[str, RosMessage]:
    """Return the ROS message for a frame, and its type.

    Raises ValueError for an encoding that ROS does not have.
    """
    if frame.data is None:
        raise ValueError("the frame's bytes are not in this process")
    header = {"stamp": stamp_of(frame.stamp_wall_ns), "frame_id": frame.sensor_id}
    if frame.encoding is FrameEncoding.JPEG:
        return COMPRESSED, {"header": header, "format": "jpeg", "data": frame.data}
    name = _ROS_NAME.get(frame.encoding)
    if name is None:
        raise ValueError(f"{frame.encoding} has no name in ROS")
    size = {"height": frame.height, "width": frame.width, "step": len(frame.data) // frame.height}
    return IMAGE, {"header": header, "encoding": name, **size, "data": frame.data}


def jpeg_size(data: bytes) -> tuple[int, int, int]:
    """Return width, height and channels of a whole JPEG in color or gray. Raises ValueError."""
    width, height, channels = jpeg_header(data)
    if channels not in (1, 3):
        raise ValueError(f"a JPEG of {width} × {height} pixels with {channels} channels")
    if b"\xff\xd9" not in data[-64:]:  # cameras pad after the end mark
        raise ValueError("the JPEG was cut off")
    return width, height, channels
