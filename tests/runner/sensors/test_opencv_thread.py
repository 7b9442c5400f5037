"""The OpenCV reader on real sources: video files, a stream over RTSP that breaks off and comes
back, a device that is not there.
"""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors import SlotReader
from vram_arbiter.runner.sensors.factory import make_reader
from vram_arbiter.runner.sensors.opencv_thread import OpenCvReader, as_encoding, without_credentials
from vram_arbiter.schemas.config.robot import SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError, FrameStale
from vram_arbiter.schemas.world import SensorFrame

pytestmark = pytest.mark.heavy  # OpenCV

Reading = Callable[[SlotReader], SlotReader]
NO_DEVICE = next(number for number in range(200, 256) if not os.path.exists(f"/dev/video{number}"))


class Shelf:
    """A tee that keeps every picture."""

    def __init__(self) -> None:
        self.frames: list[SensorFrame] = []

    def publish(self, frame: SensorFrame) -> None:
        self.frames.append(frame)

    def close(self) -> None:
        pass


def camera(**params: Any) -> SensorReaderConfig:
    return SensorReaderConfig(sensor_id="front", backend_params=params, max_age_ms=60_000.0)


def reader_of(shelf: Shelf | None = None, **params: Any) -> SlotReader:
    reader = make_reader(camera(**params), SystemClock())
    reader._tee = shelf
    return reader


def grey(frame: SensorFrame) -> int:
    import numpy as np

    return round(float(np.frombuffer(frame.data or b"", dtype=np.uint8).mean()))


def wait_for_end(reader: SlotReader) -> str:
    """Why the source ended, as everybody who reads is told; waits at most a minute."""
    with reader.slot._changed:
        assert reader.slot._changed.wait_for(lambda: reader.slot._ended, 60), "it did not end"
    with pytest.raises(FrameStale) as gone:
        reader.read_latest(60_000.0)
    return str(gone.value)


def test_a_file_is_played_in_order_at_its_rate_and_then_ends(
    make_video: Callable[..., Path], started_reader: Reading
) -> None:
    shelf = Shelf()
    path = make_video([40, 80, 120, 160, 200], fps=50.0)
    begun_ns = SystemClock().now_ns()
    reader = started_reader(reader_of(shelf, path=str(path)))
    assert "video.avi is over after 5 pictures" in wait_for_end(reader)
    assert [grey(frame) for frame in shelf.frames] == pytest.approx([40, 80, 120, 160, 200], abs=3)
    first = shelf.frames[0]
    assert (first.sensor_id, first.encoding, first.width, first.height, first.channels) == (
        "front", "bgr8", 64, 48, 3,
    )  # fmt: skip
    for index, frame in enumerate(shelf.frames):
        # each at its time, never before
        assert frame.stamp_monotonic_ns - begun_ns >= index * 20_000_000


def test_the_rate_can_be_given_and_is_kept(
    make_video: Callable[..., Path], started_reader: Reading
) -> None:
    # two and a half minutes, longer than the wait for the end
    slow = make_video([10, 20, 30], fps=0.02)
    assert "over after 3 pictures" in wait_for_end(
        started_reader(reader_of(path=str(slow), fps=500.0))
    )


def test_a_file_that_loops_begins_again(
    make_video: Callable[..., Path], started_reader: Reading
) -> None:
    shelf = Shelf()
    reader = started_reader(reader_of(shelf, path=str(make_video([50, 150], fps=200.0)), loop=True))
    deadline_ns = SystemClock().now_ns() + 60 * 10**9
    while len(shelf.frames) < 5:
        reader.read_synced(deadline_ns)
    assert reader.slot.ended is None
    assert [grey(frame) for frame in shelf.frames[:5]] == pytest.approx(
        [50, 150, 50, 150, 50], abs=3
    )


def test_a_file_that_is_no_video_ends_with_the_reason(
    tmp_path: Path, started_reader: Reading
) -> None:
    path = tmp_path / "notes.avi"
    path.write_text("not a video\n")
    assert "cannot be read as a video" in wait_for_end(started_reader(reader_of(path=str(path))))
    path.write_text("")
    assert "cannot be read as a video" in wait_for_end(started_reader(reader_of(path=str(path))))


@pytest.mark.parametrize(("encoding", "channels"), [("rgb8", 3), ("mono8", 1)])
def test_encodings(
    make_video: Callable[..., Path], started_reader: Reading, encoding: str, channels: int
) -> None:
    shelf = Shelf()
    wait_for_end(
        started_reader(reader_of(shelf, path=str(make_video([90], fps=100.0)), encoding=encoding))
    )
    frame = shelf.frames[0]
    assert (frame.encoding, frame.channels, len(frame.data or b"")) == (
        encoding,
        channels,
        64 * 48 * channels,
    )
    assert grey(frame) == pytest.approx(90, abs=3)


def test_colours_stand_where_the_encoding_says() -> None:
    import cv2
    import numpy as np

    blue = np.zeros((2, 2, 3), dtype=np.uint8)
    blue[..., 0] = 255
    assert tuple(as_encoding(cv2, blue, "bgr8")[0, 0]) == (255, 0, 0)
    assert tuple(as_encoding(cv2, blue, "rgb8")[0, 0]) == (0, 0, 255)
    assert as_encoding(cv2, blue, "mono8").shape == (2, 2)
    one = np.full((2, 2, 1), 7, dtype=np.uint8)
    assert as_encoding(cv2, one, "mono8").shape == (2, 2)
    assert as_encoding(cv2, one, "rgb8").shape == (2, 2, 3)


