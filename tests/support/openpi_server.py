"""A policy server of openpi, as its `serve_policy.py` serves one (`websocket_policy_server.py`).

The same frames in the same order, by the same packages: metadata on connect, msgpack maps of
`openpi_client.msgpack_numpy`, the traceback as a text before it hangs up, `/healthz`. What it
answers, and what else a test wants of it, is said from outside.
"""

import asyncio
import http
import time
import traceback
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from openpi_client import msgpack_numpy
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response


class OpenpiServer:
    """`infer`: the policy; `held`: answers wait for it."""

    def __init__(self, infer: Callable[[dict[Any, Any]], dict[str, Any]]) -> None:
        self.infer = infer
        self.heard: list[dict[Any, Any]] = []
        self.connections: list[ServerConnection] = []
        self.held = asyncio.Event()
        self.held.set()

    @asynccontextmanager
    async def served(self) -> AsyncIterator[str]:
        """Serve within the block, at the URL that it gives."""
        async with serve(
            self._talk, "127.0.0.1", 0, compression=None, max_size=None, process_request=_health
        ) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            yield f"ws://127.0.0.1:{port}"
            server.close()

    async def _talk(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        await connection.send(msgpack_numpy.packb({"reset_pose": [0.0, 0.0]}))
        while True:
            try:
                seen = msgpack_numpy.unpackb(await connection.recv())
                self.heard.append(seen)
                began_s = time.monotonic()
                answer = self.infer(seen)
                answer["server_timing"] = {"infer_ms": (time.monotonic() - began_s) * 1000}
                await self.held.wait()
                await connection.send(msgpack_numpy.packb(answer))
            except ConnectionClosed:
                break
            except Exception:  # noqa: BLE001  as upstream does
                await connection.send(traceback.format_exc())
                await connection.close(
                    code=CloseCode.INTERNAL_ERROR,
                    reason="Internal server error. Traceback included in previous frame.",
                )
                break


def _health(connection: ServerConnection, request: Request) -> Response | None:
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None
