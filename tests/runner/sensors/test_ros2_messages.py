"""ROS picture messages: bytes as Cyclone DDS writes them, meanings as REP 118 and image_transport
have them, contradictions refused.
"""

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.runner.small_robots import frame_at

pytestmark = pytest.mark.heavy
pytest.importorskip("rosbags")

from vram_arbiter.runner.sensors.ros2_messages import (  # noqa: E402
    COMPRESSED,
    IMAGE,
    ImageContent,
    jpeg_size,
    message_of,
    picture_of,
    stamp_of,
)
from vram_arbiter.runner.sensors.ros2_types import RosMessage, read, write  # noqa: E402
from vram_arbiter.schemas.world import FrameEncoding  # noqa: E402

stamps = st.integers(0, (2**31 - 1) * 10**9)
names = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=20)


def header(stamp_ns: int, frame_id: str) -> RosMessage:
    return {"stamp": stamp_of(stamp_ns), "frame_id": frame_id}


def compressed(form: str, data: bytes) -> RosMessage:
    return {"header": header(1, "cam"), "format": form, "data": data}


def image(**changes: Any) -> RosMessage:
    fields: RosMessage = {
        "header": header(5, "cam"),
        "height": 2,
        "width": 3,
        "encoding": "rgb8",
        "is_bigendian": 0,
        "step": 9,
        "data": bytes(range(18)),
    }
    return {**fields, **changes}


def jpeg(height: int = 4, width: int = 6, channels: int = 3) -> bytes:
    """The frame of a JPEG without a picture in it."""
    table = b"\xff\xdb" + struct.pack(">H", 67) + bytes(65)
    head = (
        b"\xff\xc0"
        + struct.pack(">HBHHB", 8 + 3 * channels, 8, height, width, channels)
        + bytes(3 * channels)
    )
    return b"\xff\xd8" + table + b"\xff" + head + b"\xff\xda\x00\x02data\xff\xd9"


@given(stamps, names, names, st.booleans(), st.binary(max_size=40), st.integers(0, 2**32 - 1))
def test_an_image_survives_the_wire(
    stamp_ns: int, frame_id: str, encoding: str, big: bool, data: bytes, step: int
) -> None:
    message = image(
        header=header(stamp_ns, frame_id),
        encoding=encoding,
        is_bigendian=int(big),
        step=step,
        data=data,
    )
    assert read(IMAGE, write(IMAGE, message)) == message


@given(stamps, names, names, st.binary(max_size=40))
def test_a_compressed_image_survives_the_wire(
    stamp_ns: int, frame_id: str, form: str, data: bytes
) -> None:
    message = {"header": header(stamp_ns, frame_id), "format": form, "data": data}
    assert read(COMPRESSED, write(COMPRESSED, message)) == message


@given(st.binary(max_size=120), st.integers(0, 60))
def test_any_bytes_are_read_or_refused(noise: bytes, cut: int) -> None:
    for data in (noise, b"\x00\x01\x00\x00" + noise, write(IMAGE, image())[: -1 - cut]):
        for kind in (IMAGE, COMPRESSED):
            try:
                assert read(kind, data).keys() == read(kind, write(kind, {})).keys()
            except ValueError:
                continue


@given(st.binary(max_size=200))
def test_any_bytes_are_a_jpeg_or_refused(noise: bytes) -> None:
    for data in (noise, b"\xff\xd8" + noise, jpeg()[:30] + noise):
        try:
            shape = jpeg_size(data)
        except ValueError:
            continue
        assert min(shape) > 0


@pytest.mark.parametrize(
    ("encoding", "ours", "channels", "per_pixel"),
    [
        ("bgr8", "bgr8", 3, 3),
        ("8UC3", "bgr8", 3, 3),
        ("rgb8", "rgb8", 3, 3),
        ("mono8", "mono8", 1, 1),
        ("8UC1", "mono8", 1, 1),
        ("16UC1", "depth16", 1, 2),
    ],
)
def test_encodings(encoding: str, ours: str, channels: int, per_pixel: int) -> None:
    data = bytes(range(6 * per_pixel))
    picture = picture_of(IMAGE, image(encoding=encoding, step=3 * per_pixel, data=data))
    assert picture == ImageContent(FrameEncoding(ours), 3, 2, channels, data)


def test_padding_of_rows_is_left_out() -> None:
    picture = picture_of(IMAGE, image(step=12, data=b"abcdefghi\0\0\0jklmnopqr\0\0\0"))
    assert picture.data == b"abcdefghijklmnopqr"


def test_big_endian_depth_is_turned_around() -> None:
    depths = (1, 300, 65_535, 2, 0, 1000)
    message = image(encoding="16UC1", is_bigendian=1, step=6, data=struct.pack(">6H", *depths))
    assert struct.unpack("<6H", picture_of(IMAGE, message).data) == depths


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"encoding": "bayer_rggb8"}, "'bayer_rggb8' is not supported"),
        ({"encoding": "mono16"}, "not supported"),
        ({"width": 0}, "0 × 2 pixels"),
        ({"width": 4}, "do not make"),
        ({"data": bytes(17)}, "in 17 bytes"),
        ({"height": 2**32 - 1, "data": b""}, "pixels"),
    ],
)
def test_contradictions_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        picture_of(IMAGE, image(**changes))


@pytest.mark.parametrize("form", ["jpeg", "jpg", "rgb8; jpeg compressed bgr8"])
def test_a_jpeg_knows_its_size(form: str) -> None:
    picture = picture_of(COMPRESSED, compressed(form, jpeg(4, 6, 3)))
    assert (picture.encoding, picture.width, picture.height, picture.channels) == ("jpeg", 6, 4, 3)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"\x89PNG\r\n", "not a JPEG"),
        (jpeg()[:-2], "cut off"),
        (jpeg()[:40], "ends before"),
        (b"\xff\xd8\xff\xda\x00\x02\xff\xd9", "no frame header"),
        (jpeg(0, 6, 3), "6 × 0 pixels"),
        (jpeg(4, 6, 4), "4 channels"),
    ],
)
def test_a_broken_jpeg_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        picture_of(COMPRESSED, compressed("jpeg", data))


def test_other_compressions_are_refused() -> None:
    with pytest.raises(ValueError, match="compressedDepth"):
        picture_of(COMPRESSED, compressed("16UC1; compressedDepth png", b"x"))


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "mono8", "16UC1"])
def test_frames_become_the_messages_that_they_came_from(encoding: str) -> None:
    per_pixel = {"mono8": 1, "16UC1": 2}.get(encoding, 3)
    message = image(encoding=encoding, step=3 * per_pixel, data=bytes(6 * per_pixel))
    picture = picture_of(IMAGE, message)
    names = ("encoding", "width", "height", "channels", "data")
    shown = {name: getattr(picture, name) for name in names}
    frame = frame_at(1, "cam", stamp_wall_ns=5, **shown)
    kind, back = message_of(frame)
    assert (kind, read(kind, write(kind, back))) == (IMAGE, message)
    with pytest.raises(ValueError, match="no name in ROS"):
        message_of(frame.model_copy(update={"encoding": FrameEncoding.RAW}))
    with pytest.raises(ValueError, match="2038"):
        message_of(frame.model_copy(update={"stamp_wall_ns": 2**31 * 10**9}))
