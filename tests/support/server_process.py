"""A sidecar of the tests: the op family on `clients.net.server`, without any model.

Usage: `prepared.start("op-server", [ENDPOINT], …)`.
"""

import asyncio
import os
import sys
from typing import Any

from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.schemas.errors import CODES, VramError


def failure(error: VramError) -> dict[str, Any]:
    return {
        "ok": False,
        "error": f"{type(error).__name__}: {error.message}",
        "code": error.code,
        "hint": error.hint,
        "details": error.details,
    }


async def _serve(endpoint: str) -> None:
    stopped = asyncio.Event()

    async with RouterServer(endpoint, failure) as server:

        async def handle(peer: Peer, message: dict[str, Any]) -> None:
            op = message.get("op") or message.get("endpoint")
            reply: dict[str, Any] = {"ok": True}
            match op:
                case "ping":
                    reply |= {"pid": os.getpid(), "state": "resident", "model": "test"}
                case "detect" if message["query"] in CODES:
                    reply = failure(CODES[message["query"]]("as asked", hint="h", details={"n": 1}))
                case "detect" if message["query"] == "die":
                    os._exit(9)
                case "detect" if message["query"] == "hang":
                    return
                case "detect" if message["query"] == "old":
                    reply = {"ok": False, "error": "ValueError: from an older server"}
                case "detect" if message["query"] == "wrong":
                    reply |= {"detections": [{"label": "x"}]}
                case "detect":
                    boxes = [("a", 0.2, [0, 0, 2, 4]), ("b", 0.9, [1, 1, 3, 3])]
                    reply |= {
                        "detections": [{"label": a, "score": s, "box": b} for a, s, b in boxes]
                    }
                case "query":
                    reply |= {"answer": f"{message['question']} {message.get('token')}"}
                case "load":
                    reply |= {"lease_id": "L1-1", "token": [1, 2], "loaded": True}
                case "reset":
                    reply |= {"seed": message["data"].get("seed")}
                case "get_action":
                    reply = {
                        "result": [
                            {"action": message["data"]["observation"]["state"]},
                            {"steps": 1},
                        ]
                    }
                case "shutdown":
                    stopped.set()
            await server.send(peer, reply | {"re": message.get("id")})

        serving = asyncio.create_task(server.serve(handle))
        await stopped.wait()
        await asyncio.sleep(0.05)  # the answer to `shutdown` leaves first
        serving.cancel()


def main() -> None:
    """Serve at the endpoint of `sys.argv` until `shutdown`."""
    asyncio.run(_serve(sys.argv[1]))
