"""Cameras through the real GStreamer: what arrives, when it was taken, and how a source's end is
told.
"""

import contextlib
import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.runner.sensors.reading import CLOCK, WAIT_S, end_of, frame_of, soon
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors.gstreamer import (
    GStreamerReader,
    _Run,
    load,
    make,
    without_credentials,
)
from vram_arbiter.runner.sensors.pipelines import GStreamerParams, build
from vram_arbiter.runner.sensors.platform import Platform, probe_platform
from vram_arbiter.runner.sensors.slot import SlotReader
from vram_arbiter.schemas.config.robot import SensorBackend, SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError, FrameStale
from vram_arbiter.schemas.world import SensorFrame

pytestmark = pytest.mark.heavy
pytest.importorskip(
    "gi", reason="GStreamer's binding is not installed; .ci/setup says what to install"
)

FILE_FPS = 25
FILE_FRAMES = 50
SIZE = (96, 64)
"""Width and height of the file's pictures."""


def wrist(max_age_ms: float = 60_000.0, **params: Any) -> SensorReaderConfig:
    return SensorReaderConfig(
        sensor_id="wrist",
        backend=SensorBackend.GSTREAMER,
        backend_params=params,
        max_age_ms=max_age_ms,
    )


@pytest.fixture
def reader() -> Iterator[Callable[..., SlotReader]]:
    """`reader(pattern="red", …)` makes and starts one; stopped at teardown."""
    made: list[SlotReader] = []

    def start(max_age_ms: float = 60_000.0, tee: Any = None, **params: Any) -> SlotReader:
        made.append(make(wrist(max_age_ms, **params), CLOCK, tee))
        made[-1].start()
        return made[-1]

    yield start
    for one in made:
        one.stop()


