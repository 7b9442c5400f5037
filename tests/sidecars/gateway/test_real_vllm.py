"""The gateway before vLLM itself, on a CPU; its bytes are simulated.

`make setup-vllm` makes vLLM's environment. Sleep mode is CUDA's alone: on a CPU the endpoints of
the preset answer as on a GPU, requests stop and wait, and the memory stays where it is.
"""

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import httpx
import openai
import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")

from tests.sidecars.gateway.conftest import KEY, GatewayProcess, stand_in
from tests.support.leases import view_of
from tests.support.process import ArbiterProcess
from tests.support.processes import alive, children
from tests.support.vllm_server import CONTEXT, save_llama
from tests.support.waiting import eventually, until
from vram_arbiter.clients.foreign.servers import Vllm
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.runtime.ports import free_port
from vram_arbiter.sidecars.gateway.setup import FoundServer, asked

PYTHON: Final = Path(__file__).parents[3] / ".venv-vllm/bin/python"
pytestmark = [
    pytest.mark.anyio,
    pytest.mark.e2e,
    pytest.mark.heavy,
    pytest.mark.nightly,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(not PYTHON.exists(), reason="needs vLLM: make setup-vllm"),
]
LOAD_S: Final = 600.0
"""Of a load, which takes minutes on a busy machine."""
WORDS: Final = 300
"""Of an answer that takes 3 s of a core: it is stopped at its first word."""
HELLO = [{"role": "user", "content": "hello"}]
ENVIRONMENT = {
    "HF_HUB_OFFLINE": "1",
    "OMP_NUM_THREADS": "1",
    "PYTHONDONTWRITEBYTECODE": "",  # compiling all of it takes longer than the load
    "VLLM_CPU_KVCACHE_SPACE": "1",
    "VLLM_CPU_OMP_THREADS_BIND": "nobind",
    "VLLM_NO_USAGE_STATS": "1",
    "VLLM_SERVER_DEV_MODE": "1",
}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("llama")
    save_llama(folder)
    return folder


class Bench:
    """A gateway before vLLM, named `a`, and a stand-in `b`, of which one fits at a time."""

    def __init__(self, gateway: GatewayProcess, port: int) -> None:
        self.gateway, self.port, self.url = gateway, port, f"http://127.0.0.1:{port}"
        self.client = openai.AsyncOpenAI(
            base_url=f"{gateway.url}/v1", api_key=KEY, timeout=LOAD_S, max_retries=0
        )

    async def chat(self, server: str) -> str:
        """Return why a whole answer of five tokens ended."""
        chat: Any = self.client.chat.completions
        answer = await chat.create(
            model=server, messages=HELLO, max_tokens=5, extra_body={"ignore_eos": True}
        )
        return str(answer.choices[0].finish_reason)

    async def stream(self, words: int) -> AsyncIterator[Any]:
        """Return a stream of vLLM's after its first chunk."""
        chat: Any = self.client.chat.completions
        stream = await chat.create(
            model="a",
            messages=HELLO,
            max_tokens=words,
            stream=True,
            stream_options={"include_usage": True},
            extra_body={"ignore_eos": True},
        )
        await anext(stream)
        return stream

    async def until_lease(self, server: str, state: str | None) -> None:
        """Wait until a server is in a state, with a program; None: away."""

        def there() -> bool:
            found = self.gateway.running().get(server)
            return (found and found["lease"]) == state

        await asyncio.to_thread(until, there, LOAD_S)

    def lease(self) -> Any:
        with Client("t", endpoint=self.gateway.arbiter.endpoint) as arbiter:
            return view_of(arbiter, "a")

    @property
    def process(self) -> int:
        """Process of vLLM's HTTP server."""
        (pid,) = children(self.lease().pid)
        return pid

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Let the engine stand still, so that a request stays in flight."""
        engines = [
            pid
            for pid in children(self.process)
            if b"EngineCore" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        (engine,) = engines
        os.kill(engine, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(engine, signal.SIGCONT)


@pytest.fixture(name="bench")
def gateway_bench(
    gateway: Callable[..., GatewayProcess], arbiter_daemon: ArbiterProcess, model: Path
) -> Callable[..., Bench]:
    """`bench(on_evict=…)` starts one."""

    def begin(**fields: Any) -> Bench:
        port = free_port()
        holder = [sys.executable, "-m", "tests.support.vllm_server", str(arbiter_daemon.gpu_folder)]
        serve = [str(PYTHON), "-m", "vllm.entrypoints.openai.api_server", "--model", str(model)]
        named = ["--served-model-name", "a", "--host", "127.0.0.1", "--port", str(port)]
        small = ["--max-model-len", str(CONTEXT), "--max-num-seqs", "2", "--enforce-eager"]
        server = {
            "command": [*holder, str(5 << 30), str(port), *serve, *named, *small],
            "port": port,
            "vram": "5GiB",
            "grace_s": LOAD_S,
            "env": ENVIRONMENT,
            **fields,
        }
        servers = {"a": server, "b": stand_in(arbiter_daemon, 5, wait_s=LOAD_S)}
        return Bench(gateway(servers), port)

    return begin


async def test_it_sleeps_after_its_requests_and_wakes_for_the_next(
    bench: Callable[..., Bench],
) -> None:
    one = bench(on_evict="vllm")
    async with one.client, httpx.AsyncClient(base_url=one.url, timeout=LOAD_S) as direct:

        async def sleeps() -> bool:
            return bool((await direct.get("/is_sleeping")).json()["is_sleeping"])

        # in the middle of a load
        first = asyncio.create_task(one.chat("a"))
        await eventually(lambda: one.gateway.running().get("a", {}).get("switches"))
        other = asyncio.create_task(one.chat("b"))
        await one.until_lease("b", "queued")
        assert one.gateway.running()["a"]["lease"] == "starting"
        assert await asyncio.gather(first, other) == ["length", "stop"]
        assert one.lease().state == "parked"
        assert await sleeps()
        pid = one.process

        # in the middle of a stream
        stream = await one.stream(WORDS)
        assert one.process == pid
        assert asked(FoundServer("", "pid", "", one.port)).on_evict == "vllm"
        with one.stopped():
            other = asyncio.create_task(one.chat("b"))
            await one.until_lease("a", "leaving")
            assert one.lease().uses == 1
            assert Vllm(one.url, LOAD_S).busy() == 1
        assert [chunk async for chunk in stream][-1].usage.completion_tokens == WORDS
        assert await other == "stop"
        assert await sleeps()

        # a request past the gateway waits until it is awake
        asleep = {"model": "a", "messages": HELLO, "max_tokens": 5}
        early = asyncio.create_task(direct.post("/v1/chat/completions", json=asleep))
        assert await one.chat("a") == "length"
        assert (await early).status_code == 200
        assert one.process == pid

        # without the arbiter `/sleep` ends what is in flight
        stream = await one.stream(WORDS)
        await asyncio.to_thread(Vllm(one.url, LOAD_S).free, [])
        ends = {one.finish_reason async for chunk in stream for one in chunk.choices}
        assert "abort" in ends


async def test_it_is_stopped_after_its_stream_and_started_by_the_next_request(
    bench: Callable[..., Bench],
) -> None:
    one = bench(on_evict="stop")
    async with one.client:
        stream = await one.stream(WORDS)
        pid = one.process
        with one.stopped():
            other = asyncio.create_task(one.chat("b"))
            await one.until_lease("a", "leaving")
        assert [chunk async for chunk in stream][-1].usage.completion_tokens == WORDS
        assert await other == "stop"
        assert not alive(pid)
        assert await one.chat("a") == "length"
        assert one.process != pid
