"""Ports for programs that listen later, and sockets that listen."""

import asyncio
import socket
from pathlib import Path

import pytest

from vram_arbiter.schemas.runtime import ports


def test_no_outgoing_connection_can_take_it_before_its_program_listens() -> None:
    """A port of the kernel's range was taken within the seconds of a start: the page had none."""
    first = int(ports.EPHEMERAL.read_text().split()[0])
    assert all(ports.FIRST <= ports.free_port() < first for _ in range(20))


def test_one_that_is_taken_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", port := ports.free_port())):
        kernels = tmp_path / "range"
        kernels.write_text(f"{port + 1}\t60999\n")
        monkeypatch.setattr(ports, "FIRST", port)
        monkeypatch.setattr(ports, "EPHEMERAL", kernels)
        with pytest.raises(OSError, match="is free"):
            ports.free_port()
    assert ports.free_port() == port


def test_what_a_connection_sends_is_not_kept_back() -> None:
    """A robot's answer waited for its client's delayed acknowledgment, 40 ms: asyncio leaves
    Nagle's algorithm on for a listening socket that it is given."""

    async def story() -> int:
        nodelay: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def connected(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            own: socket.socket = writer.get_extra_info("socket")
            nodelay.set_result(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(
            connected, sock=ports.listen("127.0.0.1", 0, 1)
        ) as server:
            address = server.sockets[0].getsockname()
            _, writer = await asyncio.open_connection(*address[:2])
            found = await nodelay
            writer.close()
        return found

    assert asyncio.run(asyncio.wait_for(story(), 60)) == 1
