"""Streams of network cameras through the real rtspsrc: a server on loopback sends GStreamer's own
RTP packets.
"""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

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


class NetworkCamera:
    """A small RTSP server on loopback: one client after another, RTP inside the connection, an
    unending stream by `source`.
    """

    def __init__(self, codec: str, source: str, password: str = "") -> None:
        self.codec, self.source, self.password = codec, source, password
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._connection: socket.socket | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Pull the plug of whoever looks."""
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._closing.set()
        self.cut()
        with contextlib.suppress(OSError):
            socket.create_connection(("127.0.0.1", self.port), 5).close()  # wakes `accept`
        self._thread.join(30)
        self._socket.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            self._connection = self._socket.accept()[0]
            with self._connection, contextlib.suppress(OSError):  # a client that goes away
                self._serve(self._connection)

    def _serve(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as stream:
            while not self._closing.is_set():
                head = b""
                while (line := stream.readline()) not in (b"\r\n", b""):
                    head += line
                if not head:
                    return
                lines = head.decode().splitlines()
                method = lines[0].split(" ", 1)[0]
                sequence = next(line for line in lines if line.lower().startswith("cseq"))
                if self.password and "Authorization:" not in head.decode():
                    answer = (
                        f"RTSP/1.0 401 Unauthorized\r\n{sequence}\r\nWWW-Authenticate: Basic "
                        'realm="camera"\r\n\r\n'
                    )
                elif self.password:
                    answer = f"RTSP/1.0 403 Forbidden\r\n{sequence}\r\n\r\n"
                else:
                    answer = f"RTSP/1.0 200 OK\r\n{sequence}\r\n{self._answer(method)}"
                connection.sendall(answer.encode())
                if method == "PLAY":
                    self._play(connection)

    def _answer(self, method: str) -> str:
        number = FORMATS[self.codec].split(" ")[0]
        body = (
            "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
            f"m=video 0 RTP/AVP {number}\r\na=rtpmap:{FORMATS[self.codec]}\r\na=control:track0\r\n"
        )
        return {
            "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n\r\n",
            "DESCRIBE": "Content-Type: application/sdp\r\nContent-Length: "
            f"{len(body)}\r\n\r\n{body}",
            "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n\r\n",
        }.get(method, "Session: 1\r\n\r\n")

    def _play(self, connection: socket.socket) -> None:
        from vram_arbiter.runner.sensors.gstreamer import load

        gst = load().gst
        pipeline = gst.parse_launch(f"{self.source} ! appsink name=out")
        sink = pipeline.get_by_name("out")
        pipeline.set_state(gst.State.PLAYING)
        try:
            while not self._closing.is_set():
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
