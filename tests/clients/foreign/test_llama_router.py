"""`vramctl run --on-evict llama.cpp` over upstream's router, on a CPU with a simulated GPU."""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support import llama_release
from tests.support.leases import view_of
from tests.support.process import ArbiterProcess
from tests.support.processes import children
from tests.support.tiny_gguf import write_gguf
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.foreign.servers import LlamaCpp
from vram_arbiter.clients.sync import Client
from vram_arbiter.sidecars.gateway.program import free_port

pytestmark = [pytest.mark.nightly, pytest.mark.e2e, pytest.mark.anyio]
MODELS = ("one", "two")
WORDS = 3000
"""Of a completion that takes a second of a core."""
COMPLETION = {
    "prompt": "hello",
    "ignore_eos": True,
    "logit_bias": [[token, False] for token in range(131, 259)],  # bytes that are no ASCII
}
"""It ends a stream whose bytes are no text."""


@pytest.fixture(scope="module")
def llama_server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not shutil.which("npm"):
        pytest.skip("npm is not installed")
    return llama_release.install(tmp_path_factory.mktemp("llama"))


class Router:
    """A router under a lease named `router`."""

    def __init__(self, url: str, pid: int) -> None:
        self.client = httpx.Client(base_url=url, timeout=PATIENCE_S)
        self.preset = LlamaCpp(url, PATIENCE_S)
        self._pid = pid

    def states(self) -> dict[str, str]:
        models = self.client.get("/models").json()["data"]
        return {model["id"]: model["status"]["value"] for model in models}

    @property
    def loaders(self) -> list[int]:
        """Processes of models, which threads of the router started."""
        tasks = [
            task for pid in children(self._pid) for task in Path(f"/proc/{pid}/task").iterdir()
        ]
        return [int(pid) for task in tasks for pid in (task / "children").read_text().split()]


@pytest.fixture
def router(llama_server: Path, arbiter_daemon: ArbiterProcess, tmp_path: Path) -> Iterator[Router]:
    for name in MODELS:
        write_gguf(tmp_path / f"{name}.gguf")
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    lease = ["--vram", "5GiB", "--name", "router", "--on-evict", "llama.cpp", "--url", url]
    serve = [str(llama_server), "--models-dir", str(tmp_path), "--port", str(port)]
    small = ["--ctx-size", "4096", "--parallel", "1", "--threads", "1", "--no-warmup"]
    lease += ["--health", f"{url}/health", "--min-residency", "0"]
    running = subprocess.Popen(
        [sys.executable, "-m", "vram_arbiter.clients", "run", *lease, "--", *serve, *small],
        env={**os.environ, **arbiter_daemon.environ},
        stderr=subprocess.DEVNULL,
    )
    started = Router(url, running.pid)
    try:
        yield started
    finally:
        started.client.close()
        for pid in started.loaders:  # one may be stopped
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        running.terminate()
        running.wait(PATIENCE_S)


async def test_a_stream_and_a_load_of_a_real_router_end_before_it_unloads(
    router: Router, arbiter_daemon: ArbiterProcess
) -> None:
    with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:

        def state() -> str:
            return view_of(arbiter, "router").state

        def take_the_room() -> None:
            lease = arbiter.acquire(vram="5GiB", consumer="other", wait_timeout_s=PATIENCE_S)
            try:
                assert set(router.states().values()) == {"unloaded"}
            finally:
                lease.release()

        await eventually(lambda: arbiter.status().leases and state() == "held")

        # in the middle of a stream
        asked = {**COMPLETION, "model": "one", "n_predict": WORDS, "stream": True}
        with router.client.stream("POST", "/completion", json=asked) as answer:
            lines = answer.iter_lines()
            next(lines)
            other = asyncio.create_task(asyncio.to_thread(take_the_room))
            await eventually(lambda: state() == "unloading")
            assert router.preset.busy() == 1
            assert router.states()["one"] == "loaded"
            last: dict[str, Any] = json.loads([line for line in lines if line][-1][6:])
        assert last["tokens_predicted"] == WORDS
        await other
        await eventually(lambda: state() == "held")  # it is back

        # in the middle of a load
        asked = {**COMPLETION, "model": "two", "n_predict": 5}
        whole = asyncio.create_task(
            asyncio.to_thread(router.client.post, "/completion", json=asked)
        )
        await eventually(lambda: router.loaders)
        (loader,) = router.loaders
        os.kill(loader, signal.SIGSTOP)
        assert router.states()["two"] == "loading"
        other = asyncio.create_task(asyncio.to_thread(take_the_room))
        await eventually(lambda: state() == "unloading")
        assert router.preset.busy() == 1
        os.kill(loader, signal.SIGCONT)
        assert (await whole).json()["tokens_predicted"] == 5
        await other
