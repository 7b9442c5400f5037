"""Camera frames as arrays for skills and encoders: RGB uint8, height × width × 3.

A frame without colors (depth, a topic's name) is refused. Compressed frames
come from cameras and networks: their bytes and their header are checked before a decoder sees them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal

from vram_arbiter.runner.sensors.image_header import jpeg_header, png_header
from vram_arbiter.schemas.defaults import IMAGE_MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import FrameStale, InternalError, ModelError
from vram_arbiter.schemas.world import CameraModel, FrameEncoding, SensorFrame

Encoding = Literal["jpeg", "png"]
JPEG_QUALITY: Final = 90
PNG_COMPRESSION: Final = 1  # local sockets are fast, cores are few
COMPRESSED_MAX_BYTES: Final = IMAGE_MESSAGE_MAX_BYTES
PIXELS_MAX: Final = 4096 * 4096  # 50 MB as RGB; a robot's cameras have a tenth

_DTYPES: Final = {
    FrameEncoding.BGR8: "u1",
    FrameEncoding.RGB8: "u1",
    FrameEncoding.MONO8: "u1",
    FrameEncoding.DEPTH16: "<u2",
}
COLOURS: Final = frozenset(FrameEncoding) - {FrameEncoding.DEPTH16, FrameEncoding.RAW}
"""Encodings that `as_rgb` reads."""


def encode(rgb: Any, encoding: Encoding) -> bytes:
    """Compress an RGB picture. Raises InternalError if OpenCV refuses."""
    import cv2

    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if encoding == "png":
        done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
    else:
        done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise InternalError(f"the picture could not be encoded as {encoding}")
    return bytes(data)


def as_rgb(frame: SensorFrame) -> Any:
    """Return a frame's colors.

    Raises ModelError for a frame without colors, FrameStale for a compressed one that is broken,
    too large, or of another size than its frame says.
    """
    import numpy as np

    if frame.data is None:
        raise ModelError(
            f"the frame of {frame.sensor_id} does not carry its picture",
            hint="choose a camera backend that delivers bytes",
        )
    data = np.frombuffer(frame.data, dtype=np.uint8)
    match frame.encoding:
        case FrameEncoding.RGB8:
            return data.reshape(frame.height, frame.width, 3)
        case FrameEncoding.BGR8:
            return np.ascontiguousarray(data.reshape(frame.height, frame.width, 3)[:, :, ::-1])
        case FrameEncoding.MONO8:
            return np.repeat(data.reshape(frame.height, frame.width, 1), 3, axis=2)
        case FrameEncoding.JPEG | FrameEncoding.PNG:
            return _decoded(frame, frame.data)
        case encoding:
            raise ModelError(f"a frame of {encoding} from {frame.sensor_id} has no colors")


def rgb_frame(camera: str, rgb: Any, stamp_ns: int, wall_ns: int) -> SensorFrame:
    """Return a picture (`as_rgb`) as a frame."""
    height, width = rgb.shape[:2]
    return SensorFrame(
        sensor_id=camera,
        stamp_monotonic_ns=stamp_ns,
        stamp_wall_ns=wall_ns,
        encoding=FrameEncoding.RGB8,
        width=int(width),
        height=int(height),
        data=rgb.tobytes(),
    )


def scaled_down(frame: SensorFrame, width: int) -> SensorFrame:
    """Return a frame of at most `width`, in its proportions; a narrower one as it is.

    Depths are picked, colors averaged. Raises ValueError for a frame whose pixels are not at hand:
    a compressed one is not decoded for it.
    """
    import cv2
    import numpy as np

    if frame.width <= width:
        return frame
    if frame.data is None or frame.encoding not in _DTYPES:
        raise ValueError(f"frames of {frame.encoding} are not scaled")
    shape = (frame.height, frame.width, -1)
    pixels = np.frombuffer(frame.data, dtype=_DTYPES[frame.encoding]).reshape(shape)
    height = max(1, round(frame.height * width / frame.width))
    how = cv2.INTER_NEAREST if frame.encoding is FrameEncoding.DEPTH16 else cv2.INTER_AREA
    small = cv2.resize(pixels, (width, height), interpolation=how)
    return frame.model_copy(update={"width": width, "height": height, "data": small.tobytes()})


def _decoded(frame: SensorFrame, data: bytes) -> Any:
    import cv2
    import numpy as np

    if problem := _problem(frame, data):
        raise _broken(frame, problem)
    try:
        bgr = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise _broken(frame, f"OpenCV refuses it: {error}") from error
    if bgr is None or bgr.shape[:2] != (frame.height, frame.width):
        raise _broken(frame, "it cannot be decoded")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _problem(frame: SensorFrame, data: bytes) -> str:
    """Return what forbids to decode these bytes: a decoder allocates what their header says."""
    if len(data) > COMPRESSED_MAX_BYTES:
        return f"{len(data)} bytes, {COMPRESSED_MAX_BYTES} are accepted"
    try:
        header = jpeg_header if frame.encoding is FrameEncoding.JPEG else png_header
        width, height, *_ = header(data)
    except ValueError as error:
        return str(error)
    if (width, height) != (frame.width, frame.height):
        return f"{width} × {height} pixels in a frame of {frame.width} × {frame.height}"
    if width * height > PIXELS_MAX:
        return f"{width} × {height} pixels, {PIXELS_MAX} are accepted"
    return ""


def _broken(frame: SensorFrame, problem: str) -> FrameStale:
    return FrameStale(
        f"the {frame.encoding} of camera {frame.sensor_id} is broken: {problem}",
        hint="look at the camera",
    )


class FramePicture:
    """A camera's frame as a `Picture`; its colors are decoded when they are first read."""

    model: CameraModel | None = None

    def __init__(self, frame: SensorFrame) -> None:
        self.camera = frame.sensor_id
        self.stamp_ns = frame.stamp_monotonic_ns
        self._frame = frame

    @cached_property
    def rgb(self) -> Any:
        return as_rgb(self._frame)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One rendered picture: RGB uint8 height × width × 3, when and from where it was taken."""

    camera: str
    rgb: Any
    stamp_ns: int
    model: CameraModel | None = None
