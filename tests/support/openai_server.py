"""The gateway's stand-in for a model server (`sidecars.gateway.stand_in`), with what tests need.

`python -m tests.support.openai_server FOLDER BYTES PORT` holds bytes on the simulated GPU in FOLDER
and serves until SIGTERM.

It sleeps and wakes as vLLM does. A chat says `max_tokens` words, each once a file named as the
`user` of the body with the word's number appears in FOLDER, or at once without a `user`. Asked with
tools, it plans. Any other path answers what it was asked.
"""

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from aiohttp import WSMsgType, web

from tests.support.held_bytes import HeldBytes
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.sidecars.gateway.stand_in import StandIn

POLL_S = 0.01


class OpenAiServer(StandIn):
    words: ClassVar = tuple(f"{number} " for number in range(10))
    tokens: ClassVar = 2

    def __init__(self, folder: Path, free: Callable[[], None], load: Callable[[], None]) -> None:
        super().__init__("stand-in", 0.0)
        self.folder, self.free, self.load = folder, free, load

    def app(self) -> web.Application:
        app = super().app()
        app.router.add_get("/ws", self.socket)
        app.router.add_post("/sleep", self.sleep)
        app.router.add_post("/wake_up", self.wake_up)
        app.router.add_route("*", "/{path:.*}", self.echo)
        return app

    async def sleep(self, request: web.Request) -> web.Response:
        self.free()
        return web.Response()

    async def wake_up(self, request: web.Request) -> web.Response:
        self.load()
        return web.Response()

    async def complete(self, request: web.Request) -> web.StreamResponse:
        wanted = await request.json()
        last = wanted["messages"][-1]
        if last["content"] == "die":
            print("about to die", flush=True)
            os._exit(7)
        if "tools" in wanted:
            return web.json_response(planned(done=last["role"] == "tool"))
        return await super().complete(request)

    async def pause(self, wanted: JsonMap, first: int, count: int) -> None:
        if user := wanted.get("user"):
            while not (self.folder / f"{user}.{first}").exists():
                await asyncio.sleep(POLL_S)

    async def echo(self, request: web.Request) -> web.Response:
        if request.path == "/large":
            return web.Response(body=b"x" * int(request.query["bytes"]))
        said = {
            "pid": os.getpid(),
            "method": request.method,
            "target": request.raw_path,
            "headers": dict(request.headers),
            "bytes": sum([len(data) async for data in request.content.iter_any()]),
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


def planned(*, done: bool) -> object:
    """Return what a planner says: to drive, and once it did, to finish."""
    from tests.support.llm_apis import OpenAi

    if done:
        return OpenAi.says(("finish", '{"success": true, "reason": "here"}'))
    return OpenAi.says(("execute_rskill__lab__go", "{}"))


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
