"""Frames become RGB whatever the camera speaks, and what has no colours is refused."""

import struct
from typing import Any

import pytest

from vram_arbiter.runner.sensors.pictures import COMPRESSED_MAX_BYTES, as_rgb, scaled_down
from vram_arbiter.schemas.errors import FrameStale, ModelError
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

pytestmark = pytest.mark.heavy

RED_BLUE = [[[255, 0, 0], [0, 0, 255]]]


def frame_of(encoding: FrameEncoding, data: bytes | None = None, **more: Any) -> SensorFrame:
    fields = {"width": 2, "height": 1, "stamp_monotonic_ns": 1, "stamp_wall_ns": 1, **more}
    return SensorFrame(sensor_id="front", encoding=encoding, data=data, **fields)


def test_raw_frames() -> None:
    assert as_rgb(frame_of(FrameEncoding.RGB8, bytes([255, 0, 0, 0, 0, 255]))).tolist() == RED_BLUE
    assert as_rgb(frame_of(FrameEncoding.BGR8, bytes([0, 0, 255, 255, 0, 0]))).tolist() == RED_BLUE
    assert as_rgb(frame_of(FrameEncoding.MONO8, bytes([7, 9]))).tolist() == [[[7, 7, 7], [9, 9, 9]]]


def test_compressed_frames() -> None:
    import cv2
    import numpy as np

    bgr = np.array(RED_BLUE, dtype=np.uint8)[:, :, ::-1]
    png = bytes(cv2.imencode(".png", bgr)[1])
    assert as_rgb(frame_of(FrameEncoding.PNG, png)).tolist() == RED_BLUE
    with pytest.raises(FrameStale, match="broken"):
        as_rgb(frame_of(FrameEncoding.PNG, png, width=3))
    with pytest.raises(FrameStale, match="broken"):
        as_rgb(frame_of(FrameEncoding.JPEG, b"no picture at all"))


def test_frames_are_scaled_down_and_never_up() -> None:
    gray = frame_of(FrameEncoding.MONO8, bytes([10, 20, 30, 40]), width=4)
    small = scaled_down(gray, 2)
    assert (small.width, small.height, small.data) == (2, 1, bytes([15, 35]))  # averaged
    depth = struct.pack("<8H", *([100] * 4 + [900] * 4))
    far = scaled_down(frame_of(FrameEncoding.DEPTH16, depth, width=4, height=2), 2)
    assert struct.unpack("<2H", far.data or b"")[0] in (100, 900)  # picked: no depth in between
    assert scaled_down(gray, 4) is gray
    with pytest.raises(ValueError, match="jpeg are not scaled"):
        scaled_down(frame_of(FrameEncoding.JPEG, b"\xff\xd8"), 1)


@pytest.mark.parametrize(
    ("encoding", "start"),
    [
        (
            FrameEncoding.PNG,
            b"\x89PNG\r\n\x1a\n"
            + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 60_000, 60_000, 8, 2, 0, 0, 0),
        ),
        (
            FrameEncoding.JPEG,
            b"\xff\xd8\xff\xc0" + struct.pack(">HBHHB", 17, 8, 60_000, 60_000, 3) + bytes(9),
        ),
    ],
)
def test_a_header_that_asks_for_gigabytes_is_refused_before_it_is_decoded(
    encoding: FrameEncoding, start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera's or a network's 40 bytes made the decoder allocate 10 GB on the control thread."""
    import cv2

    def decode(*_: Any) -> None:
        raise AssertionError("the decoder saw the bytes")

    monkeypatch.setattr(cv2, "imdecode", decode)
    with pytest.raises(FrameStale, match=r"broken: 60000 × 60000 pixels in a frame of 2 × 1"):
        as_rgb(frame_of(encoding, start + bytes(40)))
    with pytest.raises(FrameStale, match=r"broken: 60000 × 60000 pixels, 16777216 are accepted"):
        as_rgb(frame_of(encoding, start + bytes(40), width=60_000, height=60_000))


def test_a_frame_of_too_many_bytes_is_refused() -> None:
    """Decoding time grows with the bytes, and the control loop waits for it."""
    with pytest.raises(FrameStale, match="16777217 bytes, 16777216 are accepted"):
        as_rgb(frame_of(FrameEncoding.JPEG, b"\xff\xd8" + bytes(COMPRESSED_MAX_BYTES - 1)))


def test_what_has_no_colours_is_refused() -> None:
    with pytest.raises(ModelError, match="depth16"):
        as_rgb(frame_of(FrameEncoding.DEPTH16, bytes(4)))
    with pytest.raises(ModelError, match="does not carry"):
        as_rgb(frame_of(FrameEncoding.RGB8, topic="/front"))
