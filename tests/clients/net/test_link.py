"""One connection to one checked server: what it says before it hangs up is heard, and nothing is
sent to its successor."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.net.link import Link


@pytest.fixture
def context() -> Iterator["zmq.Context[zmq.Socket[bytes]]"]:
    with zmq.Context() as made:
        yield made


def bound(context: "zmq.Context[zmq.Socket[bytes]]", path: Path) -> "zmq.Socket[bytes]":
    server = context.socket(zmq.ROUTER)
    server.bind(f"ipc://{path}")
    server.setsockopt(zmq.RCVTIMEO, int(1000 * PATIENCE_S))
    return server


def test_the_last_words_before_a_hang_up_are_heard(
    context: "zmq.Context[zmq.Socket[bytes]]", tmp_path: Path
) -> None:
    """libzmq's own way of not reconnecting discards what was received and not read: a goal's result
    was lost with it."""
    server = bound(context, tmp_path / "s")
    link = Link(context, f"ipc://{tmp_path}/s", "runner")
    try:
        assert link.wait(time.monotonic() + PATIENCE_S) == "open"
        assert link.send(b"question")
        peer, _ = server.recv_multipart()
        server.send_multipart([peer, b"earlier"])
        assert link.socket.poll(1000 * PATIENCE_S)
        assert [link.receive(), link.receive()] == [b"earlier", None]
        server.send_multipart([peer, b"first"])
        server.send_multipart([peer, b"last"])
        server.close()
        assert link.monitor.poll(1000 * PATIENCE_S)
        with contextlib.closing(Link(context, f"ipc://{tmp_path}/none", "runner")) as later:
            # libzmq's thread does one thing after the other: it is through with the hang-up then
            assert later.wait(time.monotonic() + PATIENCE_S) == "ended"
        assert link.advance() == "ended"
        assert [link.receive(), link.receive(), link.receive()] == [b"first", b"last", None]
    finally:
        link.close()
        server.close(0)


def test_a_link_is_for_one_server(
    context: "zmq.Context[zmq.Socket[bytes]]", tmp_path: Path
) -> None:
    """What was queued for the first is not sent to the second, whatever user serves then."""
    server = bound(context, tmp_path / "s")
    link = Link(context, f"ipc://{tmp_path}/s", "runner")
    try:
        assert link.wait(time.monotonic() + PATIENCE_S) == "open"
        server.close(0)
        assert link.monitor.poll(1000 * PATIENCE_S)
        assert link.send(b"token")  # it does not know yet
        server = bound(context, tmp_path / "s")
        assert link.advance() == "ended"
        again = Link(context, f"ipc://{tmp_path}/s", "runner")
        assert again.wait(time.monotonic() + PATIENCE_S) == "open"
        assert again.send(b"hello")
        assert server.recv_multipart()[-1] == b"hello"
        assert not server.poll(0)
        again.close()
    finally:
        link.close()
        server.close(0)


def test_where_nothing_listens_it_ends(
    context: "zmq.Context[zmq.Socket[bytes]]", tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    for name in ("nothing", "file", "\udcff"):
        link = Link(context, f"ipc://{tmp_path}/{name}", "arbiter")
        assert link.wait(time.monotonic() + PATIENCE_S) == "ended"
        link.close()
        link.close()


def test_descriptors_do_not_pile_up(
    context: "zmq.Context[zmq.Socket[bytes]]", tmp_path: Path
) -> None:
    """A client whose server is away tries for as long as it lives."""

    def tried(times: int) -> None:
        for _ in range(times):
            link = Link(context, f"ipc://{tmp_path}/nothing", "arbiter")
            assert link.wait(time.monotonic() + PATIENCE_S) == "ended"
            link.close()

    def descriptors() -> int:
        return len(os.listdir("/proc/self/fd"))

    tried(10)
    before, deadline = descriptors(), time.monotonic() + PATIENCE_S
    tried(60)
    while descriptors() > before + 10:  # libzmq's own thread closes them, a moment later
        assert time.monotonic() < deadline, f"{descriptors()} after 70 links, {before} after 10"
