"""A sidecar of the tests, in a process of its own: the op family on `clients.net.server`, without
any model. Not a test module.

Usage: server_process.py ENDPOINT [crash | silent | slow]. `crash` prints and exits with 3, `silent`
never serves.
"""

import asyncio
import os
import sys
import time
from typing import Any

from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.schemas.errors import CODES, VramError

DYING_S = 1.5
"""A process that held gigabytes of a GPU hangs up long before the kernel says that it has
ended."""


def failure(error: VramError) -> dict[str, Any]:
    return {
        "ok": False,
        "error": f"{type(error).__name__}: {error.message}",
        "code": error.code,
        "hint": error.hint,
        "details": error.details,
    }


async def main(endpoint: str, mode: str) -> None:
    if mode == "crash":
        print("cannot find the weights")
        raise SystemExit(3)
    if mode == "silent":
        await asyncio.Event().wait()
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
                case "detect" if message["query"] == "die slowly":
                    os.closerange(
                        3, 1024
                    )  # as the kernel does, before it says that a process has ended
                    time.sleep(DYING_S)
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


asyncio.run(main(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else ""))
