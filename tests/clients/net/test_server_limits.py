"""What one peer of a sidecar, runner or reasoner may send, hold and leave unread. Peers are
unmodified libzmq sockets, or sockets by hand.
"""

import asyncio
import grp
import json
import os
import socket
import stat
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
import zmq.asyncio

from tests.support.prepared import run
from tests.support.serving import answering
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.net.server import (
    IMAGES_MAX_BYTES,
    WAITING_MAX,
    Peer,
    RouterServer,
    check_free,
)
from vram_arbiter.schemas.defaults import IMAGE_MESSAGE_MAX_BYTES, MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.plain import Message


def refused(error: VramError) -> Message:
    return {"ok": False, "code": error.code, "message": error.message}


class Server:
    """Answers at once, or when it is told to."""

    def __init__(self, server: RouterServer) -> None:
        self.server = server
        self.go_on = asyncio.Event()
        self.peers: list[Peer] = []

    async def handle(self, peer: Peer, message: Message) -> None:
        self.peers.append(peer)
        if message["op"] == "wait":
            await self.go_on.wait()
        answer: Message = {
            "ok": True,
            "re": message.get("id"),
            "size": len(message.get("image", b"")),
        }
        if message["op"] == "fat":
            answer["data"] = bytes(IMAGE_MESSAGE_MAX_BYTES)
        await self.server.send(peer, answer)


@asynccontextmanager
async def router_at(path: Path, **options: Any) -> AsyncIterator[Server]:
    router = RouterServer(f"ipc://{path}", refused, **options)
    server = Server(router)
    async with answering(router, server.handle):
        try:
            yield server
        finally:
            server.go_on.set()


class Client:
    """An unmodified socket of libzmq."""

    def __init__(self, path: Path, kind: int = zmq.DEALER) -> None:
        self._context = zmq.asyncio.Context()
        self.socket = self._context.socket(kind)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"ipc://{path}")

    async def ask(self, message: Any) -> Message:
        await self.send(message)
        return await self.answer()

    async def send(self, message: Any) -> None:
        await self.socket.send(message if isinstance(message, bytes) else msgpack.packb(message))

    async def answer(self) -> Message:
        answer: Message = msgpack.unpackb(await self.socket.recv())
        return answer

    def close(self) -> None:
        self._context.destroy(0)


def with_server(scenario: Callable[[], Awaitable[None]]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await scenario()

    asyncio.run(bounded())


@pytest.mark.parametrize("kind", [zmq.REQ, zmq.DEALER])
def test_the_first_message_may_be_the_largest_picture(tmp_path: Path, kind: int) -> None:
    """The field's clients begin a fresh socket with a picture; only the wire of the arbiter has a
    hello.
    """

    async def scenario() -> None:
        async with router_at(tmp_path / "s.sock") as server:
            client = Client(tmp_path / "s.sock", kind)
            answer = await client.ask({"op": "detect", "image": bytes(IMAGE_MESSAGE_MAX_BYTES)})
            assert answer == {"ok": True, "re": None, "size": IMAGE_MESSAGE_MAX_BYTES}
            assert (await client.ask({"op": "ping", "id": 7}))["re"] == 7
            client.close()
            assert {(peer.pid, peer.uid) for peer in server.peers} == {(os.getpid(), os.getuid())}
            assert len({peer.identity for peer in server.peers}) == 1

    with_server(scenario)


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (b"\xdd" + ((16 << 20) - 5).to_bytes(4) + b"\x80" * ((16 << 20) - 5), "message_too_large"),
        (msgpack.packb({"op": "ä" * (1 << 20)}), "message_too_large"),
        (msgpack.packb({"op": "ping", "image": bytes(IMAGES_MAX_BYTES)}), "message_too_large"),
        (msgpack.packb({"op": "ping", "ids": [0] * 2000}), "bad_frame"),
        (msgpack.packb({"op": "ping"} | {f"k{n}": 0 for n in range(300)}), "bad_frame"),
        (b"", "bad_frame"),
        (b"\xc1", "bad_frame"),
        (b"\x91" * 5000 + b"\xc0", "bad_frame"),
        (msgpack.packb([1]), "bad_frame"),
    ],
    ids=[
        "empty maps",
        "text",
        "too large",
        "long list",
        "many keys",
        "empty",
        "invalid",
        "deep",
        "no map",
    ],
)
def test_a_message_that_costs_too_much_is_refused_and_its_sender_served_on(
    tmp_path: Path, message: bytes, code: str
) -> None:
    """Regression: 16 MiB of empty maps held the interpreter for 2.6 s, and the control loop with
    it.
    """

    async def scenario() -> None:
        async with router_at(tmp_path / "s.sock"):
            client = Client(tmp_path / "s.sock")
            assert (await client.ask(message))["code"] == code
            assert (await client.ask({"op": "ping", "id": 1}))["ok"]
            client.close()

    with_server(scenario)


