"""The ROUTER with real sockets: identity, framing, limits, and no lost wake-up. The server runs on a loop in a thread of its own."""

import asyncio
import os
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from arbiter.rpc.server import FLOOD, RouterServer
from arbiter.testing.wire import WireClient
from schemas.errors import ConfigError

LIMIT = 1 << 16
PATIENCE_S = 60.0


@dataclass
class Serving:
    """A server whose every frame is answered with what it saw; `then` runs on its loop."""

    path: Path
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.new_event_loop)
    seen: list[tuple[bytes, bool, str | None, int]] = field(default_factory=list)
    fail_once: bool = False
    too_fast: bytes | None = None  # payloads that are over their sender's rate
    rests: int = 0

    def __post_init__(self) -> None:
        self.server = RouterServer(self.path, LIMIT, None)
        self.server.bind()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        self.server.start(self.loop, self._on_frame)
        self.loop.run_forever()
        self.server.close()
        self.loop.close()

    def _on_frame(self, routing_id: bytes, delimiter: bool, address: str | None, payload: bytes) -> bool:
        self.seen.append((routing_id, delimiter, address, len(payload)))
        if self.fail_once:
            self.fail_once = False
            raise RuntimeError("a defect of ours")
        answer = {"re": len(self.seen), "address": address, "size": len(payload), "delimiter": delimiter}
        self.server.send(routing_id, delimiter, msgpack.packb(answer))
        return payload != self.too_fast

    def call(self, function: Callable[[], object]) -> object:
        """Run something on the server's loop and return its result."""

        async def run() -> object:
            return function()

        return asyncio.run_coroutine_threadsafe(run(), self.loop).result(PATIENCE_S)

    def stop(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="va") as name:
        yield Path(name)


@pytest.fixture
def serving(folder: Path) -> Iterator[Serving]:
    made = Serving(folder / "a.sock")
    yield made
    made.stop()


@pytest.fixture
def client(serving: Serving) -> Iterator[WireClient]:
    with WireClient(f"ipc://{serving.path}") as made:
        yield made


def test_the_socket_is_private(serving: Serving) -> None:
    mode = serving.path.stat().st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o660


def test_every_frame_names_its_process(serving: Serving, client: WireClient) -> None:
    client.send_raw(b"x")
    reply = client.receive()
    assert reply is not None
    assert reply["address"] == f"localhost:{os.getuid()}:{os.getgid()}:{os.getpid()}"


def test_another_process_has_another_pid(serving: Serving) -> None:
    script = (
        "import sys, zmq, msgpack, os; s = zmq.Context().socket(zmq.DEALER); s.connect(sys.argv[1]); s.send(b'x');"
        "assert s.poll(50000); assert msgpack.unpackb(s.recv())['address'].endswith(f':{os.getpid()}')"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, f"ipc://{serving.path}"], timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0


def test_a_client_that_is_back_before_the_self_test_is_answered(folder: Path) -> None:
    """After a restart, reconnecting clients are quicker than our own probe: theirs was taken for it, and the daemon did not start."""
    server = RouterServer(folder / "a.sock", LIMIT, None)
    server.bind()
    with WireClient(f"ipc://{folder / 'a.sock'}") as client:
        client.send_raw(b"early")
        assert server._socket.poll(int(PATIENCE_S * 1000))
        server._self_test()
        heard: list[bytes] = []

        async def serve() -> None:
            done = asyncio.Event()

            def on_frame(routing_id: bytes, delimiter: bool, address: str | None, payload: bytes) -> None:
                heard.append(payload)
                done.set()

            server.start(asyncio.get_running_loop(), on_frame)
            async with asyncio.timeout(PATIENCE_S):
                await done.wait()
            server.close()

        asyncio.run(serve())
    assert heard == [b"early"]


class Stopped:
    """A socket whose process is stopped in its first wait: the time is over when it goes on, and nothing has come."""

    def __init__(self, socket: "zmq.Socket[bytes]") -> None:
        self._socket = socket
        self.waits = 0

    def poll(self, timeout_ms: int) -> int:
        self.waits += 1
        return 0 if self.waits == 1 else int(self._socket.poll(timeout_ms))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._socket, name)


def test_a_process_that_is_held_up_in_its_self_test_starts(folder: Path) -> None:
    """Regression: two seconds without the processor, and the daemon did not start."""
    server = RouterServer(folder / "a.sock", LIMIT, None)
    held_up = Stopped(server._socket)
    server._socket = held_up  # type: ignore[assignment]  # it stands for it
    server.bind()
    assert held_up.waits > 1
    server.close()


def test_a_req_socket_is_served_too(serving: Serving) -> None:
    with WireClient(f"ipc://{serving.path}", kind=zmq.REQ) as client:
        client.send_raw(b"x")
        reply = client.receive()
    assert reply is not None
    assert reply["delimiter"] is True


def test_too_many_frames_arrive_as_an_empty_payload(serving: Serving, client: WireClient) -> None:
    client.send_frames([b"a", b"b", b"c", b"d"])
    reply = client.receive()
    assert reply is not None
    assert reply["size"] == 0


def test_a_message_over_the_limit_still_arrives_to_be_answered(serving: Serving, client: WireClient) -> None:
    client.send_raw(b"x" * (2 * LIMIT))
    reply = client.receive()
    assert reply is not None
    assert reply["size"] == 2 * LIMIT


def test_a_huge_message_costs_only_its_sender(serving: Serving, client: WireClient) -> None:
    with WireClient(f"ipc://{serving.path}") as huge:
        huge.send_raw(b"x" * (64 * LIMIT))
        assert huge.receive(0.2) is None, "libzmq cuts the connection without reading it"
    client.send_raw(b"x")
    assert client.receive() is not None


