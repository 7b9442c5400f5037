"""The server of the small programs, at its end: nobody is left without the answer that he was
given."""

import asyncio
import os
from pathlib import Path

import msgpack
import pytest
import zmq

from tests.support.serving import answering
from tests.support.wire import WireClient
from vram_arbiter.clients.net.server import Peer, RouterServer, check_free
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.errors import AlreadyRunning, ConfigError, RobotFault, VramError
from vram_arbiter.schemas.goals import CancelGoal
from vram_arbiter.schemas.plain import Message

ANSWER = bytes(16 << 20)  # far more than the kernel takes in one go


def refused(error: VramError) -> Message:
    return {"error": error.code}


def test_the_last_answer_reaches_its_peer_though_the_server_ends_behind_it(tmp_path: Path) -> None:
    """Regression: the socket closed without lingering and dropped answers that were not written
    yet."""
    endpoint = f"ipc://{tmp_path}/s.sock"

    async def answer_and_end() -> None:
        server, answered = RouterServer(endpoint, refused), asyncio.Event()

        async def handle(peer: Peer, message: Message) -> None:
            await server.send(peer, {"re": message["id"], "data": ANSWER})
            answered.set()

        async with answering(server, handle):
            await answered.wait()

    with WireClient(endpoint) as client:
        request = client.send("ask")
        asyncio.run(answer_and_end())
        assert client.reply(request)["data"] == ANSWER


def test_a_late_answer_is_in_the_envelope_of_its_own_request(tmp_path: Path) -> None:
    """A REQ that asked again took the answer to its first request for that to its second: every
    answer stood in the envelope of the last message."""
    endpoint = f"ipc://{tmp_path}/s.sock"

    async def asked_twice() -> object:
        waiting: list[tuple[Peer, Message]] = []
        server = RouterServer(endpoint, refused)

        async def handle(peer: Peer, message: Message) -> None:
            waiting.append((peer, message))
            if len(waiting) == 2:
                for asker, request in waiting:
                    await server.send(asker, {"answer": request["n"]})

        async with answering(server, handle):
            with zmq.Context.instance().socket(zmq.REQ) as socket:
                for option in (zmq.REQ_CORRELATE, zmq.REQ_RELAXED):
                    socket.setsockopt(option, 1)
                socket.setsockopt(zmq.LINGER, 0)
                socket.setsockopt(zmq.RCVTIMEO, 60_000)
                socket.connect(endpoint)
                for n in (1, 2):
                    socket.send(msgpack.packb({"n": n}))
                answer = await asyncio.to_thread(socket.recv)
        return msgpack.unpackb(answer)

    assert asyncio.run(asked_twice()) == {"answer": 2}


def test_words_that_utf8_has_no_bytes_for_reach_the_other_side(tmp_path: Path) -> None:
    """Regression: undecodable bytes of a command line or a file name ended the caller with a
    traceback, and left whoever had asked without an answer."""
    endpoint = f"ipc://{tmp_path}/s.sock"

    async def there_and_back() -> tuple[Message, str]:
        heard: list[Message] = []
        server = RouterServer(endpoint, refused)

        async def handle(peer: Peer, message: Message) -> None:
            heard.append(message)
            failed = {"ok": False, "error": RobotFault("no file \udcff").to_wire()}
            answer = {"ok": True} if message["op"] == "ping" else failed
            await server.send(peer, {"re": message["id"], **answer})

        async with answering(server, handle), RunnerClient(endpoint) as client:
            with pytest.raises(RobotFault) as raised:
                await client.call(CancelGoal(goal_id="smoke \udcff"))
        return heard[-1], raised.value.message

    stopped, said = asyncio.run(there_and_back())
    assert (stopped["op"], stopped["goal_id"]) == ("cancel", "smoke \\udcff")
    assert said == "no file \\udcff"


def test_an_endpoint_is_free_when_its_server_has_ended_and_when_it_never_began(
    tmp_path: Path,
) -> None:
    """Regression: a failed bind kept the endpoint's lock, so the same program seemed to serve
    there."""
    endpoint = f"ipc://{tmp_path}/s.sock"

    async def one_after_the_other() -> None:
        for _ in range(3):
            async with RouterServer(endpoint, refused):
                with pytest.raises(AlreadyRunning):
                    await RouterServer(endpoint, refused).__aenter__()
                with pytest.raises(AlreadyRunning, match=rf"\(pid {os.getpid()}\) already uses"):
                    check_free(endpoint)
            check_free(endpoint)
        with pytest.raises(ConfigError, match="Linux allows 107"):
            RouterServer(f"ipc://{tmp_path}/{'x' * 120}", refused)
        (tmp_path / "file").touch()
        nowhere = RouterServer(f"ipc://{tmp_path}/file", refused)
        for _ in range(2):  # what was begun is taken back
            with pytest.raises(ConfigError, match="not a socket"):
                await nowhere.__aenter__()
        with pytest.raises(ConfigError, match="No such file"):
            await RouterServer("ipc:///proc/none/s", refused).__aenter__()

    asyncio.run(one_after_the_other())
