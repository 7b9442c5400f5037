"""`vramctl run` where the arbiter answers late or not as hoped: the program has begun, and is
neither cut off from its signals nor left alone."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.support import protocol_wire
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.schemas.defaults import WIRE_VERSION
from vram_arbiter.schemas.errors import LeaseLost, VramError
from vram_arbiter.schemas.plain import Message

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

WAIT_S = 60.0
WELCOME = {
    "version": WIRE_VERSION,
    "boot_id": "b",
    "server": "s",
    "role": "client",
    "heartbeat_s": 60.0,
    "grace_s": 60.0,
}
VIEW = protocol_wire.view(token=[1, 2])
PROGRAM = (
    "import os, signal, sys; signal.signal(15, lambda *_: sys.exit(5)); print(os.getpid(), "
    "flush=True); signal.pause()"
)


class GrantsAtOnce:
    """Grants every lease, and leaves `ready` to the test; anything else is fine with it."""

    def __init__(self, ready: VramError | None) -> None:
        self.ready = ready  # None: no answer
        self.heard: list[str] = []
        self.refused = asyncio.Event()

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[str]:
        with tempfile.TemporaryDirectory(prefix="va") as folder:
            server = RouterServer(
                f"ipc://{folder}/a.sock", lambda error: {"error": error.to_wire()}
            )

            async def handle(peer: Peer, message: Message) -> None:
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
            case "acquire":
                return {"ok": True, "state": "loading", "lease": VIEW}
            case "ready":
                return None if self.ready is None else {"ok": False, "error": self.ready.to_wire()}
        return {"ok": True, **protocol_wire.PLAIN.get(message["op"], {})}


@asynccontextmanager
async def vramctl_run(endpoint: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A program that ends with 5 on SIGTERM, once it is up."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "vram_arbiter.clients", "run", "--vram", "1GiB", "--name", "job",
        "--", sys.executable, "-c", PROGRAM,
        env={**os.environ, "VRAM_ARBITER_ENDPOINT": endpoint}, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    program = os.pidfd_open(int(await process.stdout.readline()))
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(program, signal.SIGKILL)
        os.close(program)
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_a_signal_reaches_the_program_although_the_arbiter_has_not_heard_that_it_runs() -> (
    None
):
    """Regression: until `ready` was answered nobody listened for signals. vramctl ended, its
    program stayed without a lease."""
    arbiter = GrantsAtOnce(ready=None)
    async with (
        asyncio.timeout(WAIT_S),
        arbiter.serving() as endpoint,
        vramctl_run(endpoint) as process,
    ):
        process.send_signal(signal.SIGTERM)
        assert await process.wait() == 5
    assert arbiter.heard[-2:] == ["release", "bye"]


async def test_a_program_whose_lease_is_gone_when_it_has_started_is_waited_for() -> None:
    """Regression: vramctl ended with the error, and its program went on with nobody to pass signals
    to it."""
    arbiter = GrantsAtOnce(ready=LeaseLost("L1-1 expired"))
    async with (
        asyncio.timeout(WAIT_S),
        arbiter.serving() as endpoint,
        vramctl_run(endpoint) as process,
    ):
        await arbiter.refused.wait()
        process.send_signal(signal.SIGTERM)
        assert await process.wait() == 5
