"""Stand-in for a model server: answers as vLLM, Ollama, llama.cpp's router and ComfyUI do.

The router's answers are those of a real `llama-server`, by which it was compared.

`python -m tests.support.model_server FOLDER BYTES HOST PORT [BROKEN…]` holds bytes on the simulated
GPU in FOLDER until it is told to free them, prints its pid, and serves until SIGTERM.
"""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import FrameType
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from tests.support.held_bytes import HeldBytes


@dataclass
class Refusal:
    """An answer with status 400."""

    message: str


class ModelServer:
    """A server with two models loaded.

    `heard`: what was called, in order. `busy`: answers of the next looks at its work, then 0.
    `broken`: paths that answer with this status. `states`: llama.cpp's models that are not loaded;
    `lost`: those whose load or download an unload has ended.
    """

    def __init__(
        self,
        free: Callable[[], None] = lambda: None,
        load: Callable[[], None] = lambda: None,
        address: tuple[str, int] = ("127.0.0.1", 0),
    ) -> None:
        self.loaded = ["a", "b"]
        self.heard: list[tuple[str, Any]] = []
        self.busy: list[int] = []
        self.broken: dict[str, int] = {}
        self.states = {"c": "unloaded"}
        self.lost: list[str] = []
        self.lingering = 0  # looks at the list of models that still show those being unloaded
        self._leaving: list[str] = []
        self._free, self._load = free, load
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                pass

            def do_GET(self) -> None:
                outer.serve(self)

            do_POST = do_PUT = do_GET

        self._server = ThreadingHTTPServer(address, Handler)
        self._server.daemon_threads = True
        self.url = f"http://{address[0]}:{self._server.server_address[1]}"

    def __enter__(self) -> "ModelServer":
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def serve(self, request: BaseHTTPRequestHandler) -> None:
        parts = urlsplit(request.path)
        sent = request.rfile.read(int(request.headers.get("Content-Length", 0)))
        body = json.loads(sent) if sent else None
        self.heard.append((f"{request.command} {request.path}", body))
        status = self.broken.get(parts.path, 200)
        answer: object = "broken <&>\x1b"
        if status == 200:
            answer = self.answer(parts.path, body or dict(parse_qsl(parts.query)))
        if isinstance(answer, Refusal):
            status, answer = 400, {"error": {"code": 400, "message": answer.message}}
        data = (answer if isinstance(answer, str) else json.dumps(answer)).encode()
        request.send_response(status)
        request.send_header("Content-Length", str(len(data)))
        request.end_headers()
        request.wfile.write(data)

    def answer(self, path: str, body: Any) -> object:
        match path:
            case "/sleep" | "/free":
                self.unload(*self.loaded)
            case "/wake_up" | "/restore":
                self._load()
            case "/api/generate" if body["keep_alive"] == 0:
                self.unload(body["model"])
                return {"done": True, "done_reason": "unload"}
            case "/models/unload":
                return self.unload_routed(body["model"])
            case "/api/ps":
                return {"models": [{"model": name, "size_vram": 1} for name in self.listed()]}
            case "/models":
                shown = dict.fromkeys("ab", "unloaded") | self.states
                shown |= dict.fromkeys(self.listed(), "loaded")
                failed = {"failed": True, "exit_code": 1}  # beside `unloaded`
                return {
                    "data": [
                        {"id": name, "status": {"value": value, **(failed if name == "c" else {})}}
                        for name, value in shown.items()
                    ]
                }
            case "/metrics":
                count = self.busy.pop(0) if self.busy else 0
                return f'# HELP x\nvllm:num_requests_running{{m="a b"}} {count}.0\nother 7\n'
            case "/slots" if body["model"] not in self.loaded:
                if body.get("autoload") == "false":
                    return Refusal("model is not loaded")
                self.loaded.append(body["model"])
                return [{"id": 0, "is_processing": False}]
            case "/slots":
                return [{"id": 0, "is_processing": bool(self.busy and self.busy.pop(0))}]
            case "/queue":
                count = self.busy.pop(0) if self.busy else 0
                return {"queue_running": [[1]] * count, "queue_pending": []}
        return {}

    def unload(self, *names: str) -> None:
        for name in names:
            self.loaded.remove(name)
            self._leaving.append(name)
        if not self.loaded:
            self._free()

    def unload_routed(self, name: str) -> "Refusal | dict[str, bool]":
        """Unload as the router does: it ends whatever the model is about."""
        state = self.states.get(name)
        if name in self.loaded:
            self.unload(name)
        elif state in ("loading", "downloading"):
            self.lost.append(name)
            self.states[name] = "unloaded"
        elif state == "sleeping":
            self.states[name] = "unloaded"
        else:
            return Refusal("model is not running")
        return {"success": True}

    def listed(self) -> list[str]:
        """Models that a list shows: those being unloaded too, for a while."""
        if self.lingering and self._leaving:
            self.lingering -= 1
            return self.loaded + self._leaving
        return self.loaded


def main(folder: str, size: str, host: str, port: str, *broken: str) -> None:
    held = HeldBytes(folder, size)

    def end(number: int, frame: FrameType | None) -> None:
        held.close()
        sys.exit(0)

    signal.signal(signal.SIGTERM, end)
    with ModelServer(held.free, held.load, (host, int(port))) as server:
        server.broken = dict.fromkeys(broken, 500)
        print(os.getpid(), flush=True)
        signal.pause()


if __name__ == "__main__":
    main(*sys.argv[1:])
