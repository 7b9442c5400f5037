"""Real sources of pictures for the readers: video files, and a server of RTSP on loopback."""

import socket
import struct
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

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


class Server(ABC):
    """Accepts connections one after another on loopback and gives each to `serve`, until it is
    closed.
    """

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self.connections: list[socket.socket] = []
        self.requests: list[str] = []
        self._closing = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                connection = self._socket.accept()[0]
            except OSError:
                return
            if self._closing:
                connection.close()
                return
            self.connections.append(connection)
            with connection:
                try:
                    self.serve(connection)
                except OSError:
                    pass  # the reader went away, or the test cut the line

    @abstractmethod
    def serve(self, connection: socket.socket) -> None:
        """Talk to one client; returning ends its connection."""

    def request(self, stream: Any) -> str:
        """The head of the next request."""
        head = ""
        while (line := stream.readline().decode()) not in ("\r\n", ""):
            head += line
        self.requests.append(head)
        return head

    def close(self) -> None:
        self._closing = True
        for connection in self.connections:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
        try:
            socket.create_connection(("127.0.0.1", self.port), 5).close()  # wakes `accept`
        except OSError:
            pass
        self._socket.close()
        self._thread.join(30)


class RtspServer(Server):
    """A small RTSP server: one transport stream, in RTP packets inside the RTSP connection (what a
    firewall-friendly camera does).

    Each play sends the whole stream again, at once, then waits until it is cut or the client
    leaves. With `hold`, it keeps back the second half until that is set: a network that stands
    still, then delivers in a rush.
    """

    def __init__(self, stream: bytes) -> None:
        self.stream = stream
        self.played = 0
        self.cut = threading.Event()
        self.hold: threading.Event | None = None
        super().__init__()

    def serve(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as stream:
            while head := self.request(stream):
                method = head.split(" ", 1)[0]
                number = next(line for line in head.splitlines() if line.lower().startswith("cseq"))
                more, body = "", ""
                if method == "OPTIONS":
                    more = "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
                elif method == "DESCRIBE":
                    body = (
                        "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
                        "m=video 0 RTP/AVP 33\r\na=control:track0\r\n"
                    )
                    more = f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
                elif method == "SETUP":
                    more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
                elif method in ("PLAY", "TEARDOWN"):
                    more = "Session: 1\r\n"
                connection.sendall(f"RTSP/1.0 200 OK\r\n{number}\r\n{more}\r\n{body}".encode())
                if method == "PLAY":
                    self.play(connection)
                    return
                if method == "TEARDOWN":
                    return

    def play(self, connection: socket.socket) -> None:
        self.played += 1
        for sequence, at in enumerate(range(0, len(self.stream), 7 * PACKET)):
            if self.hold is not None and at >= len(self.stream) // 2:
                self.hold.wait(60)
            payload = self.stream[at : at + 7 * PACKET]
            packet = struct.pack(">BBHII", 0x80, 33, sequence & 0xFFFF, sequence * 900, 1) + payload
            connection.sendall(struct.pack(">BBH", 0x24, 0, len(packet)) + packet)
        self.cut.wait(60)
        if not self._closing:
            self.cut.clear()

    def close(self) -> None:
        self._closing = True
        self.cut.set()
        if self.hold is not None:
            self.hold.set()
        super().close()


@pytest.fixture
def make_rtsp() -> Iterator[Callable[[bytes], RtspServer]]:
    made: list[RtspServer] = []

    def make(stream: bytes) -> RtspServer:
        made.append(RtspServer(stream))
        return made[-1]

    yield make
    for server in made:
        server.close()


@pytest.fixture
def reading() -> Iterator[Callable[[SlotReader], SlotReader]]:
    """Starts a reader and stops it at the end."""
    started: list[SlotReader] = []

    def begin(reader: SlotReader) -> SlotReader:
        reader.start()
        started.append(reader)
        return reader

    yield begin
    for reader in started:
        reader.stop()
