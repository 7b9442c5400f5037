"""A local server of a language model: scripted answers, or a call of a tool that each request
decides, and the misbehavior of real ones: silence, drips, floods, hang-ups.
"""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

from tests.support.llm_apis import OpenAi

type Decide = Callable[[dict[str, Any]], tuple[str, dict[str, Any]]]
"""Name and arguments of the call that answers a request."""
type Answer = Callable[[BaseHTTPRequestHandler], object]


class StandIn:
    """Answers each request with the next scripted answer, or as `decide` says by OpenAI's API, and
    remembers what it was asked. Serves until the end of its block."""

    def __init__(self, decide: Decide | None = None) -> None:
        self.asked: list[dict[str, Any]] = []
        self.paths: list[str] = []
        self.headers: list[dict[str, str]] = []
        self.answers: list[Answer] = []
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
                if decide is not None:
                    name, arguments = decide(stand_in.asked[-1])
                    stand_in.json(OpenAi.says((name, json.dumps(arguments))))
                stand_in.answers.pop(0)(self)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, request: Any, client_address: Any) -> None:
                pass  # the client hung up on a hanging answer, as it should

        self.server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        self._thread = threading.Thread(
            target=self.server.serve_forever, kwargs={"poll_interval": 0.02}
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.server.shutdown()
        self.server.server_close()
        self._thread.join()

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
        self.answers.append(lambda handler: self.over.wait(30))

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


@contextlib.contextmanager
def chat_server(decide: Decide) -> Iterator[str]:
    """Yield the URL of a server that decides."""
    with StandIn(decide) as server:
        yield server.url
