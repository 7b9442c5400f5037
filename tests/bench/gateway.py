"""`make bench-gateway`: what the gateway adds to a request, how fast answers stream through it, and
how two servers take turns in room for one, beside a plain proxy that ends one to start the other
(`plain_proxy`), and with `--gpu-broker` beside that program of the registry.

Stand-in servers and a simulated GPU. Prints a table and writes `out/bench/gateway.json`
(`harness.Row` says what the fields mean).
"""

import argparse
import asyncio
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from urllib.request import urlopen

import aiohttp
import yaml

from tests.bench import gpu_broker
from tests.bench.chats import PATIENCE_S, Answer, Load, ask, drive, turns
from tests.bench.harness import SHIPPED, Suite, arbiter, free_port, p50, p99
from tests.support.waiting import until
from vram_arbiter.schemas import fakegpu

PYTHON = (sys.executable, "-m")
DOWNLOAD_BYTES = 256 << 20
CHAT_TOKENS = 20_000
ROUNDS = 3
"""Of each figure, in turns: direct, through the gateway."""
ROUND_S = 2.0
PAUSES_S = {1: 0.0, 32: 0.2}
"""By clients, the mean pause of each between requests: 32 without one measure a queue alone."""
ADDED_P50_US, ADDED_P99_US, STREAMS_MIN = 1500.0, 5000.0, 0.97
"""Targets: µs added to the first byte at 32 clients, and the least ratio of rates."""
TURNING = {"chat": "5GiB", "code": "4GiB"}
"""On 8 GiB there is room for one."""
CLIENTS = 16
"""Of each of them."""
PAUSE_S = 0.5
TOKENS = 16
MIN_RESIDENCY_S = 2.0
"""As shipped."""

Samples = Mapping[str, list[float]]
Models = Mapping[str, Sequence[str]]
"""Name → [port, command…], as of `plain_proxy`."""


def environ_of(folder: Path, environ: Mapping[str, str]) -> dict[str, str]:
    return {**environ, fakegpu.FOLDER_VARIABLE: str(folder)}


@contextmanager
def program(environ: Mapping[str, str], *words: str) -> Iterator["subprocess.Popen[str]"]:
    process = subprocess.Popen([*PYTHON, *words], env=environ, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()


@contextmanager
def gateway(models: Models, sizes: Mapping[str, str], environ: Mapping[str, str]) -> Iterator[str]:
    """Run `vram-gateway serve`; yields its URL."""
    servers = {
        name: {
            "command": list(words[1:]),
            "port": int(words[0]),
            "vram": sizes[name],
            "min_residency_s": MIN_RESIDENCY_S,
        }
        for name, words in models.items()
    }
    with tempfile.TemporaryDirectory(prefix="vg") as folder:
        path = Path(folder) / "gateway.yaml"
        path.write_text(yaml.safe_dump({"listen": "127.0.0.1:0", "servers": servers}))
        serve = ("vram_arbiter.sidecars.gateway", "serve", "--config", str(path))
        with program(environ, *serve) as process:
            assert process.stdout is not None
            url = process.stdout.readline().strip()
            assert url, "the gateway ended"
            yield url


@contextmanager
def plain(models: Models, environ: Mapping[str, str]) -> Iterator[str]:
    port = free_port()
    with program(environ, "tests.bench.plain_proxy", str(port), json.dumps(models)):
        url = f"http://127.0.0.1:{port}"
        until(lambda: _answers(url))
        yield url


def _answers(url: str) -> bool:
    try:
        with urlopen(url, timeout=1.0):
            return True
    except OSError as error:
        return hasattr(error, "code")  # 404: it serves


# -- one server that is awake
def passing(suite: Suite) -> None:
    """First bytes of 1 and 32 clients, and long streams, direct and through the gateway."""
    port = str(free_port())
    models = {"chat": [port, *PYTHON, "tests.bench.chat_server", port]}
    with arbiter(SHIPPED) as daemon, gateway(models, {"chat": "1GiB"}, daemon.environ) as through:
        direct = f"http://127.0.0.1:{port}"
        urls = {"direct": direct, "gateway": through}
        folders = {"direct": direct, "gateway": f"{through}/upstream/chat"}
        asyncio.run(drive(through, ["chat"], Load(1, 0.1, 0.0, 1)))  # it starts
        for clients, pause_s in PAUSES_S.items():
            load = Load(clients, ROUND_S, pause_s, TOKENS)
            first_bytes(suite, clients, _each(urls, partial(_firsts_us, load)))
        streaming(suite, "download of 256 MiB", _each(folders, lambda url: [_download(url)]))
        streaming(suite, f"chat of {CHAT_TOKENS} words", _each(urls, lambda url: [_chat(url)]))


def _each(urls: Mapping[str, str], take: Callable[[str], list[float]]) -> Samples:
    samples: dict[str, list[float]] = {name: [] for name in urls}
    for _ in range(ROUNDS):
        for name, url in urls.items():
            samples[name] += take(url)
    return samples


def _firsts_us(load: Load, url: str) -> list[float]:
    return [one.first_s * 1e6 for one in _whole(asyncio.run(drive(url, ["chat"], load)))]


def _whole(answers: list[Answer]) -> list[Answer]:
    """Raises AssertionError unless all came whole."""
    assert not [one.problem for one in answers if one.problem]
    return answers


def _download(url: str) -> float:
    """Return bytes per second."""

    async def read() -> float:
        timeout = aiohttp.ClientTimeout(PATIENCE_S)
        async with aiohttp.ClientSession(timeout=timeout) as session:
            began = time.perf_counter()
            async with session.get(f"{url}/bytes/{DOWNLOAD_BYTES}") as reply:
                size = 0
                async for chunk in reply.content.iter_any():
                    size += len(chunk)
            assert size == DOWNLOAD_BYTES
            return size / (time.perf_counter() - began)

    return asyncio.run(read())


def _chat(url: str) -> float:
    """Return bytes per second, from asking to the last."""

    async def read() -> Answer:
        async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(PATIENCE_S)) as session:
            return await ask(session, url, "chat", CHAT_TOKENS)

    (one,) = _whole([asyncio.run(read())])
    return one.size_bytes / (one.ended_at - one.asked_at)


