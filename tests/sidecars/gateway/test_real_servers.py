"""The gateway with a stock client before llama.cpp itself, on a CPU; its bytes are simulated."""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")
pytest.importorskip("xllamacpp", reason="llama.cpp has no wheel here")

from tests.sidecars.gateway.conftest import KEY, GatewayProcess
from tests.support.leases import view_of
from tests.support.process import ArbiterProcess
from tests.support.tiny_gguf import write_gguf
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.sync import Client

# test_gateway has the same with stand-ins
pytestmark = [pytest.mark.anyio, pytest.mark.e2e, pytest.mark.nightly]
HELLO = [{"role": "user", "content": "hello"}]
WORDS = 2000
"""Of an answer that takes a second of a core: it is stopped at its first word."""


@pytest.fixture
def servers(
    gateway: Callable[..., GatewayProcess], arbiter_daemon: ArbiterProcess, tmp_path: Path
) -> Iterator[GatewayProcess]:
    """A gateway before two llama.cpp, of which one fits at a time."""
    models = {name: tmp_path / f"{name}.gguf" for name in "ab"}
    program = [sys.executable, "-m", "tests.support.llama_server", str(arbiter_daemon.gpu_folder)]
    configured = {}
    for name, model in models.items():
        write_gguf(model)
        configured[name] = {
            "command": [*program, str(5 << 30), str(model), "{port}"],
            "vram": "5GiB",
            "min_residency_s": 0.25,
            "grace_s": PATIENCE_S,
        }
    yield gateway(configured)
    for path in tmp_path.glob("*.pid"):  # one may be stopped
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(path.read_text()), signal.SIGCONT)


async def test_a_stock_client_talks_with_two_servers_in_room_for_one(
    servers: GatewayProcess, tmp_path: Path
) -> None:
    import openai  # 1.6 s of a core, for each worker that collects this file

    async with openai.AsyncOpenAI(
        base_url=f"{servers.url}/v1", api_key=KEY, timeout=PATIENCE_S, max_retries=0
    ) as client:
        # in the middle of a load
        first = asyncio.create_task(_chat(client, "a", 5))
        pid = await _process_of(tmp_path, "a")
        os.kill(pid, signal.SIGSTOP)
        other = asyncio.create_task(_chat(client, "b", 5))
        await eventually(lambda: servers.running().get("b", {}).get("lease") == "queued")
        assert servers.running()["a"]["lease"] == "starting"
        os.kill(pid, signal.SIGCONT)
        assert await asyncio.gather(first, other) == [5, 5]

        # in the middle of a stream
        pid = await _process_of(tmp_path, "b")
        stream = await _stream(client, "b", WORDS)
        await anext(stream)
        os.kill(pid, signal.SIGSTOP)
        other = asyncio.create_task(_chat(client, "a", 5))
        await eventually(lambda: servers.running()["b"]["lease"] == "leaving")
        with Client("t", endpoint=servers.arbiter.endpoint) as arbiter:
            assert view_of(arbiter, "b").uses == 1
        os.kill(pid, signal.SIGCONT)
        assert [chunk async for chunk in stream][-1].usage.completion_tokens == WORDS
        assert await other == 5


async def _stream(client: Any, model: str, words: int) -> Any:
    return await client.chat.completions.create(
        model=model,
        messages=HELLO,
        max_tokens=words,
        stream=True,
        stream_options={"include_usage": True},
        extra_body={"ignore_eos": True},
    )


async def _chat(client: Any, model: str, words: int) -> int:
    """Return the number of tokens of a whole answer."""
    chunks = [chunk async for chunk in await _stream(client, model, words)]
    return int(chunks[-1].usage.completion_tokens)


async def _process_of(folder: Path, name: str) -> int:
    """Return the process of a server, which may not have loaded yet."""
    path = folder / f"{name}.gguf.pid"
    await eventually(lambda: path.exists() and path.read_text())
    return int(path.read_text())
