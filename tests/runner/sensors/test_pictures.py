"""Frames become RGB whatever the camera speaks, and what has no colours is refused."""

from typing import Any

import pytest

from vram_arbiter.runner.sensors.pictures import as_rgb
from vram_arbiter.schemas.errors import FrameStale, ModelError
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

pytestmark = pytest.mark.heavy

RED_BLUE = [[[255, 0, 0], [0, 0, 255]]]


def frame(encoding: FrameEncoding, data: bytes | None = None, **more: Any) -> SensorFrame:
    fields = {"width": 2, "height": 1, "stamp_monotonic_ns": 1, "stamp_wall_ns": 1, **more}
    return SensorFrame(sensor_id="front", encoding=encoding, data=data, **fields)


def test_raw_frames() -> None:
    assert as_rgb(frame(FrameEncoding.RGB8, bytes([255, 0, 0, 0, 0, 255]))).tolist() == RED_BLUE
    assert as_rgb(frame(FrameEncoding.BGR8, bytes([0, 0, 255, 255, 0, 0]))).tolist() == RED_BLUE
    assert as_rgb(frame(FrameEncoding.MONO8, bytes([7, 9]))).tolist() == [[[7, 7, 7], [9, 9, 9]]]


def test_compressed_frames() -> None:
    import cv2
    import numpy as np

    bgr = np.array(RED_BLUE, dtype=np.uint8)[:, :, ::-1]
    png = bytes(cv2.imencode(".png", bgr)[1])
    assert as_rgb(frame(FrameEncoding.PNG, png)).tolist() == RED_BLUE
    with pytest.raises(FrameStale, match="broken"):
        as_rgb(frame(FrameEncoding.PNG, png, width=3))
    with pytest.raises(FrameStale, match="broken"):
        as_rgb(frame(FrameEncoding.JPEG, b"no picture at all"))


def test_what_has_no_colours_is_refused() -> None:
    with pytest.raises(ModelError, match="depth16"):
        as_rgb(frame(FrameEncoding.DEPTH16, bytes(4)))
    with pytest.raises(ModelError, match="does not carry"):
        as_rgb(frame(FrameEncoding.RGB8, topic="/front"))