def test_a_defect_in_a_handler_does_not_cost_the_next_message_its_wake_up(
    serving: Serving, client: WireClient
) -> None:
    serving.fail_once = True
    client.send_raw(b"lost")
    client.send_raw(b"answered")
    reply = client.receive()
    assert reply is not None
    assert reply["size"] == len(b"answered")


def test_a_peer_that_is_gone_is_noticed_at_the_send(serving: Serving, client: WireClient) -> None:
    client.send_raw(b"x")
    assert client.receive() is not None
    routing_id = serving.seen[0][0]
    assert serving.call(lambda: serving.server.send(b"nobody", False, b"x")) is False
    assert serving.call(lambda: serving.server.send(routing_id, False, b"\x80")) is True
    assert client.receive() == {}


def test_no_wake_up_is_lost_among_sends_from_outside_the_drain(serving: Serving, client: WireClient) -> None:
    """The descriptor is edge-triggered: a send may eat the edge of a message that arrives at that moment."""
    client.send_raw(b"x")
    assert client.receive() is not None
    routing_id = serving.seen[0][0]
    for number in range(300):
        client.send_raw(b"x")
        serving.loop.call_soon_threadsafe(
            serving.server.send, routing_id, False, msgpack.packb({"tick": number})
        )
        replies = 0
        while replies < 1:
            message = client.receive()
            assert message is not None, f"lost at {number}"
            replies += "re" in message


def test_a_reader_that_does_not_read_costs_only_itself(serving: Serving, client: WireClient) -> None:
    with WireClient(f"ipc://{serving.path}") as slow:
        slow.send_raw(b"x")
        assert slow.receive() is not None
        slow_id = serving.seen[0][0]

        def flood() -> int:
            return sum(serving.server.send(slow_id, False, b"x" * 2000) for _ in range(20_000))

        sent = serving.call(flood)
        assert isinstance(sent, int)
        assert sent < 20_000, "beyond its queue messages are dropped, not kept"
        client.send_raw(b"x")
        assert client.receive() is not None


def test_a_flood_is_answered_in_portions_and_costs_nobody_a_wake_up(
    serving: Serving, client: WireClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flood is handed to the server as if it had come at once: how much of it really does is the machine's doing."""
    server, rest = serving.server, serving.server._rest

    def counted() -> None:
        serving.rests += 1
        rest()

    monkeypatch.setattr(server, "_rest", counted)
    serving.too_fast = b"flood"
    with WireClient(f"ipc://{serving.path}") as flooder:
        flooder.send_raw(b"x")
        assert flooder.receive() is not None
        frames = [zmq.Frame(serving.seen[0][0]), zmq.Frame(b"flood")]

        def flood() -> None:
            server._early.extend([frames] * (2 * FLOOD))
            server._schedule_drain()

        for _ in range(50):
            serving.call(flood)
            client.send_raw(b"calm")
            reply = client.receive()
            assert reply is not None
            assert reply["size"] == len(b"calm")
        answers = [flooder.receive() for _ in range(100 * FLOOD)]
        assert None not in answers, "each is answered"
    client.send_raw(b"calm")
    assert client.receive() is not None, "after the last rest the socket is read as before"
    assert serving.rests == 100, "the last one begins behind the last answer"


def test_a_server_that_rests_can_be_stopped(serving: Serving, client: WireClient) -> None:
    serving.too_fast = b"flood"
    for _ in range(10 * FLOOD):
        client.send_raw(b"flood")
    assert client.receive() is not None
    assert serving.call(lambda: (serving.server._rest(), serving.server.stop_receiving())) == (None, None)
    assert serving.server._resting is None
    assert serving.call(serving.server._rest) is None, "nothing is read any more, so nobody rests"
    assert serving.server._resting is None


def test_many_clients_at_once(serving: Serving) -> None:
    clients = [WireClient(f"ipc://{serving.path}") for _ in range(100)]
    try:
        for client in clients:
            client.send_raw(b"x")
        assert all(client.receive() is not None for client in clients)
    finally:
        for client in clients:
            client.close()


def test_a_second_connection_under_a_living_routing_id_gets_nothing(serving: Serving) -> None:
    """Whoever copies a routing id must not receive its pushes."""
    with WireClient(f"ipc://{serving.path}", routing_id=b"me") as mine:
        mine.send_raw(b"x")
        assert mine.receive() is not None
        with WireClient(f"ipc://{serving.path}", routing_id=b"me") as thief:
            thief.send_raw(b"xx")
            assert thief.receive(0.2) is None
            serving.call(lambda: serving.server.send(b"me", False, msgpack.packb({"push": "secret"})))
            assert mine.receive() == {"push": "secret"}
            assert thief.receive(0.2) is None


def test_a_stale_socket_is_replaced_and_close_removes_it(folder: Path) -> None:
    path = folder / "a.sock"
    script = "import os, sys, zmq; s = zmq.Context().socket(zmq.ROUTER); s.bind('ipc://' + sys.argv[1]); os._exit(9)"
    subprocess.run([sys.executable, "-c", script, str(path)], timeout=PATIENCE_S, check=False)
    assert path.exists()
    serving = Serving(path)
    with WireClient(f"ipc://{path}") as client:
        client.send_raw(b"x")
        assert client.receive() is not None
    serving.stop()
    assert not path.exists()


def test_an_unbindable_path_is_a_config_error(folder: Path) -> None:
    server = RouterServer(folder / "no-such-folder" / "a.sock", LIMIT, None)
    with pytest.raises(ConfigError, match="cannot bind"):
        server.bind()
    server.close()
