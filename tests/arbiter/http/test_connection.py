"""A page that does not read its events, on a real socket."""

import asyncio
import socket

from vram_arbiter.arbiter.http.connection import STREAM_BUFFER_BYTES, Connection, Turns

CHUNK = bytes(256 * 1024)


class Streams:
    """Streams to whatever asks."""

    def __init__(self) -> None:
        self.ended = asyncio.Event()

    def opened(self, connection: Connection) -> None:
        pass

    def requested(
        self, connection: Connection, target: str, headers: dict[bytes, bytes], *, head: bool
    ) -> None:
        connection.stream()

    def closed(self, connection: Connection) -> None:
        self.ended.set()


def test_a_page_that_does_not_read_is_dropped() -> None:
    """What the kernel does not take is kept up to STREAM_BUFFER_BYTES; then the page is gone."""

    async def drop() -> list[int]:
        handler, held = Streams(), list[int]()
        here, there = socket.socketpair()
        with there:
            transport, connection = await asyncio.get_running_loop().connect_accepted_socket(
                lambda: Connection(handler, "test", Turns()), here
            )
            there.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            while not connection.streams:
                await asyncio.sleep(0)
            while connection.send(CHUNK):
                held.append(transport.get_write_buffer_size())
                await asyncio.sleep(0)
            await handler.ended.wait()
            assert not connection.send(b"more")
        return held

    held = asyncio.run(drop())
    assert STREAM_BUFFER_BYTES - 2 * len(CHUNK) < max(held) <= STREAM_BUFFER_BYTES + 1024
