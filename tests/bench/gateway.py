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
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

import yaml

from tests.bench import gpu_broker
from tests.bench.chats import Answer, Load, drive, turns
from tests.bench.harness import SHIPPED, Suite, arbiter, p50, p99, summed
from tests.bench.paced import at_rate, chat, read_all, request
from tests.support.waiting import until
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.runtime.ports import free_port

PYTHON = (sys.executable, "-m")
TOKENS = 16
ROUNDS = 3
"""Of each figure, in turns."""
ROUND_S = 5.0
RATES_PER_S = {1: 20.0, 32: 160.0}
"""Requests by clients, at random times: without a rate 32 clients measure a queue alone."""
DOWNLOAD_BYTES = 256 << 20
STREAMS = (
    ("32 chats at 50 words/s", [chat(150, 0.02)] * 32, None),
    ("chat of 20,000 words at once", [chat(20_000)], None),
    ("download of 256 MiB", [request(f"/bytes/{DOWNLOAD_BYTES}")], DOWNLOAD_BYTES),
)
"""What is asked at once, and the size of its answers; None: in chunks. Only the first has a rate of
its own, as models have; the others want all of the cores."""
ADDED_P50_US, ADDED_P99_US, STREAMS_MIN = 1500.0, 5000.0, 0.97
"""Targets: µs added to the first byte at 32 clients, and the least ratio of rates."""
TURNING = {"chat": "5GiB", "code": "4GiB"}
"""On 8 GiB there is room for one."""
CLIENTS = 16
"""Of each of them."""
PAUSE_S = 0.5
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


@dataclass(frozen=True, slots=True)
class Running:
    url: str
    pid: int


@contextmanager
def gateway(
    models: Models, sizes: Mapping[str, str], environ: Mapping[str, str]
) -> Iterator[Running]:
    """Run `vram-gateway serve`."""
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
            yield Running(url, process.pid)


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
    """First bytes of 1 and 32 clients, and streams: direct, over a relay of TCP, which is what any
    process in between costs on this machine, and through the gateway."""
    port, between = str(free_port()), str(free_port())
    bare = "tests.bench.chat_server"
    models = {"chat": [port, *PYTHON, bare, port]}
    with (
        arbiter(SHIPPED) as daemon,
        gateway(models, {"chat": "1GiB"}, daemon.environ) as through,
        program(daemon.environ, bare, between, port),
    ):
        url = f"{through.url}/upstream/chat"
        read_all(url, [chat(1)], None)  # it starts
        direct, relay = (f"http://127.0.0.1:{one}" for one in (port, between))
        until(lambda: _answers(relay))
        urls = {"direct": direct, "relay": relay, "gateway": through.url}
        for clients, per_s in RATES_PER_S.items():
            first_bytes(suite, clients, per_s, urls, through.pid)
        paths = urls | {"gateway": url}
        for name, asked, size in STREAMS:
            rates = _each(paths, lambda url: [read_all(url, asked, size)])  # noqa: B023
            streaming(suite, name, rates)


def _each[T](urls: Mapping[str, str], take: Callable[[str], list[T]]) -> dict[str, list[T]]:
    """Return what each of them gives, in turns."""
    samples: dict[str, list[T]] = {name: [] for name in urls}
    for _ in range(ROUNDS):
        for name, url in urls.items():
            samples[name] += take(url)
    return samples


def first_bytes(
    suite: Suite, clients: int, per_s: float, urls: Mapping[str, str], pid: int
) -> None:
    """`pid`: the gateway's."""
    before, mine = cpu_s(pid), time.process_time()
    asked = _each(urls, lambda url: at_rate(url, clients, per_s, ROUND_S, TOKENS))
    count = sum(map(len, asked.values()))
    through = len(asked["gateway"])
    computed, waited = (
        (now - then) / through * 1e3 for now, then in zip(cpu_s(pid), before, strict=True)
    )
    own = (time.process_time() - mine) / count * 1e3
    costs = f"gateway {computed:.2f} ms and {waited:.2f} ms of wait for a core, client {own:.2f} ms"
    first_us = {name: [one.first_s * 1e6 for one in found] for name, found in asked.items()}
    for name, found in asked.items():
        late = p99([one.late_s for one in found]) * 1e3
        note = f"{per_s:g} requests/s, sent {late:.1f} ms late at p99"
        note += f"; CPU of one: {costs}" if name == "gateway" else ""
        suite.time(f"first byte, {clients} clients, {name}", first_us[name], note)
    for what, of, most in (("p50", p50, ADDED_P50_US), ("p99", p99, ADDED_P99_US)):
        floor = of(first_us["direct"])
        suite.figure(
            f"first byte, {clients} clients: added {what}",
            of(first_us["gateway"]) - floor,
            "µs",
            at_most=most if clients > 1 else None,
            note=f"the relay adds {of(first_us['relay']) - floor:.0f} µs",
        )


def cpu_s(pid: int) -> tuple[float, float]:
    """Return how long a process has computed, and waited for a core."""
    tasks = [(one / "schedstat").read_text().split() for one in Path(f"/proc/{pid}/task").iterdir()]
    computed, waited = (sum(int(task[field]) for task in tasks) / 1e9 for field in (0, 1))
    return computed, waited


def streaming(suite: Suite, name: str, rates: Samples) -> None:
    direct, relay, through = (p50(rates[key]) for key in ("direct", "relay", "gateway"))
    suite.figure(f"{name}, direct", direct / 1e6, "MB/s")
    note = f"over the relay {relay / direct:.2f}"
    suite.figure(
        f"{name}: rate through the gateway", through / direct, "x", at_least=STREAMS_MIN, note=note
    )


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
                    url = stack.enter_context(gateway(models, TURNING, environ)).url
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
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="of turns, on each program; 0: none"
    )
    parser.add_argument("--gpu-broker", action="store_true", help="install it and compare")
    parser.add_argument("--out", type=Path, default=Path("out/bench/gateway.json"))
    options = parser.parse_args()
    suite = Suite()
    passing(suite)
    if options.minutes:
        turning(suite, options.minutes, with_broker=options.gpu_broker)
    suite.write(options.out)
    print(f"{suite.table()}\n{summed(row.ok for row in suite.rows)}; rows are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
