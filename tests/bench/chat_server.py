"""`python -m tests.bench.chat_server PORT`: a stand-in model server that answers at once, without a
GPU, and downloads: `GET /bytes/COUNT`."""

import sys
from typing import Final

from aiohttp import web

from vram_arbiter.sidecars.gateway.stand_in import StandIn

CHUNK: Final = bytes(1 << 18)


async def _download(request: web.Request) -> web.StreamResponse:
    """COUNT is rounded up to whole chunks."""
    stream = web.StreamResponse()
    await stream.prepare(request)
    for _ in range(0, int(request.match_info["count"]), len(CHUNK)):
        await stream.write(CHUNK)
    return stream


def _app() -> web.Application:
    app = StandIn("chat", 0.0).app()
    app.router.add_get("/bytes/{count}", _download)
    return app


if __name__ == "__main__":
    web.run_app(_app(), host="127.0.0.1", port=int(sys.argv[1]), print=None, access_log=None)
