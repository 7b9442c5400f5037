"""Stand-in for a model server, for demo, tests and benchmarks: OpenAI's chat completions, with a
model's bytes on the simulated GPU.

`python -m vram_arbiter.sidecars.gateway.stand_in NAME BYTES PORT` allocates what its model would
take and ends with exit code 1 where that does not fit, as a real server does. It says the words of
its answer at the pace of `--token-s`.
"""

import argparse
import asyncio
import json
import os
import sys
import time
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any, ClassVar, Final

from aiohttp import web

from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.fakegpu import SimulatedOutOfMemory
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.sizes import parse_bytes
from vram_arbiter.sidecars.device.fake import FakeMemory

WORDS: Final = ("the", " arm", " moves", " to", " the", " cup", " and", " lifts", " it", ".")


class StandIn:
    """Answers of one model. `token_s`: pause before each word."""

    words: ClassVar[Sequence[str]] = WORDS
    tokens: ClassVar = 16
    """Where a request does not limit them."""

    def __init__(self, name: str, token_s: float) -> None:
        self._name, self._token_s = name, token_s

    def app(self) -> web.Application:
        app = web.Application()
        app.router.add_get("/health", self._health)
        app.router.add_get("/v1/models", self._models)
        app.router.add_post("/v1/chat/completions", self.complete)
        return app

    async def _health(self, request: web.Request) -> web.Response:
        return web.json_response({"status": "ok"})

    async def _models(self, request: web.Request) -> web.Response:
        models = [{"id": self._name, "object": "model", "owned_by": "stand-in"}]
        return web.json_response({"object": "list", "data": models})

    async def complete(self, request: web.Request) -> web.StreamResponse:
        wanted = await request.json()
        count = int(wanted.get("max_tokens") or self.tokens)
        words = islice(cycle(self.words), count)
        if not wanted.get("stream"):
            await self.pause(wanted, 0, count)
            answer = {"role": "assistant", "content": "".join(words)}
            return web.json_response(self._said("message", answer, "stop"))
        stream = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await stream.prepare(request)
        for number, word in enumerate(words):
            await self.pause(wanted, number, 1)
            told = self._said("delta", {"content": word}, None)
            await stream.write(f"data: {json.dumps(told)}\n\n".encode())
        await stream.write_eof(b"data: [DONE]\n\n")
        return stream

    async def pause(self, wanted: JsonMap, first: int, count: int) -> None:
        """Wait for `count` words of the answer to `wanted`, from number `first` on."""
        if self._token_s:
            await asyncio.sleep(self._token_s * count)

    def _said(self, key: str, text: dict[str, str], end: str | None) -> dict[str, Any]:
        choice = {"index": 0, key: text, "finish_reason": end}
        return {
            "id": f"chatcmpl-{os.getpid()}",
            "object": "chat.completion" if end else "chat.completion.chunk",
            "created": int(time.time()),
            "model": self._name,
            "choices": [choice],
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name")
    parser.add_argument("size", type=parse_bytes)
    parser.add_argument("port", type=int)
    parser.add_argument("--token-s", type=float, default=0.02, help="default %(default)s")
    parser.add_argument("--load-s", type=float, default=0.0, help="default %(default)s")
    args = parser.parse_args()
    memory = FakeMemory(Path(os.environ[fakegpu.FOLDER_VARIABLE]), args.name)
    try:
        memory.allocate("weights", args.size - RESIDUE_BYTES)
    except SimulatedOutOfMemory as error:
        print(f"{args.name}: {error}", file=sys.stderr)
        return 1
    time.sleep(args.load_s)
    try:
        app = StandIn(args.name, args.token_s).app()
        web.run_app(app, host="127.0.0.1", port=args.port, print=None, access_log=None)
    finally:
        memory.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