@pytest.fixture(scope="session")
def h264_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of H.264, from black to white."""
    imageio = pytest.importorskip("imageio.v2")
    numpy = pytest.importorskip("numpy")
    path = tmp_path_factory.mktemp("video") / 'a "run" ! of today.mp4'
    with imageio.get_writer(path, fps=FILE_FPS, codec="libx264", macro_block_size=1) as writer:
        for index in range(FILE_FRAMES):
            grey = 255 * index // (FILE_FRAMES - 1)
            writer.append_data(numpy.full((SIZE[1], SIZE[0], 3), grey, numpy.uint8))
    return path


class Recorder:
    """A tee that keeps what it gets."""

    def __init__(self) -> None:
        self.frames: list[SensorFrame] = []
        self.closed = False

    def publish(self, frame: SensorFrame) -> None:
        self.frames.append(frame)

    def close(self) -> None:
        self.closed = True


# -- pictures
@pytest.mark.parametrize(
    ("encoding", "pixel"), [("bgr8", b"\x00\x00\xff"), ("rgb8", b"\xff\x00\x00")]
)
@pytest.mark.parametrize("width", [64, 101, 102, 103])
def test_colours_and_rows(
    reader: Callable[..., SlotReader], encoding: str, pixel: bytes, width: int
) -> None:
    """GStreamer pads rows to four bytes; a width of 101 came out slanted wherever that was
    forgotten.
    """
    frame = frame_of(reader(source="test", pattern="red", width=width, height=7, encoding=encoding))
    assert (frame.width, frame.height, frame.channels, frame.encoding) == (width, 7, 3, encoding)
    assert frame.data == pixel * (width * 7)


def test_grey(reader: Callable[..., SlotReader]) -> None:
    frame = frame_of(reader(source="test", pattern="white", width=33, height=5, encoding="mono8"))
    assert (frame.channels, len(frame.data or b"")) == (1, 33 * 5)
    # white, in the narrower range of video levels at the least
    assert min(frame.data or b"") >= 235


def test_depth_has_two_bytes(reader: Callable[..., SlotReader]) -> None:
    frame = frame_of(reader(source="test", pattern="white", width=33, height=5, encoding="depth16"))
    assert (frame.channels, frame.encoding, len(frame.data or b"")) == (1, "depth16", 2 * 33 * 5)
    assert set(memoryview(frame.data or b"").cast("H")) == {
        memoryview(frame.data or b"").cast("H")[0]
    }


def test_jpeg(reader: Callable[..., SlotReader]) -> None:
    cv2 = pytest.importorskip("cv2")
    numpy = pytest.importorskip("numpy")
    frame = frame_of(reader(source="test", pattern="blue", width=64, height=48, encoding="jpeg"))
    assert frame.encoding == "jpeg"
    picture = cv2.imdecode(numpy.frombuffer(frame.data, numpy.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (frame.height, frame.width, 3) == (48, 64, 3)
    blue, green, red = (int(value) for value in picture[24, 32])
    assert blue > 200
    assert green < 60
    assert red < 60


def test_every_frame_goes_to_the_tee_too(reader: Callable[..., SlotReader]) -> None:
    tee = Recorder()
    source = reader(
        tee=tee, pipeline="videotestsrc is-live=true num-buffers=5 ! video/x-raw,width=16,height=16"
    )
    end_of(source)
    assert 1 <= len(tee.frames) <= 5
    stamps = [frame.stamp_monotonic_ns for frame in tee.frames]
    assert stamps == sorted(set(stamps))
    source.stop()
    assert tee.closed


# -- time
def test_a_picture_is_as_old_as_its_stamp_says(reader: Callable[..., SlotReader]) -> None:
    """The reference took the moment of arrival for the moment of the picture: what hung in a
    decoder counted as fresh.
    """
    slow = (
        "videotestsrc is-live=true ! video/x-raw,width=16,height=16,framerate=30/1"
        " ! identity sleep-time=200000"
    )
    source = reader(pipeline=slow, max_age_ms=150.0)
    frame = frame_of(source)
    assert CLOCK.now_ns() - frame.stamp_monotonic_ns >= 200_000_000
    with pytest.raises(FrameStale, match="ms old, 150 ms are accepted"):
        source.read_latest()


def test_stamps_are_of_the_monotonic_clock(reader: Callable[..., SlotReader]) -> None:
    source = reader(source="test", width=16, height=16)
    called_ns = CLOCK.now_ns()
    first = source.read_synced(soon())
    assert called_ns < first.stamp_monotonic_ns <= CLOCK.now_ns()
    assert (
        abs(
            (first.stamp_wall_ns - first.stamp_monotonic_ns)
            - (time.time_ns() - time.monotonic_ns())
        )
        < 60 * 10**9
    )
    assert source.read_synced(soon()).stamp_monotonic_ns > first.stamp_monotonic_ns


class Halted(SystemClock):
    """A busy machine: whoever asks it for the time is stopped for a moment first."""

    def __init__(self) -> None:
        self.asked_ns: list[int] = []

    def now_ns(self) -> int:
        self.asked_ns.append(super().now_ns())
        threading.Event().wait(0.05)
        return super().now_ns()


def run_of(clock: SystemClock, pipeline: str) -> _Run:
    """A pipeline whose thread is the test."""
    params = GStreamerParams(pipeline=pipeline)
    return _Run(load(), build(params, probe_platform()), params, "wrist", clock)


def test_a_thread_that_is_stopped_makes_no_picture_younger() -> None:
    """Regression: the age was taken first and the time later; a stop in between was missing in the
    age.
    """
    clock = Halted()
    run = run_of(clock, "videotestsrc is-live=true ! video/x-raw,width=16,height=16")
    run.open()
    try:
        frame = None
        while frame is None:
            clock.asked_ns.clear()
            frame = run.next_frame()
        assert frame.stamp_monotonic_ns <= clock.asked_ns[0], (
            "by then it had been taken out of the pipeline"
        )
    finally:
        run.close()


# -- files
def brightness(frame: SensorFrame) -> int:
    return (frame.data or b"\0")[len(frame.data or b"\0") // 2]


def test_an_h264_file_plays_at_its_rate_and_ends(
    reader: Callable[..., SlotReader], h264_file: Path
) -> None:
    tee = Recorder()  # sees every picture that the sink kept, however slow this test is
    source = reader(
        source="file", path=str(h264_file), platform="cpu_only", encoding="rgb8", tee=tee
    )
    assert end_of(source) == "the stream is over"
    assert {(frame.width, frame.height) for frame in tee.frames} == {SIZE}
    levels = [brightness(frame) for frame in tee.frames]
    assert levels == sorted(levels)
    assert levels[-1] > 200, "the last picture is taken"
    stamps = [frame.stamp_monotonic_ns for frame in tee.frames]
    spans_s = [(later - sooner) / 1e9 for sooner, later in itertools.pairwise(stamps)]
    assert min(spans_s, default=1.0) > 0.9 / FILE_FPS, "played faster than it was taken"
    with pytest.raises(FrameStale, match="the stream is over"):
        source.read_latest(1e9)


def test_a_file_begins_again(reader: Callable[..., SlotReader], h264_file: Path) -> None:
    source = reader(source="file", path=str(h264_file), platform="cpu_only", loop=True)
    begun_s: list[float] = []  # when each round began, by the pictures' stamps and what they show
    while len(begun_s) < 3:
        frame = frame_of(source)
        at_s = (
            frame.stamp_monotonic_ns / 1e9
            - round(brightness(frame) / 255 * (FILE_FRAMES - 1)) / FILE_FPS
        )
        if not begun_s or at_s > begun_s[-1] + FILE_FRAMES / FILE_FPS / 2:
            begun_s.append(at_s)
        assert at_s == pytest.approx(begun_s[-1], abs=3 / FILE_FPS), (
            "in order between two beginnings"
        )


def test_a_file_is_scaled(reader: Callable[..., SlotReader], h264_file: Path) -> None:
    source = reader(source="file", path=str(h264_file), platform="cpu_only", width=31, height=21)
    frame = frame_of(source)
    assert (frame.width, frame.height, len(frame.data or b"")) == (31, 21, 31 * 21 * 3)


@pytest.mark.parametrize(
    ("platform", "on_gpu"),
    # a Jetson's decoder is no CUDA context: its memory is the board's own
    [(Platform.NVIDIA_DESKTOP, True), (Platform.CPU_ONLY, False), (Platform.TEGRA, False)],
)
def test_a_decoder_of_an_nvidia_gpu_asks_for_a_lease(platform: Platform, on_gpu: bool) -> None:
    """`deploy` takes its lease for as many cameras as say so."""
    for codec in ("h264", "h265"):
        params = GStreamerParams(source="rtsp", url="rtsp://10.0.0.7/main", codec=codec)
        text = build(params, platform)
        assert GStreamerReader("hall", 100, params, text, CLOCK).decodes_on_gpu is on_gpu
    raw = GStreamerParams(source="v4l2", device="/dev/video0")
    text = build(raw, platform)
    assert not GStreamerReader("wrist", 100, raw, text, CLOCK).decodes_on_gpu


def test_a_file_that_is_no_video(reader: Callable[..., SlotReader], tmp_path: Path) -> None:
    path = tmp_path / "notes.mp4"
    path.write_text("not a film" * 1000, encoding="utf-8")
    with pytest.raises(FrameStale, match="cannot be opened") as caught:
        reader(source="file", path=str(path), platform="cpu_only")
    assert caught.value.details["ended"]


def test_a_csi_pipeline_negotiates_and_is_refused_where_argus_is_not() -> None:
    """Here with a test picture in place of the camera and the CPU in place of its converter."""
    params = GStreamerParams(source="csi", sensor_index=0, width=64, height=48, fps=30)
    text = build(params, Platform.TEGRA)
    gst = load().gst
    caps = gst.Caps.from_string(next(part for part in text.split(" ! ") if "NVMM" in part))
    assert caps.get_features(0).to_string() == "memory:NVMM"
    assert caps.get_structure(0).to_string().startswith("video/x-raw, format=(string)NV12")
    for jetsons, everyones in {
        "nvarguscamerasrc sensor-id=0": "videotestsrc is-live=true pattern=red",
        "(memory:NVMM)": "",
        "nvvidconv": "videoconvert",
    }.items():
        assert jetsons in text
        text = text.replace(jetsons, everyones)
    source = GStreamerReader("wrist", 60_000.0, params, text, CLOCK)
    source.start()
    frame = frame_of(source)
    source.stop()
    assert (frame.width, frame.height, frame.encoding) == (64, 48, "bgr8")
    if gst.ElementFactory.find("nvarguscamerasrc") is None:
        with pytest.raises(ConfigError, match="only a Jetson has it"):
            make(wrist(source="csi", sensor_index=0), CLOCK, None)


# -- ends
def test_an_error_on_the_bus_ends_the_reader(reader: Callable[..., SlotReader]) -> None:
    source = reader(
        pipeline="videotestsrc is-live=true ! video/x-raw,width=16,height=16 ! identity name=cable"
        " error-after=4"
    )
    assert end_of(source).startswith("cable: ")
    assert source.slot.ended is not None
    with pytest.raises(FrameStale, match="cable"):
        source.read_latest(1e9)


def test_formats_that_do_not_meet_end_it_with_a_reason(reader: Callable[..., SlotReader]) -> None:
    """An own appsink gets the encoding that was asked for, never silently another one."""
    own = (
        "videotestsrc is-live=true ! video/x-raw,format=I420,width=16,height=16 ! appsink name=sink"
    )
    source = make(wrist(pipeline=own), CLOCK, None)
    with contextlib.suppress(FrameStale):  # said at once, or a moment later
        source.start()
    assert "not-negotiated" in end_of(source)
    source.stop()


def test_a_camera_that_is_not_there(reader: Callable[..., SlotReader]) -> None:
    with pytest.raises(
        FrameStale, match=r"wrist cannot be opened: v4l2src\d+: .*/dev/video99"
    ) as caught:
        reader(source="v4l2", device="/dev/video99")
    assert caught.value.details["ended"]


def test_stop_wakes_waiters_ends_the_thread_and_start_begins_anew(
    reader: Callable[..., SlotReader],
) -> None:
    source = reader(
        pipeline="videotestsrc is-live=true pattern=red ! video/x-raw,width=16,height=16"
    )
    frame_of(source)
    (thread,) = [thread for thread in threading.enumerate() if thread.name == "camera-wrist"]
    source.stop()
    source.stop()
    thread.join(WAIT_S)
    assert not thread.is_alive()
    with pytest.raises(FrameStale, match="stopped"):
        source.read_latest(1e9)
    source.start()
    assert frame_of(source).data == b"\x00\x00\xff" * 256


# -- refused before anything is opened
@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({"pipeline": "videotestsrc ! nosuchthing"},
         'backend_params.pipeline: no element "nosuchthing"'),
        ({"pipeline": "videotestsrc patern=ball"}, 'no property "patern"'),
        ({"pipeline": "videotestsrc ! appsink name=mine"}, "has no appsink named sink"),
        ({"pipeline": "appsink name=sink"}, "has no appsink named sink"),
        ({"source": "test", "pattern": "plaid"}, "pattern"),
        ({"source": "test", "patern": "ball"},
         "backend_params.patern: unknown key; did you mean pattern?"),
        ({"source": "file", "path": "/no/such.mp4"},
         "backend_params.path: file not found: /no/such.mp4"),
        ({"source": "v4l2", "device": "/dev/video0", "codec": "h264", "platform": "tegra"},
         "or say platform: cpu_only to decode on the CPU"),
    ],
)  # fmt: skip
def test_mistakes_are_named(params: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make(wrist(**params), CLOCK, None)
    assert problem in caught.value.message


def test_no_password_in_messages() -> None:
    text = "rtspsrc0: Could not open rtsp://robot:secret@10.0.0.7:554/main (Unauthorized)"
    assert (
        without_credentials(text)
        == "rtspsrc0: Could not open rtsp://10.0.0.7:554/main (Unauthorized)"
    )


# -- beside the other heavy packages
TAKE_ONE = """
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors.gstreamer import make
from vram_arbiter.schemas.config.robot import SensorReaderConfig
params = {"source": "test", "pattern": "red", "width": 16, "height": 16}
clock = SystemClock()
config = SensorReaderConfig(sensor_id="wrist", backend="gstreamer", backend_params=params)
camera = make(config, clock, None)
camera.start()
assert camera.read_synced(clock.now_ns() + 60 * 10**9).data == b"\\x00\\x00\\xff" * 256
camera.stop()
"""


def fresh(code: str) -> str:
    """What a program of its own prints. It has to end well."""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=240
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.nightly  # other libraries' doing; each imports torch once more
@pytest.mark.parametrize(
    "order", ["import torch, cv2\n{}", "{}\nimport cv2, torch\ncv2.setNumThreads(1)\n{}"]
)
def test_it_lives_with_opencv_and_torch(order: str) -> None:
    """Reported of the reference: a crash that depended on which of them brought GLib up first."""
    pytest.importorskip("cv2")
    fresh(order.format(TAKE_ONE, TAKE_ONE))


def test_what_throws_in_cpp_lives_on_after_it() -> None:
    """Regression: with GStreamer's libunwind in the process, the next C++ exception (matplotlib
    throws and catches one as it is imported) ended it with a segmentation fault.
    """
    pytest.importorskip("matplotlib")
    draws = (
        "import matplotlib; matplotlib.use('Agg'); import matplotlib.pyplot as p; "
        "p.figure().savefig('/dev/null', format='png')"
    )
    fresh(f"import zmq, numpy\n{TAKE_ONE}\n{draws}")


def test_importing_it_loads_no_gstreamer() -> None:
    loaded = (
        "import sys, vram_arbiter.runner.sensors.gstreamer\nprint([name for name in ('gi', 'cv2', "
        "'torch', 'numpy') if name in sys.modules])"
    )
    assert fresh(loaded).strip() == "[]"
