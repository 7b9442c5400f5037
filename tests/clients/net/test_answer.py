"""A client that did not run for a while does not take that for the silence of whom it asked. Real
sockets, processes that are really stopped."""

import asyncio
import itertools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.support import protocol_wire
from tests.support.running import running
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.answer import Answer
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.reasoner import server as reasoner
from vram_arbiter.schemas.plain import Message

LIMIT_S = 0.5
STOPPED_LIMIT_S = 3.0
"""Of a process of its own, which a busy machine may hold up before and after it is stopped, too."""
WELCOME = {"ok": True, "epoch": 1, **protocol_wire.WELCOME}
CLIENT = f"""
import asyncio, sys
from vram_arbiter.clients.sidecar.base import SidecarClient

async def ask():
    async with SidecarClient(sys.argv[1]) as client:
        print((await client.ping(timeout_s={STOPPED_LIMIT_S}))["word"])

asyncio.run(ask())
"""


class Answering:
    """A server in a thread of its own, so that it answers while the client's loop stands still."""

    def __init__(
        self, endpoint: str, before: Callable[[Peer], None], after: Callable[[Peer], None]
    ) -> None:
        self.endpoint = endpoint
        self._before, self._after = before, after
        self._stopped: asyncio.Event | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._up = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._up.wait(PATIENCE_S)

    async def _serve(self) -> None:
        self._loop, self._stopped = asyncio.get_running_loop(), asyncio.Event()
        async with RouterServer(self.endpoint, lambda error: {"error": error.to_wire()}) as server:

            async def handle(peer: Peer, message: Message) -> None:
                self._before(peer)
                await server.send(peer, {"re": message["id"], "word": "here", **WELCOME})
                self._after(peer)

            serving = asyncio.create_task(server.serve(handle))
            self._up.set()
            await self._stopped.wait()
            serving.cancel()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join(PATIENCE_S)


@pytest.fixture
def serve_answer() -> Iterator[Callable[..., str]]:
    """`serve(before, after)`: the endpoint of a server that calls these with its peer before and
    after it answers."""
    with tempfile.TemporaryDirectory(prefix="va") as folder:
        made: list[Answering] = []
        numbers = itertools.count()

        def start(
            before: Callable[[Peer], None] = lambda _: None,
            after: Callable[[Peer], None] = lambda _: None,
        ) -> str:
            made.append(Answering(f"ipc://{folder}/{next(numbers)}", before, after))
            return made[-1].endpoint

        yield start
        for server in made:
            server.close()


async def connect_once(endpoint: str) -> None:
    async with AsyncClient("t", endpoint=endpoint, connect_timeout_s=LIMIT_S):
        pass


async def ping_runner(endpoint: str) -> None:
    async with RunnerClient(endpoint) as client:
        await client.ping(timeout_s=LIMIT_S)


async def ping_sidecar(endpoint: str) -> None:
    async with SidecarClient(endpoint) as client:
        await client.ping(timeout_s=LIMIT_S)


async def ask_reasoner(endpoint: str) -> None:
    await reasoner.send(endpoint, {"op": "state"}, timeout_s=LIMIT_S)


ASKS = (connect_once, ping_runner, ping_sidecar, ask_reasoner)


def each_at_once(play: Callable[[Any], None]) -> None:
    """Play a story with each of ASKS, all side by side: each stands still for a while."""
    with ThreadPoolExecutor(len(ASKS)) as pool:
        list(pool.map(play, ASKS))


def test_an_answer_that_came_while_the_loop_stood_still_counts(
    serve_answer: Callable[..., str],
) -> None:
    """A program that imported something for longer than its time limit said that no server had
    answered."""

    def play(ask: Any) -> None:
        asked, standing, said = threading.Event(), threading.Event(), threading.Event()

        def before(_: Peer) -> None:
            asked.set()
            standing.wait(PATIENCE_S)

        endpoint = serve_answer(before, lambda _: said.set())

        def stand_still() -> None:
            if not asked.is_set():  # the client connects first, which takes a few turns of its loop
                asyncio.get_running_loop().call_later(0.001, stand_still)
                return
            standing.set()
            said.wait(PATIENCE_S)
            time.sleep(3 * LIMIT_S)

        async def run() -> None:
            asking = asyncio.create_task(ask(endpoint))
            asyncio.get_running_loop().call_soon(stand_still)
            await asking

        asyncio.run(run())
        assert said.is_set(), ask

    each_at_once(play)


def test_a_loop_that_stood_still_before_it_could_ask_still_asks(
    serve_answer: Callable[..., str],
) -> None:
    """A client says nothing before it knows whose server it is: its connection is noticed on its
    loop."""

    def play(ask: Any) -> None:
        asked = threading.Event()
        endpoint = serve_answer(lambda _: asked.set())

        async def run() -> None:
            asking = asyncio.create_task(ask(endpoint))
            asyncio.get_running_loop().call_soon(time.sleep, 3 * LIMIT_S)
            await asking

        asyncio.run(run())
        assert asked.is_set(), ask

    each_at_once(play)


def test_an_answer_that_came_while_the_process_was_stopped_counts(
    serve_answer: Callable[..., str],
) -> None:
    """Regression: answer and time-out were found together after a stop, and the time-out won."""
    stopped: list[int] = []

    def stop(peer: Peer) -> None:
        assert peer.pid is not None
        if not stopped:
            os.kill(peer.pid, signal.SIGSTOP)
            stopped.append(peer.pid)
            time.sleep(2 * STOPPED_LIMIT_S)

    def go_on(peer: Peer) -> None:
        assert peer.pid is not None
        os.kill(peer.pid, signal.SIGCONT)

    endpoint = serve_answer(stop, go_on)
    with running("script", [CLIENT, endpoint], os.environ) as child:
        assert child.line() == "here"
        assert child.ended() == 0
    assert stopped == [child.process.pid]


def test_silence_is_silence() -> None:
    async def run() -> None:
        with pytest.raises(TimeoutError):
            await Answer[None]().within(0.05)
        failing = Answer[None]()
        failing.fail(ZeroDivisionError())
        with pytest.raises(ZeroDivisionError):
            await failing.within(60.0)

    asyncio.run(run())


def test_the_first_end_of_an_answer_counts() -> None:
    async def run() -> None:
        answer = Answer[int]()
        answer.set(1)
        answer.fail(ZeroDivisionError())
        answer.set(2)
        assert (await answer.within(60.0), answer.failed) == (1, False)

    asyncio.run(run())
