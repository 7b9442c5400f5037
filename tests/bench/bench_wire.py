"""How long a grant and a handover take, beside the floor that ZeroMQ itself sets, all in one run on one machine.

`make bench`, or `python tests/bench/bench_wire.py --rounds 500 --json`. It starts a daemon of its own on a simulated card, with the
journal, identity checks and measurement switched on as in production. Only ratios within one run mean anything: core placement moves
every absolute figure two- to threefold.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import zmq

from schemas.wire import REQUEST

ANSWER_TIMEOUT_S = 15.0
START_TIMEOUT_S = 20.0
GIB = 1 << 30


class Peer:
    """One connection that speaks the wire by hand, so that no client library is measured along with the daemon."""

    def __init__(self, endpoint: str, name: str) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(endpoint)
        self._ids = 0
        self._pushes: list[dict[str, Any]] = []
        self.name = name

    def ask(self, op: str, **fields: Any) -> dict[str, Any]:
        """One request and its reply; raises RuntimeError with the daemon's words if it was refused."""
        self._ids += 1
        self._socket.send(msgpack.packb({"op": op, "id": self._ids, **fields}))
        reply = self._until(lambda message: message.get("re") == self._ids)
        if not reply["ok"]:
            raise RuntimeError(f"{op}: {reply['error']['message']}")
        return reply

    def push(self, kind: str) -> dict[str, Any]:
        """The next push of a kind; pushes that came while a reply was awaited count too."""
        for index, message in enumerate(self._pushes):
            if message["push"] == kind:
                return self._pushes.pop(index)
        return self._until(lambda message: message.get("push") == kind)

    def _until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        deadline = time.monotonic() + ANSWER_TIMEOUT_S
        while self._socket.poll(max(0, int((deadline - time.monotonic()) * 1000))):
            message: dict[str, Any] = msgpack.unpackb(self._socket.recv())
            if wanted(message):
                return message
            if "push" in message:
                self._pushes.append(message)
        raise TimeoutError(f"{self.name}: no answer within {ANSWER_TIMEOUT_S} s")

    def hello(self) -> None:
        self.ask("hello", name=self.name, instance=f"{self.name}-{os.getpid()}", version=1)

    def acquire(self, number: int, mode: str = "exclusive") -> dict[str, Any]:
        footprint = {"load_peak_bytes": GIB, "steady_bytes": GIB, "residue_bytes": 0}
        spec = {
            "consumer": self.name,
            "model_id": "bench",
            "footprint": footprint,
            "mode": mode,
            "min_residency_s": 0.0,
        }
        return self.ask("acquire", nonce=f"{self.name}-{number}", spec=spec)

    def release(self, lease: dict[str, Any]) -> None:
        self.ask("release", lease_id=lease["lease_id"], token=lease["token"])

    def close(self) -> None:
        self._socket.close()


@contextmanager
def daemon(folder: Path) -> Iterator[str]:
    """A daemon of our own on a simulated card that gives memory back at once; yields its endpoint."""
    endpoint = f"ipc://{folder}/arbiter.sock"
    environment = os.environ | {"VRAM_ARBITER_RUNTIME": str(folder)}
    command = [
        sys.executable,
        "-m",
        "arbiter",
        "--gpu",
        "fake:8GiB",
        "--state-dir",
        str(folder / "state"),
        "--log-level",
        "error",
    ]
    process = subprocess.Popen([*command, "--endpoint", endpoint], env=environment)
    try:
        peer = Peer(endpoint, "starter")
        deadline = time.monotonic() + START_TIMEOUT_S
        while not Path(f"{folder}/arbiter.sock").exists():
            if process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the daemon did not start (exit status {process.returncode})")
            threading.Event().wait(0.02)
        peer.hello()
        while peer.ask("status")["phase"] != "serving" and time.monotonic() < deadline:
            threading.Event().wait(0.02)
        peer.close()
        yield endpoint
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=10)


