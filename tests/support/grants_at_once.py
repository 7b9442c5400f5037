"""A scripted arbiter that grants every lease."""

import asyncio
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Literal

from tests.support import protocol_wire
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.schemas.defaults import WIRE_VERSION
from vram_arbiter.schemas.errors import LeaseLost, VramError, VramInsufficient
from vram_arbiter.schemas.plain import Message

WELCOME = {
    "version": WIRE_VERSION,
    "boot_id": "b",
    "server": "s",
    "role": "client",
    "heartbeat_s": 60.0,
    "grace_s": 60.0,
}


class GrantsAtOnce:
    """Grants every lease, and leaves `ready` to the test; anything else is fine with it."""

    def __init__(self, ready: VramError | Literal["ok"] | None) -> None:
        self.ready = ready  # None: no answer
        self.heard: list[str] = []
        self.refused = asyncio.Event()
        self.grants = 0
        self.grants_max: int | None = None  # further requests are denied
        self._server: RouterServer | None = None
        self._peer: Peer | None = None

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[str]:
        with tempfile.TemporaryDirectory(prefix="va") as folder:
            server = RouterServer(
                f"ipc://{folder}/a.sock", lambda error: {"error": error.to_wire()}
            )

            self._server = server

            async def handle(peer: Peer, message: Message) -> None:
                self._peer = peer
                reply = self.reply(message)
                if reply is not None:
                    await server.send(peer, {"re": message["id"], "epoch": 1, **reply})
                if message["op"] == "ready" and self.ready is not None:
                    self.refused.set()

            async with server:
                task = asyncio.create_task(server.serve(handle))
                yield server.endpoint
                task.cancel()

    def reply(self, message: Message) -> dict[str, Any] | None:
        self.heard.append(message["op"])
        match message["op"]:
            case "hello":
                return {"ok": True, **WELCOME}
            case "acquire" if self.grants == self.grants_max:
                return {"ok": False, "error": VramInsufficient("too large").to_wire()}
            case "acquire":
                self.grants += 1
                view = protocol_wire.view(f"L1-{self.grants}", [1, 1 + self.grants])
                return {"ok": True, "state": "loading", "lease": view}
            case "ready" if self.ready != "ok":
                return None if self.ready is None else {"ok": False, "error": self.ready.to_wire()}
        return {"ok": True, **protocol_wire.PLAIN.get(message["op"], {})}

    async def lose(self) -> None:
        """End the newest lease, as after its TTL."""
        assert self._server is not None
        assert self._peer is not None
        lease = {"lease_id": f"L1-{self.grants}", "token": [1, 1 + self.grants]}
        error = LeaseLost(f"L1-{self.grants} expired").to_wire()
        await self._server.send(self._peer, {"push": "lost", "epoch": 1, **lease, "error": error})