def test_a_server_without_pictures_takes_a_mebibyte(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with router_at(tmp_path / "s.sock", message_max_bytes=MESSAGE_MAX_BYTES):
            client = Client(tmp_path / "s.sock")
            answer = await client.ask({"op": "ping", "image": bytes(MESSAGE_MAX_BYTES)})
            assert answer["code"] == "message_too_large"
            client.close()

    with_server(scenario)


def test_a_goal_may_be_a_trajectory_of_eight_hundred_points(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with router_at(tmp_path / "s.sock", message_max_bytes=MESSAGE_MAX_BYTES):
            client = Client(tmp_path / "s.sock")
            point = {"positions": [0.1] * 6, "time_from_start": {"sec": 1, "nanosec": 5}}
            goal = {"op": "goal", "goal_params": {"trajectory": {"points": [point] * 800}}}
            assert (await client.ask(goal))["ok"]
            client.close()

    with_server(scenario)


def test_a_user_has_a_share_of_waiting_requests_in_number_and_in_bytes(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with router_at(tmp_path / "s.sock") as server:
            client = Client(tmp_path / "s.sock")
            picture = bytes(IMAGE_MESSAGE_MAX_BYTES)
            for number in range(9):
                await client.send({"op": "wait", "id": number, "image": picture})
            refusal = await client.answer()
            assert refusal["code"] == "limit_exceeded"
            assert "bytes of requests" in refusal["message"]
            # what is small is answered
            assert (await client.ask({"op": "ping", "id": 99}))["re"] == 99
            server.go_on.set()
            assert {(await client.answer())["re"] for _ in range(8)} == set(range(8))
            server.go_on.clear()
            for number in range(WAITING_MAX + 1):
                await client.send({"op": "wait", "id": number})
            assert f"{WAITING_MAX} requests" in (await client.answer())["message"]
            client.close()

    with_server(scenario)


def test_a_peer_that_does_not_read_its_answers_delays_no_other_and_holds_little(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        path = tmp_path / "s.sock"
        async with router_at(path) as server:
            greedy = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            greedy.setblocking(False)
            loop = asyncio.get_running_loop()
            await loop.sock_connect(greedy, str(path))
            greeting = bytes.fromhex("ff00000000000000017f03014e554c4c") + bytes(48)
            ready = (
                b"\x04)\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00"
            )
            request = msgpack.packb({"op": "fat"})
            await loop.sock_sendall(
                greedy, greeting + ready + (bytes((0, len(request))) + request) * 1000
            )
            client = Client(path)
            assert (await client.ask({"op": "ping", "id": 1}))["ok"]
            for number in range(100):
                assert (await client.ask({"op": "ping", "id": number}))["ok"]
            # what it has not read is not answered further: one answer waits, not a thousand
            assert len([peer for peer in server.peers if peer != server.peers[-1]]) <= 2
            greedy.close()
            client.close()

    with_server(scenario)


def test_a_deleted_socket_file_is_made_again(tmp_path: Path) -> None:
    async def scenario() -> None:
        path = tmp_path / "s.sock"
        async with router_at(path):
            path.unlink()
            await eventually(path.exists)
            client = Client(path)
            assert (await client.ask({"op": "ping", "id": 1}))["ok"]
            client.close()
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert not path.exists()

    with_server(scenario)


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [
        ("tcp://127.0.0.1:7777", "any user of the machine could connect"),
        ("tcp://0.0.0.0:7777", "any user of the machine could connect"),
        ("ipc://@runner", "write ipc://"),
        ("ipc://", "write ipc://"),
        ("runner.sock", "write ipc://"),
        ("inproc://runner", "write ipc://"),
    ],
)
def test_only_the_path_of_a_socket_is_served(endpoint: str, says: str) -> None:
    """Regression: over loopback tcp another user of the machine gave a robot goals, and
    stopped it."""
    with pytest.raises(ConfigError, match=says):
        RouterServer(endpoint, refused)
    with pytest.raises(ConfigError, match=says):
        check_free(endpoint)


GUEST = """
import json, os, sys
import msgpack
from tests.support.wire import WireClient
os.setgroups([int(group) for group in sys.argv[2:]])
os.setresgid(65534, 65534, 65534); os.setresuid(65534, 65534, 65534)
with WireClient(sys.argv[1]) as client:
    client.send_raw(msgpack.packb({"id": 1, "op": "ping"}))
    print(json.dumps(client.reply(1)))
"""


@pytest.mark.skipif(os.getuid() != 0, reason="needs root to act as another user")
@pytest.mark.parametrize("member", [False, True])
def test_a_guest_is_answered_by_a_refusal_alone(member: bool) -> None:
    """A robot whose key named the runner's socket moved the server's own robot."""
    guests = grp.getgrgid(60)  # `games`: each machine has it

    async def scenario() -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "s.sock")
            path.parent.chmod(0o711)
            async with router_at(path, closed_to=guests.gr_name) as server:
                path.chmod(0o666)
                groups = [str(guests.gr_gid)] if member else []
                words = [GUEST, f"ipc://{path}", *groups]
                done = await asyncio.to_thread(run, "script", words, os.environ, PATIENCE_S)
                assert done.returncode == 0, done.stderr
                said = json.loads(done.stdout)
                assert (said["ok"], len(server.peers)) == ((False, 0) if member else (True, 1))
                assert said["re"] == 1
                assert not member or said["message"] == "a guest may not use s"

    with_server(scenario)