def echo(endpoint: str, stop: threading.Event) -> None:
    """The floor: a blocking ROUTER that validates and answers, and does nothing else."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
    socket.bind(endpoint)
    while not stop.is_set():
        if socket.poll(50):
            client, frame = socket.recv_multipart()
            request = REQUEST.validate_python(msgpack.unpackb(frame))
            socket.send_multipart(
                [client, msgpack.packb({"re": request.id, "epoch": 1, "ok": True, "pad": "x" * 160})]
            )
    socket.close(linger=0)


def timed(rounds: int, call: Callable[[int], float]) -> list[float]:
    """Microseconds of each round; `call` returns the seconds that count."""
    return [call(number) * 1e6 for number in range(rounds)]


def seconds(action: Callable[[], object]) -> float:
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def measure(folder: Path, rounds: int) -> dict[str, list[float]]:
    """Samples in microseconds by name."""
    samples: dict[str, list[float]] = {}
    floor = subprocess.Popen(
        [sys.executable, __file__, "--echo", f"ipc://{folder}/echo.sock"], stdin=subprocess.PIPE
    )
    try:
        peer = Peer(f"ipc://{folder}/echo.sock", "floor")
        peer.ask("ping")
        samples["floor: ZeroMQ round trip (F)"] = timed(rounds, lambda _: seconds(lambda: peer.ask("ping")))
        peer.close()
    finally:
        floor.communicate(b"", timeout=10)  # it ends when its standard input does
    with daemon(folder) as endpoint:
        one, two = Peer(endpoint, "one"), Peer(endpoint, "two")
        one.hello()
        two.hello()
        samples["ping"] = timed(rounds, lambda _: seconds(lambda: one.ask("ping")))

        def grant(number: int) -> float:
            deadline = time.monotonic() + ANSWER_TIMEOUT_S
            while one.ask("status")["leases"]:  # the last lease is still being verified
                if time.monotonic() > deadline:
                    raise TimeoutError("the last release was never verified")
                threading.Event().wait(0.002)
            start = time.perf_counter()
            reply = one.acquire(number)
            elapsed = time.perf_counter() - start
            one.release(reply["lease"] if reply["state"] == "loading" else one.push("granted")["lease"])
            return elapsed

        samples["grant: acquire on an empty card"] = timed(rounds, grant)

        held: list[dict[str, Any]] = []

        def handover(number: int) -> float:
            giver, taker = (one, two) if number % 2 == 0 else (two, one)
            if not held:
                reply = giver.acquire(rounds + number)
                held.append(reply["lease"] if reply["state"] == "loading" else giver.push("granted")["lease"])
            taker.acquire(2 * rounds + number)
            start = time.perf_counter()
            giver.release(held.pop())
            held.append(taker.push("granted")["lease"])
            return time.perf_counter() - start

        samples["handover: release to the waiter's grant, measured gone"] = timed(rounds, handover)
        one.close()
        two.close()
    return samples


def report(samples: dict[str, list[float]]) -> str:
    """A table of p50 and p99, and p50 as a multiple of the floor."""
    floor = statistics.median(next(iter(samples.values())))
    lines = [f"{'':56}{'p50 µs':>10}{'p99 µs':>10}{'p50 / F':>9}"]
    for name, values in samples.items():
        p50, p99 = statistics.median(values), sorted(values)[int(len(values) * 0.99)]
        lines.append(f"{name:56}{p50:10.0f}{p99:10.0f}{p50 / floor:9.2f}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=300, help="rounds of each measurement (default 300)")
    parser.add_argument(
        "--json", action="store_true", help="print all samples in microseconds instead of the table"
    )
    parser.add_argument("--echo", metavar="ENDPOINT", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.echo:
        stop = threading.Event()
        server = threading.Thread(target=echo, args=(options.echo, stop))
        server.start()
        sys.stdin.read()
        stop.set()
        server.join()
        return 0
    with tempfile.TemporaryDirectory(prefix="vram-bench-") as folder:
        samples = measure(Path(folder), options.rounds)
    print(json.dumps(samples) if options.json else report(samples))
    return 0


if __name__ == "__main__":
    sys.exit(main())