def test_a_reader_can_be_started_again(make_video: Callable[..., Path]) -> None:
    shelf = Shelf()
    reader = reader_of(shelf, path=str(make_video([60, 70], fps=100.0)))
    for _ in range(2):
        reader.start()
        wait_for_end(reader)
        reader.stop()
        with pytest.raises(FrameStale):
            reader.read_latest()
    assert [grey(frame) for frame in shelf.frames] == pytest.approx([60, 70, 60, 70], abs=3)


def test_opencv_works_with_one_thread(
    make_video: Callable[..., Path], started_reader: Reading
) -> None:
    import cv2

    cv2.setNumThreads(2)
    wait_for_end(started_reader(reader_of(path=str(make_video([60], fps=100.0)))))
    assert cv2.getNumThreads() == 1


def test_a_stream_that_breaks_off_is_opened_again_and_given_up_in_the_end(
    make_video: Callable[..., Path], make_rtsp: Callable[[bytes], Any], started_reader: Reading
) -> None:
    server = make_rtsp(make_video([100] * 50, name="a.ts", fourcc="mpg2").read_bytes())
    shelf = Shelf()
    url = f"rtsp://user:secret@127.0.0.1:{server.port}/front?key=hidden"
    reader = started_reader(
        reader_of(shelf, url=url, reconnect_tries=2, reconnect_s=0.01, timeout_s=20.0)
    )
    deadline_ns = SystemClock().now_ns() + 60 * 10**9
    assert grey(reader.read_synced(deadline_ns)) == pytest.approx(96, abs=8)
    before = len(shelf.frames)
    server.over.set()
    while server.played < 2 or len(shelf.frames) <= before:
        reader.read_synced(deadline_ns)  # waits through the interruption
    server.close()
    said = wait_for_end(reader)
    assert (
        f"rtsp://127.0.0.1:{server.port}/front cannot be opened, given up after 2 new tries" in said
    )
    assert "secret" not in said
    assert "hidden" not in said


class Shifted(SystemClock):
    """The machine's clock, which a test moves on."""

    shift_ns = 0

    def now_ns(self) -> int:
        return super().now_ns() + self.shift_ns


@pytest.mark.parametrize("stamp", ["source", "arrival"])
def test_pictures_that_waited_in_the_network_are_as_old_as_they_are(
    make_video: Callable[..., Path],
    make_rtsp: Callable[[bytes], Any],
    started_reader: Reading,
    stamp: str,
) -> None:
    server = make_rtsp(make_video([100] * 100, name="a.ts", fourcc="mpg2").read_bytes())
    server.hold = threading.Event()
    shelf, clock = Shelf(), Shifted()
    url = f"rtsp://127.0.0.1:{server.port}/"
    reader = make_reader(camera(url=url, reconnect_tries=0, timeout_s=20.0, stamp=stamp), clock)
    reader._tee = shelf
    started_reader(reader)
    with reader.slot._changed:
        assert reader.slot._changed.wait_for(lambda: len(shelf.frames) >= 20, 60)
    begun_ns = clock.now_ns()
    clock.shift_ns = 100 * 10**9  # the network stands still for a hundred seconds
    server.hold.set()
    server.over.set()
    wait_for_end(reader)
    late = shelf.frames[-1]
    age_s = (clock.now_ns() - late.stamp_monotonic_ns) / 1e9
    if stamp == "arrival":
        assert late.stamp_monotonic_ns >= begun_ns + 100 * 10**9
    else:
        # a hundred, less the four that the stream lasts, and what this test took
        assert 90 < age_s < 170
        assert late.stamp_wall_ns <= clock.wall_ns() - 90 * 10**9


def test_a_device_that_is_not_there_is_tried_and_given_up(started_reader: Reading) -> None:
    reader = started_reader(reader_of(device=NO_DEVICE, reconnect_tries=1, reconnect_s=0.01))
    assert f"device {NO_DEVICE} cannot be opened, given up after 1 new tries" in wait_for_end(
        reader
    )


def test_stopping_does_not_wait_for_the_next_try(started_reader: Reading) -> None:
    reader = reader_of(device=NO_DEVICE, reconnect_tries=5, reconnect_s=3600.0)
    reader.start()
    assert isinstance(reader, OpenCvReader)
    thread = reader._thread
    assert thread is not None
    reader.stop()
    thread.join(30)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({}, "one of device, path and url, not none"),
        ({"device": 0, "url": "rtsp://a/b"}, "not device and url"),
        ({"device": 0, "loop": True}, "not for a device: loop"),
        ({"path": "x.avi", "stamp": "arrival"}, "not for a path: stamp"),
        ({"path": "x.avi", "reconnect_tries": 3}, "not for a path: reconnect_tries"),
        ({"url": "rtsp://a/b", "fps": 30.0}, "not for a url: fps"),
        ({"url": "ftp://a/b"}, "url begins with one of rtsp://"),
        ({"device": "0"}, "backend_params.device: must be a valid integer, not '0'"),
        ({"device": True}, "backend_params.device"),
        ({"device": 0, "width": 640}, "width and height go together"),
        ({"device": 0, "widht": 640}, "backend_params.widht: unknown key; did you mean width?"),
        ({"path": "not-there.avi"}, "file not found: not-there.avi"),
    ],
)
def test_wrong_parameters_are_refused_before_anything_starts(
    params: dict[str, Any], problem: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        make_reader(camera(**params), SystemClock())
    assert problem in str(refused.value)


def test_credentials_are_not_shown() -> None:
    assert without_credentials("rtsp://u:p@ss@cam:554/a?token=1#x") == "rtsp://cam:554/a"
