"""A language model's server with OpenAI's API, whose every answer is one call of a tool."""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tests.support.llm_apis import OpenAi

type Decide = Callable[[dict[str, Any]], tuple[str, dict[str, Any]]]
"""Name and arguments of the call that answers a request."""


@contextlib.contextmanager
def chat_server(decide: Decide) -> Iterator[str]:
    """Yield its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            name, arguments = decide(asked)
            body = json.dumps(OpenAi.says((name, json.dumps(arguments)))).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
