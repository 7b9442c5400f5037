"""Stand-in for a server with OpenAI's API.

`python -m tests.support.openai_server FOLDER BYTES PORT` holds bytes on the simulated GPU in FOLDER
and serves until SIGTERM.

It sleeps and wakes as vLLM does. A chat streams `max_tokens` words, one each time a file named as
the `user` of the body with the word's number appears in FOLDER, or at once without a `user`.
"""

import asyncio
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from tests.support.held_bytes import HeldBytes

POLL_S = 0.01


class OpenAiServer:
    def __init__(self, folder: Path, free: Callable[[], None], load: Callable[[], None]) -> None:
        self.folder, self.free, self.load = folder, free, load

    def app(self) -> web.Application:
        app = web.Application(client_max_size=1 << 30)
        app.router.add_get("/health", self.health)
        app.router.add_post("/v1/chat/completions", self.chat)
        app.router.add_get("/ws", self.socket)
        app.router.add_post("/sleep", self.sleep)
        app.router.add_post("/wake_up", self.wake_up)
        app.router.add_route("*", "/{path:.*}", self.echo)
        return app

    async def health(self, request: web.Request) -> web.Response:
        return web.Response(text="ok")

    async def sleep(self, request: web.Request) -> web.Response:
        self.free()
        return web.Response()

    async def wake_up(self, request: web.Request) -> web.Response:
        self.load()
        return web.Response()

    async def chat(self, request: web.Request) -> web.StreamResponse:
        body = await request.json()
        count = int(body.get("max_tokens") or 2)
        if body["messages"][-1]["content"] == "die":
            print("about to die", flush=True)
            os._exit(7)
        if not body.get("stream"):
            await self.gate(body, 0)
            return web.json_response(completion(body["model"], "word " * count, "message"))
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await response.prepare(request)
        for number in range(count):
            await self.gate(body, number)
            chunk = completion(body["model"], f"{number} ", "delta")
            await response.write(f"data: {json.dumps(chunk)}\n\n".encode())
        await response.write(b"data: [DONE]\n\n")
        return response

    async def gate(self, body: dict[str, Any], number: int) -> None:
        if user := body.get("user"):
            while not (self.folder / f"{user}.{number}").exists():
                await asyncio.sleep(POLL_S)

    async def echo(self, request: web.Request) -> web.Response:
        data = await request.read()
        if request.path == "/large":
            return web.Response(body=b"x" * int(request.query["bytes"]))
        said = {
            "pid": os.getpid(),
            "method": request.method,
            "target": request.raw_path,
            "headers": dict(request.headers),
            "bytes": len(data),
        }
        return web.json_response(
            said, headers={"X-Own": "1", "Connection": "x-secret", "X-Secret": "1"}
        )

    async def socket(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(protocols=("chat",))
        await socket.prepare(request)
        async for message in socket:
            if message.type is WSMsgType.TEXT:
                await socket.send_str(f"echo {message.data}")
            elif message.type is WSMsgType.BINARY:
                await socket.send_bytes(message.data)
        return socket


def completion(model: str, words: str, part: str) -> dict[str, Any]:
    choice = {"index": 0, part: {"role": "assistant", "content": words}, "finish_reason": None}
    kind = "chat.completion" if part == "message" else "chat.completion.chunk"
    return {"id": "1", "object": kind, "created": 1, "model": model, "choices": [choice]}


async def serve(server: OpenAiServer, port: int) -> None:
    runner = web.AppRunner(server.app(), shutdown_timeout=0.1)
    await runner.setup()
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    await web.TCPSite(runner, "127.0.0.1", port).start()
    print(f"serves on {port}", flush=True)
    await stop.wait()
    await runner.cleanup()


def main(folder: str, size: str, port: str) -> None:
    held = HeldBytes(folder, size)
    asyncio.run(serve(OpenAiServer(Path(folder), held.free, held.load), int(port)))
    held.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
