"""Real sources of pictures for the readers: video files, and a server of RTSP on loopback."""

import contextlib
import socket
import struct
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vram_arbiter.runner.sensors import SlotReader

PACKET = 188  # bytes of one packet of an MPEG transport stream


@pytest.fixture
def make_video(tmp_path: Path) -> Callable[..., Path]:
    """`make_video(greys, fps=25.0, name="v.avi", fourcc="MJPG")`: a video of 64 × 48 whose pictures
    are plain gray.
    """

    def make(
        greys: list[int], fps: float = 25.0, name: str = "video.avi", fourcc: str = "MJPG"
    ) -> Path:
        import cv2
        import numpy as np

        path = tmp_path / name
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), fps, (64, 48))
        assert writer.isOpened()
        for grey in greys:
            writer.write(np.full((48, 64, 3), grey, dtype=np.uint8))
        writer.release()
        return path

    return make


class RtspServer(ABC):
    """A small RTSP server on loopback: one client after another, packets inside the connection
    (what a firewall-friendly camera does). `media` are the SDP's lines of its stream, the port
    is 0. With a password every client is refused.
    """

    def __init__(self, media: str, password: str = "") -> None:
        self.media, self.password = media, password
        self.closing = False
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._connection: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @abstractmethod
    def play(self, connection: socket.socket) -> None:
        """Send the stream; returning ends the connection."""

    def cut(self) -> None:
        """Pull the plug of the client that looks."""
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.closing = True
        self.cut()
        with contextlib.suppress(OSError):
            socket.create_connection(("127.0.0.1", self.port), 5).close()  # wakes `accept`
        self._socket.close()
        self._thread.join(30)

    def _run(self) -> None:
        while not self.closing:
            try:
                self._connection = self._socket.accept()[0]
            except OSError:
                return
            with self._connection, contextlib.suppress(OSError):  # a client that goes away
                self._serve(self._connection)

    def _serve(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as stream:
            while not self.closing:
                head = ""
                while (line := stream.readline().decode()) not in ("\r\n", ""):
                    head += line
                if not head:
                    return
                method = head.split(" ", 1)[0]
                number = next(line for line in head.splitlines() if line.lower().startswith("cseq"))
                connection.sendall(self._answer(method, number, "Authorization:" in head).encode())
                if method == "PLAY" and not self.password:
                    self.play(connection)
                    return

    def _answer(self, method: str, number: str, authorized: bool) -> str:
        if self.password:
            asked = 'WWW-Authenticate: Basic realm="camera"\r\n'
            status, more = ("403 Forbidden", "") if authorized else ("401 Unauthorized", asked)
            return f"RTSP/1.0 {status}\r\n{number}\r\n{more}\r\n"
        body = ""
        if method == "DESCRIBE":
            body = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
            body += f"m=video 0 RTP/AVP {self.media}\r\na=control:track0\r\n"
        more = {
            "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n",
            "DESCRIBE": f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n",
            "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n",
        }.get(method, "Session: 1\r\n")
        return f"RTSP/1.0 200 OK\r\n{number}\r\n{more}\r\n{body}"


class FilmServer(RtspServer):
    """Sends one MPEG transport stream.

    Each play sends the whole stream again, at once, then waits until it is cut or the client
    leaves. With `hold`, it keeps back the second half until that is set: a network that stands
    still, then delivers in a rush.
    """

    def __init__(self, stream: bytes) -> None:
        self.stream = stream
        self.played = 0
        self.over = threading.Event()
        self.hold: threading.Event | None = None
        super().__init__("33")

    def play(self, connection: socket.socket) -> None:
        self.played += 1
        for sequence, at in enumerate(range(0, len(self.stream), 7 * PACKET)):
            if self.hold is not None and at >= len(self.stream) // 2:
                self.hold.wait(60)
            payload = self.stream[at : at + 7 * PACKET]
            packet = struct.pack(">BBHII", 0x80, 33, sequence & 0xFFFF, sequence * 900, 1) + payload
            connection.sendall(struct.pack(">BBH", 0x24, 0, len(packet)) + packet)
        self.over.wait(60)
        if not self.closing:
            self.over.clear()

    def close(self) -> None:
        self.closing = True
        self.over.set()
        if self.hold is not None:
            self.hold.set()
        super().close()


@pytest.fixture
def make_rtsp() -> Iterator[Callable[[bytes], FilmServer]]:
    made: list[FilmServer] = []

    def make(stream: bytes) -> FilmServer:
        made.append(FilmServer(stream))
        return made[-1]

    yield make
    for server in made:
        server.close()


@pytest.fixture
def started_reader() -> Iterator[Callable[[SlotReader], SlotReader]]:
    """Starts a reader and stops it at the end."""
    started: list[SlotReader] = []

    def begin(reader: SlotReader) -> SlotReader:
        reader.start()
        started.append(reader)
        return reader

    yield begin
    for reader in started:
        reader.stop()
