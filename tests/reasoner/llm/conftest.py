"""A local server that speaks HTTP: scripted answers, and the misbehavior of real ones: silence,
drips, floods, hang-ups.
"""

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from tests.support.llm_apis import KEY, PALETTE, Anthropic, OpenAi
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Episode

Answer = Callable[[BaseHTTPRequestHandler], None]


class StandIn:
    """Answers each request with the next scripted answer, and remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.paths: list[str] = []
        self.headers: list[dict[str, str]] = []
        self.answers: list[Answer] = []
        self.begun = threading.Event()
        self.over = threading.Event()
        stand_in = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                stand_in.asked.append(
                    json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                )
                stand_in.paths.append(self.path)
                stand_in.headers.append(
                    {name.lower(): value for name, value in self.headers.items()}
                )
                stand_in.begun.set()
                stand_in.answers.pop(0)(self)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, request: Any, client_address: Any) -> None:
                pass  # the client hung up on a hanging answer, as it should

        self.server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"

    def body(self, body: bytes, status: int = 200, headers: dict[str, str] | None = None) -> None:
        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.send_response(status)
            for name, value in (headers or {}).items():
                handler.send_header(name, value)
            handler.end_headers()
            handler.wfile.write(body)

        self.answers.append(answer)

    def json(self, body: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        self.body(json.dumps(body).encode(), status, headers)

    def hangs(self) -> None:
        """Takes the request and says nothing while the test lasts."""
        self.answers.append(lambda handler: self.over.wait(30) and None)

    def drips(self) -> None:
        """A space every 20 ms, for ever: each read succeeds, the answer never ends."""

        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.send_response(200)
            handler.end_headers()
            while not self.over.wait(0.02):
                handler.wfile.write(b" ")
                handler.wfile.flush()

        self.answers.append(answer)

    def floods(self) -> None:
        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.send_response(200)
            handler.end_headers()
            while not self.over.is_set():
                handler.wfile.write(b"x" * 65536)

        self.answers.append(answer)

    def hangs_up(self) -> None:
        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.connection.close()

        self.answers.append(answer)


@pytest.fixture
def stand_in() -> Iterator[StandIn]:
    server = StandIn()
    thread = threading.Thread(target=server.server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield server
    server.over.set()
    server.server.shutdown()
    server.server.server_close()
    thread.join()


@pytest.fixture(params=[OpenAi, Anthropic])
def api(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture
def decide(api: Any, stand_in: Any) -> Callable[..., Any]:
    def run(
        episode: Episode | None = None,
        *,
        timeout_s: float = 20.0,
        palette: Palette = PALETTE,
        pauses: list[float] | None = None,
        **more: Any,
    ) -> Any:
        config = LlmConfig(stand_in.url + api.base, "m", KEY, timeout_s)

        async def pause(seconds: float) -> None:
            if pauses is not None:
                pauses.append(seconds)

        async def once() -> Any:
            async with api.planner(config, palette, pause=pause, **more) as planner:
                return await planner.decide(episode or Episode("grab the red cube"))

        return asyncio.run(once())

    return run
