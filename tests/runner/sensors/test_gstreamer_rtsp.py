"""Streams of network cameras through the real rtspsrc: a server on loopback sends GStreamer's own
RTP packets.
"""

import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.runner.sensors.conftest import RtspServer
from tests.runner.sensors.reading import CLOCK, end_of, frame_of
from vram_arbiter.runner.sensors.factory import make_reader
from vram_arbiter.runner.sensors.slot import SlotReader
from vram_arbiter.schemas.config.robot import SensorBackend, SensorReaderConfig
from vram_arbiter.schemas.errors import FrameStale

pytestmark = pytest.mark.heavy
pytest.importorskip(
    "gi", reason="GStreamer's binding is not installed; .ci/setup says what to install"
)

SIZE = (96, 64)
"""Width and height of what the camera sends."""
FORMATS = {"h264": "96 H264/90000", "mjpeg": "26 JPEG/90000"}


class NetworkCamera(RtspServer):
    """An unending stream of RTP packets by the GStreamer elements `source`."""

    def __init__(self, codec: str, source: str, password: str = "") -> None:
        self.source = source
        number = FORMATS[codec].split(" ")[0]
        super().__init__(f"{number}\r\na=rtpmap:{FORMATS[codec]}", password)

    def play(self, connection: socket.socket) -> None:
        from vram_arbiter.runner.sensors.gstreamer import load

        gst = load().gst
        pipeline = gst.parse_launch(f"{self.source} ! appsink name=out")
        sink = pipeline.get_by_name("out")
        pipeline.set_state(gst.State.PLAYING)
        try:
            while not self.closing:
                sample = sink.try_pull_sample(50_000_000)
                if sample is None:
                    if sink.is_eos():
                        pipeline.seek_simple(gst.Format.TIME, gst.SeekFlags.FLUSH, 0)
                    continue
                packet = sample.get_buffer().extract_dup(0, sample.get_buffer().get_size())
                connection.sendall(b"$\0" + len(packet).to_bytes(2, "big") + packet)
        finally:
            pipeline.set_state(gst.State.NULL)


@pytest.fixture
def network_camera() -> Iterator[Callable[..., NetworkCamera]]:
    made: list[NetworkCamera] = []

    def make(codec: str, source: str, password: str = "") -> NetworkCamera:
        made.append(NetworkCamera(codec, source, password))
        return made[-1]

    yield make
    for camera in made:
        camera.close()


@pytest.fixture
def watching() -> Iterator[Callable[..., SlotReader]]:
    """`watching(port, …)` makes and starts a reader of the stream at that port."""
    made: list[SlotReader] = []

    def begin(port: int, credentials: str = "", **params: str | int) -> SlotReader:
        config = SensorReaderConfig(
            sensor_id="overview",
            backend=SensorBackend.GSTREAMER,
            backend_params={
                "source": "rtsp",
                "url": f"rtsp://{credentials}127.0.0.1:{port}/main",
                **params,
            },
        )
        made.append(make_reader(config, CLOCK))
        made[-1].start()
        return made[-1]

    yield begin
    for reader in made:
        reader.stop()


@pytest.fixture(scope="module")
def h264_packets(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The sending end of a camera that shows a second of grey, over and over."""
    imageio = pytest.importorskip("imageio.v2")
    numpy = pytest.importorskip("numpy")
    path: Path = tmp_path_factory.mktemp("video") / "grey.mp4"
    with imageio.get_writer(path, fps=25, codec="libx264", macro_block_size=1) as writer:
        for _ in range(25):
            writer.append_data(numpy.full((SIZE[1], SIZE[0], 3), 128, numpy.uint8))
    return f'filesrc location="{path}" ! qtdemux ! rtph264pay config-interval=-1 pt=96'


def test_an_h264_stream_and_its_end(
    network_camera: Callable[..., NetworkCamera],
    watching: Callable[..., SlotReader],
    h264_packets: str,
) -> None:
    camera = network_camera("h264", h264_packets)
    reader = watching(camera.port, platform="cpu_only")
    for _ in range(10):
        frame = frame_of(reader)
        assert (frame.width, frame.height, frame.encoding) == (*SIZE, "bgr8")
        assert all(abs(value - 128) < 8 for value in frame.data or b"")
    camera.cut()
    assert end_of(reader)
    with pytest.raises(FrameStale, match="overview has no frame"):
        reader.read_latest(1e9)


def test_the_cameras_own_jpeg(
    network_camera: Callable[..., NetworkCamera], watching: Callable[..., SlotReader]
) -> None:
    source = (
        f"videotestsrc is-live=true ! video/x-raw,format=I420,width={SIZE[0]},height={SIZE[1]} ! "
        "jpegenc ! rtpjpegpay"
    )
    reader = watching(network_camera("mjpeg", source).port, codec="mjpeg", encoding="jpeg")
    frame = frame_of(reader)
    assert (frame.width, frame.height, frame.encoding) == (*SIZE, "jpeg")
    assert (frame.data or b"")[:2] == b"\xff\xd8"


def test_a_refused_password_is_said_without_it(
    network_camera: Callable[..., NetworkCamera], watching: Callable[..., SlotReader]
) -> None:
    camera = network_camera("h264", "videotestsrc", password="other")
    reason = end_of(watching(camera.port, credentials="robot:hush@", platform="cpu_only"))
    assert "rtspsrc" in reason
    assert "hush" not in reason


def test_a_camera_that_is_switched_off(watching: Callable[..., SlotReader]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    reason = end_of(watching(port, platform="cpu_only"))
    assert "rtspsrc" in reason
