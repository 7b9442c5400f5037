"""Frames as arrays that skills and encoders can use: RGB uint8, height × width × 3, whatever the camera speaks.

What cannot be turned into colours (depth, a handle on a device, a topic's name) is refused; nothing is filled in.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from vram_arbiter.schemas.errors import FrameStale, ModelError
from vram_arbiter.schemas.world import CameraModel, FrameEncoding, SensorFrame


def as_rgb(frame: SensorFrame) -> Any:
    """Raises ModelError for a frame that has no colours here, FrameStale for a compressed one that is broken."""
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
            import cv2

            bgr = cv2.imdecode(data, cv2.IMREAD_COLOR)
            if bgr is None or bgr.shape[:2] != (frame.height, frame.width):
                raise FrameStale(
                    f"the {frame.encoding} of camera {frame.sensor_id} is broken",
                    hint="look at the camera",
                )
            return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        case encoding:
            raise ModelError(f"a frame of {encoding} from {frame.sensor_id} has no colours")


class FramePicture:
    """A camera's frame as `runner.goals.frames.Snapshot`; its colours are made where they are first asked for."""

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
    """One rendered or read picture: RGB uint8 height × width × 3, when it was taken, and where its camera stood then."""

    camera: str
    rgb: Any
    stamp_ns: int
    model: CameraModel | None = None
