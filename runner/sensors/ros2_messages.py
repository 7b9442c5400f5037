"""Picture messages of ROS 2 (`sensor_msgs/Image`, `sensor_msgs/CompressedImage`) as frames.

No clock and no network: Cyclone's IDL types describe the messages, and write and read their CDR.
Nothing is guessed: a message whose parts contradict each other is a ValueError. Cyclone takes
annotations as objects only, so this module has no future import of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int32, uint8, uint32

from vram_arbiter.runner.sensors.image_header import jpeg_header
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

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


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):  # type: ignore[call-arg, misc]
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):  # type: ignore[call-arg, misc]
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""

    @classmethod
    def of(cls, stamp_ns: int, frame_id: str) -> Self:
        return cls(Time(stamp_ns // NANOSECONDS, stamp_ns % NANOSECONDS), frame_id)

    @property
    def stamp_ns(self) -> int:
        """Return when it was taken, from 1970 by the sender's clock; 0: not stamped."""
        return int(self.stamp.sec * NANOSECONDS + self.stamp.nanosec)


@dataclass
class RosImage(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):  # type: ignore[call-arg, misc]
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: bytes


_COMPRESSED = "sensor_msgs.msg.dds_.CompressedImage_"


@dataclass
class RosCompressedImage(IdlStruct, typename=_COMPRESSED):  # type: ignore[call-arg, misc]
    header: Header
    format: str
    data: bytes


RosPicture = RosImage | RosCompressedImage


@dataclass(frozen=True, slots=True)
class ImageContent:
    """What a frame takes from either message."""

    encoding: FrameEncoding
    width: int
    height: int
    channels: int
    data: bytes


def picture_of(message: RosPicture) -> ImageContent:
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


def message_of(frame: SensorFrame) -> RosPicture:
    """Return the ROS message for a frame.

    Raises ValueError for an encoding that ROS does not have.
    """
    if frame.data is None:
        raise ValueError("the frame's bytes are not in this process")
    if not 0 <= frame.stamp_wall_ns < STAMP_END_NS:
        raise ValueError("ROS has no stamp for this time: its seconds end in 2038")
    header = Header.of(frame.stamp_wall_ns, frame.sensor_id)
    if frame.encoding is FrameEncoding.JPEG:
        return RosCompressedImage(header, "jpeg", frame.data)
    name = _ROS_NAME.get(frame.encoding)
    if name is None:
        raise ValueError(f"{frame.encoding} has no name in ROS")
    step = len(frame.data) // frame.height
    return RosImage(header, frame.height, frame.width, name, 0, step, frame.data)


def jpeg_size(data: bytes) -> tuple[int, int, int]:
    """Return width, height and channels of a whole JPEG in color or gray. Raises ValueError."""
    width, height, channels = jpeg_header(data)
    if channels not in (1, 3):
        raise ValueError(f"a JPEG of {width} × {height} pixels with {channels} channels")
    if b"\xff\xd9" not in data[-64:]:  # cameras pad after the end mark
        raise ValueError("the JPEG was cut off")
    return width, height, channels