def first_bytes(suite: Suite, clients: int, took_us: Samples) -> None:
    pause = f"pause {PAUSES_S[clients]:g} s"
    for name, samples in took_us.items():
        suite.time(f"first byte, {clients} clients, {name}", samples, pause)
    for what, of, most in (("p50", p50, ADDED_P50_US), ("p99", p99, ADDED_P99_US)):
        added_us = of(took_us["gateway"]) - of(took_us["direct"])
        at_most = most if clients > 1 else None
        suite.figure(
            f"first byte, {clients} clients: added {what}", added_us, "µs", at_most=at_most
        )


def streaming(suite: Suite, name: str, rates: Samples) -> None:
    direct, through = (p50(rates[key]) for key in ("direct", "gateway"))
    suite.figure(f"{name}, direct", direct / 1e6, "MB/s")
    suite.figure(f"{name}: rate through the gateway", through / direct, "x", at_least=STREAMS_MIN)


# -- two servers in room for one
def turning(suite: Suite, minutes: float, *, with_broker: bool) -> None:
    """The same clients on each program, each with a GPU of its own."""
    for name in ("gateway", "plain proxy", *(["gpu-broker"] if with_broker else [])):
        stand_in = (*PYTHON, "vram_arbiter.sidecars.gateway.stand_in")
        ports = {model: str(free_port()) for model in TURNING}
        models = {
            model: [ports[model], *stand_in, model, size, ports[model]]
            for model, size in TURNING.items()
        }
        with ExitStack() as stack:
            daemon = stack.enter_context(arbiter(SHIPPED))
            environ = environ_of(daemon.gpu_folder, daemon.environ)
            headers: Mapping[str, str] = {}
            match name:
                case "gateway":
                    url = stack.enter_context(gateway(models, TURNING, environ))
                case "plain proxy":
                    url = stack.enter_context(plain(models, environ))
                case _:
                    venv = stack.enter_context(tempfile.TemporaryDirectory(prefix="gbv"))
                    binary = gpu_broker.install(Path(venv) / "venv")
                    serving = gpu_broker.broker(binary, models, environ, daemon.gpu_folder)
                    found = stack.enter_context(serving)
                    url, headers = found.url, found.headers
            load = Load(CLIENTS, minutes * 60, PAUSE_S, TOKENS, headers)
            took_turns(suite, name, asyncio.run(drive(url, list(TURNING), load)))


def took_turns(suite: Suite, name: str, answers: list[Answer]) -> None:
    seen = turns(answers, list(TURNING))
    problems = "; ".join(f"{count} x {problem}" for problem, count in seen.problems.items())
    answered = ", ".join(f"{model} {count}" for model, count in seen.answered.items())
    suite.figure(f"turns, {name}: requests", seen.requests, "requests", note=answered)
    suite.figure(f"turns, {name}: failed", seen.failed, "requests", note=problems or None)
    if name == "gateway":
        suite.rows[-1].target, suite.rows[-1].ok = "0", not seen.failed
    span_s = max(one.ended_at for one in answers) - min(one.asked_at for one in answers)
    at_most = span_s / MIN_RESIDENCY_S if name == "gateway" else None
    suite.figure(f"turns, {name}: switches", seen.switches, "switches", at_most=at_most)
    if seen.gaps_s:
        suite.time(f"turns, {name}: gap at a switch", [gap * 1e6 for gap in seen.gaps_s])
    if seen.first_s:
        suite.time(f"turns, {name}: first byte", [first * 1e6 for first in seen.first_s])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="of turns, on each program")
    parser.add_argument("--gpu-broker", action="store_true", help="install it and compare")
    parser.add_argument("--out", type=Path, default=Path("out/bench/gateway.json"))
    options = parser.parse_args()
    suite = Suite()
    passing(suite)
    turning(suite, options.minutes, with_broker=options.gpu_broker)
    suite.write(options.out)
    print(f"{suite.table()}\nrows are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
