"""Where an answer's head and body end, and what of a WebSocket is a message."""

import asyncio
import math

import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")

from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.sidecars.gateway.proxy import _Frames, end_to_end
from vram_arbiter.sidecars.gateway.upstream import Chunked, Connection, Counted, Head, read_head

CHUNKED = b"5\r\nhello\r\n1;a=b\r\n\n\r\n00A\r\n0123456789\r\n0\r\nTrailer: x\r\n\r\n"


def head(*lines: bytes) -> Head:
    return read_head(b"".join(line + b"\r\n" for line in (b"HTTP/1.1 200 OK", *lines)))


def pieces(data: bytes, size: int) -> list[bytes]:
    return [data[at : at + size] for at in range(0, len(data), size)]


@pytest.mark.parametrize("size", range(1, len(CHUNKED) + 1))
def test_a_body_in_chunks_ends_where_it_ends_however_it_arrives(size: int) -> None:
    plain, decoded = Chunked(decoded=False), Chunked(decoded=True)
    assert b"".join(plain.take(piece) for piece in pieces(CHUNKED, size)) == CHUNKED
    assert b"".join(decoded.take(piece) for piece in pieces(CHUNKED, size)) == b"hello\n0123456789"
    assert plain.over
    assert decoded.over
    assert not plain.spare
    assert Chunked(decoded=False).take(CHUNKED + b"HTTP/1.1") == CHUNKED


@pytest.mark.parametrize(
    "size", [b"", b"-1", b"+5", b"0x5", b"5_0", b" 5", b"5 5", b"z", b"1" * 16, b"\n"]
)
def test_a_size_that_others_may_read_otherwise_ends_the_answer(size: bytes) -> None:
    with pytest.raises(SidecarUnavailable):
        Chunked(decoded=False).take(b"1\r\na\r\n" + size + b"x\r\n")


def test_a_counted_body_ends_with_its_count() -> None:
    body = Counted(5)
    assert body.take(b"abc") + body.take(b"defg") == b"abcde"
    assert body.over
    assert body.spare
    assert not Counted(math.inf).bounded


def test_the_length_is_that_of_the_method_the_status_and_the_fields() -> None:
    counted = head(b"Content-Length: 7", b"content-length:7 ")
    found = counted.body("GET", decoded=False)
    assert isinstance(found, Counted)
    assert found.left == 7
    assert counted.body("HEAD", decoded=False).over
    assert read_head(b"HTTP/1.1 304\r\nContent-Length: 7\r\n").body("GET", decoded=False).over
    assert isinstance(head(b"Transfer-Encoding: Chunked").body("GET", decoded=False), Chunked)
    assert not head().body("GET", decoded=False).bounded
    assert head().lasts
    assert not head(b"Connection: x, Close").lasts
    assert not read_head(b"HTTP/1.0 200 OK\r\n").lasts


@pytest.mark.parametrize(
    "lines",
    [
        [b"Content-Length: 7", b"Content-Length: 8"],
        [b"Content-Length: 7, 8"],
        [b"Content-Length: +7"],
        [b"Content-Length: "],
        [b"Content-Length: " + b"9" * 19],
        [b"Content-Length: 7", b"Transfer-Encoding: chunked"],
        [b"Transfer-Encoding: gzip, chunked"],
        [b"Transfer-Encoding: chunked", b"Transfer-Encoding: chunked"],
        [b"A: b", b" folded"],
        [b"A : b"],
        [b"no colon"],
        [b": no name"],
        [b"A: \0"],
        [b"A: b\rContent-Length: 3"],
    ],
)
def test_an_answer_without_a_certain_end_is_refused(lines: list[bytes]) -> None:
    with pytest.raises(SidecarUnavailable):
        head(*lines).body("GET", decoded=False)


@pytest.mark.parametrize("line", [b"HTTP/2 200 OK", b"HTTP/1.1 999 OK", b"ICY 200 OK", b"", b"\0"])
def test_what_is_not_http_is_refused(line: bytes) -> None:
    with pytest.raises(SidecarUnavailable):
        read_head(line + b"\r\n")


def test_a_header_that_connection_names_stays_on_its_hop() -> None:
    fields = [(b"Connection", b"X-A, close"), (b"x-a", b"1"), (b"TE", b"trailers"), (b"X-B", b"2")]
    assert end_to_end(fields, frozenset((b"x-c",))) == [(b"X-B", b"2")]


@pytest.mark.parametrize("size", [1, 2, 3, 5, 7, 1000])
def test_pings_of_a_websocket_are_not_messages(size: int) -> None:
    ping = b"\x89\x83mask\1\2\3" + b"\x8a\x00"
    long, huge = b"\x82\x7e\x01\x00" + bytes(256), b"\x01\x7f" + (300).to_bytes(8) + bytes(300)
    frames = _Frames()
    for _ in range(3):
        assert not any(frames.message_in(piece) for piece in pieces(ping, size))
        assert all(frames.message_in(piece) for piece in pieces(long, size))
        assert all(frames.message_in(piece) for piece in pieces(huge, size))
        assert frames.between


class Pipe(asyncio.Transport):
    """A transport that keeps what is written, and whether it may be read."""

    def __init__(self) -> None:
        super().__init__()
        self.written, self.reads = b"", True

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written += bytes(data)

    def get_write_buffer_size(self) -> int:
        return len(self.written)

    def is_closing(self) -> bool:
        return False

    def pause_reading(self) -> None:
        self.reads = False

    def resume_reading(self) -> None:
        self.reads = True


@pytest.mark.anyio
@pytest.mark.parametrize("late", [False, True], ids=["with its head", "later"])
async def test_a_connection_is_read_again_after_a_large_answer(late: bool) -> None:
    """Regression: the next request of a kept connection never saw its answer."""
    server, client, connection = Pipe(), Pipe(), Connection()
    connection.connection_made(server)
    data = b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n" + bytes(100_000)
    connection.data_received(data[: 1000 if late else None])
    found = await connection.head()
    body = found.body("GET", decoded=False)
    passing = asyncio.create_task(connection.pass_body(b"", body, client, drained))
    await asyncio.sleep(0)
    if late:
        connection.data_received(data[1000:])
    await passing
    assert len(client.written) == 100_000
    assert connection.usable
    assert server.reads


@pytest.mark.anyio
async def test_the_first_event_of_a_stream_is_told_once_and_a_comment_is_none() -> None:
    client, connection = Pipe(), Connection()
    connection.connection_made(Pipe())
    ping, event = (b"%x\r\n%b\r\n" % (len(one), one) for one in (b": ping\n\n", b"data: 1\n\n"))
    connection.data_received(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + ping)
    body = (await connection.head()).body("GET", decoded=False)
    written: list[bytes] = []  # as each event is told
    passing = asyncio.create_task(
        connection.pass_body(b"", body, client, drained, lambda: written.append(client.written))
    )
    await asyncio.sleep(0)
    assert written == []
    for _ in range(2):
        connection.data_received(event)
    connection.data_received(b"0\r\n\r\n")
    await passing
    assert written == [ping + event]


async def drained() -> None:
    pass
