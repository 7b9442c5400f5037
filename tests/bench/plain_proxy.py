"""Plain restart-on-demand proxy, for comparison: one server at a time, by llama-swap's rule.

A request for the server that runs is passed on at once. One for another server waits until the
running server has no request left; then that process is ended, and the next is started when it has
ended. Nothing is measured, and a start that fails fails the requests that waited for it
(`internal/router/scheduler/fifo.go` of llama-swap).

`python -m tests.bench.plain_proxy PORT MODELS`: MODELS is JSON, name → [port, command…].
"""

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator

import aiohttp
from aiohttp import web

LOOK_S = 0.05
"""Between two looks at the health of a server that starts."""


class Swap:
    """The running server, and the requests in it."""

    def __init__(self, models: dict[str, list[str]]) -> None:
        self._models = models
        self._ready = ""
        self._process: asyncio.subprocess.Process | None = None
        self._swap: tuple[str, asyncio.Task[None]] | None = None
        self._in_flight = 0
        self._changed = asyncio.Condition()

    @contextlib.asynccontextmanager
    async def serving(self, model: str) -> AsyncIterator[str]:
        """Wait until a model's server runs. Raises RuntimeError where it does not start."""
        while self._ready != model and (self._swap is None or self._swap[0] != model):
            if self._swap is None and self._in_flight == 0:
                self._swap = model, asyncio.create_task(self._to(model))
            else:
                async with self._changed:
                    await self._changed.wait()
        self._in_flight += 1  # before the next of the queue looks
        try:
            if self._swap is not None:
                await asyncio.shield(self._swap[1])
            yield f"http://127.0.0.1:{self._models[model][0]}"
        finally:
            self._in_flight -= 1
            await self._tell()

    async def _to(self, model: str) -> None:
        self._ready = ""
        try:
            await self.stop()
            self._process = await asyncio.create_subprocess_exec(*self._models[model][1:])
            await self._healthy(f"http://127.0.0.1:{self._models[model][0]}/health")
            self._ready = model
        finally:
            self._swap = None
            await self._tell()

    async def _healthy(self, url: str) -> None:
        assert self._process is not None
        async with aiohttp.ClientSession() as session:
            while self._process.returncode is None:
                with contextlib.suppress(aiohttp.ClientError):
                    async with session.get(url) as answer:
                        if answer.status == 200:
                            return
                await asyncio.sleep(LOOK_S)
        raise RuntimeError(f"the server ended with {self._process.returncode}")

    async def stop(self) -> None:
        if self._process is not None and self._process.returncode is None:
            self._process.terminate()
            await self._process.wait()

    async def _tell(self) -> None:
        async with self._changed:
            self._changed.notify_all()


def app(swap: Swap) -> web.Application:
    async def forward(request: web.Request) -> web.StreamResponse:
        body = await request.read()
        try:
            async with swap.serving(json.loads(body)["model"]) as url:
                sent = request.app["session"].post(url + request.path, data=body)
                async with sent as answer:
                    stream = web.StreamResponse(status=answer.status)
                    stream.content_type = answer.content_type
                    await stream.prepare(request)
                    async for chunk in answer.content.iter_any():
                        await stream.write(chunk)
                    return stream
        except RuntimeError as error:
            return web.json_response({"error": str(error)}, status=502)

    async def life(app: web.Application) -> AsyncIterator[None]:
        async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(None)) as app["session"]:
            yield
            await swap.stop()

    made = web.Application()
    made.router.add_post("/v1/chat/completions", forward)
    made.cleanup_ctx.append(life)
    return made


async def _make(models: dict[str, list[str]]) -> web.Application:
    return app(Swap(models))


if __name__ == "__main__":
    chosen = json.loads(sys.argv[2])
    web.run_app(_make(chosen), host="127.0.0.1", port=int(sys.argv[1]), print=None, access_log=None)
