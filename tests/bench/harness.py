"""What every benchmark shares: rows and their table, samples, a connection that speaks the wire by
hand, servers of the run's own.

All clients here are blocking and bare: what is measured is the server, not a client library.
Everything of one row, its floor too, is measured in turns within one run, because core placement
and neighbours move every absolute figure two- to threefold.
"""

import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import zmq

from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import KIB

HERE = Path(__file__).parent
ANSWER_TIMEOUT_S = 30.0
SLIVER = 4 * KIB
"""The footprint of a lease where bytes are not the subject: many fit, none has to be measured gone
before the next."""
FLOOR = "floor: ZeroMQ round trip (F)"

WIDE = """
limits:
  connections_max: 65536
  sessions_max: 65536
  user_share: 1
  process_share: 1
  leases_per_client_max: 4096
  rate_per_client_per_s: 1000000
  rate_per_process_per_s: 1000000
log:
  level: error
"""
"""Limits out of the way of the load generators; everything else as shipped."""
SHIPPED = "log:\n  level: error\n"


@dataclass(slots=True)
class Row:
    """One line of the table and of the file.

    Times: `p50_us` and `p99_us` of the row, `floor_us` of what it is compared with (named in
    `against`), `ratio` the row's over the floor's. Other figures: `value` with `unit`; `ratio` is
    then the value over its target, where that means anything. `target` is in words, `ok` None where
    the row is there to be read and has none.
    """

    name: str
    p50_us: float | None = None
    p99_us: float | None = None
    floor_us: float | None = None
    ratio: float | None = None
    target: str | None = None
    ok: bool | None = None
    value: float | None = None
    unit: str | None = None
    against: str | None = None
    note: str | None = None


@dataclass(slots=True)
class Suite:
    """The rows of a run, and how long it may take."""

    quick: bool = False
    rows: list[Row] = field(default_factory=list)

    def size(self, full: int, quick: int) -> int:
        return quick if self.quick else full

    def time(self, name: str, samples: Sequence[float], note: str | None = None) -> None:
        """A row that is there to be read."""
        self.rows.append(Row(name, p50(samples), p99(samples), note=note))

    def compare(
        self,
        name: str,
        samples: Sequence[float],
        floor: Sequence[float],
        against: str,
        at_most: float | None,
        *,
        of: Callable[[Sequence[float]], float] | None = None,
    ) -> None:
        """A row that may be so many times its floor: by the median, or by what `of` takes
        of both."""
        of = of or p50
        ratio = of(samples) / of(floor)
        target = None if at_most is None else f"<= {at_most:g} x {against}"
        ok = None if at_most is None else ratio <= at_most
        row = Row(
            name,
            p50(samples),
            p99(samples),
            of(floor),
            ratio,
            target,
            ok,
            against=against,
        )
        self.rows.append(row)

    def limit(
        self,
        name: str,
        samples: Sequence[float],
        *,
        p99_max_us: float,
        p50_max_us: float | None = None,
        note: str | None = None,
    ) -> None:
        """A row with absolute bounds. `ratio` is p99 over its bound."""
        worst, target = p99(samples), f"p99 <= {p99_max_us / 1000:g} ms"
        ok = worst <= p99_max_us
        if p50_max_us is not None:
            target = f"p50 <= {p50_max_us / 1000:g} ms, {target}"
            ok = ok and p50(samples) <= p50_max_us
        row = Row(
            name, p50(samples), worst, ratio=worst / p99_max_us, target=target, ok=ok, note=note
        )
        self.rows.append(row)

    def figure(
        self,
        name: str,
        value: float,
        unit: str,
        *,
        at_most: float | None = None,
        at_least: float | None = None,
        note: str | None = None,
    ) -> None:
        """A figure that is no time."""
        row = Row(name, value=value, unit=unit, note=note)
        if at_most is not None:
            row.target, row.ok, row.ratio = (
                f"<= {at_most:g} {unit}",
                value <= at_most,
                value / at_most,
            )
        elif at_least is not None:
            row.target, row.ok, row.ratio = (
                f">= {at_least:g} {unit}",
                value >= at_least,
                value / at_least,
            )
        self.rows.append(row)

    def skipped(self, name: str, why: str) -> None:
        self.rows.append(Row(name, note=f"left out: {why}"))

    def table(self) -> str:
        lines = [f"{'':58}{'p50 µs':>10}{'p99 µs':>10}{'floor µs':>10}{'ratio':>8}  {'':5}target"]
        for row in self.rows:
            if row.value is not None:
                cells = f"{_number(row.value)} {row.unit}"
            elif row.p50_us is None:
                cells = row.note or ""
            else:
                cells = (
                    f"{_number(row.p50_us):>10}{_number(row.p99_us):>10}{_number(row.floor_us):>10}"
                )
            ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
            ok = {True: "ok", False: "MISS", None: ""}[row.ok]
            target = (
                f"{row.target or '':28}{row.note or ''}" if row.value is not None else row.target
            )
            lines.append(f"{row.name:58}{cells:>30}{ratio:>8}  {ok:5}{target or ''}".rstrip())
        return "\n".join(lines)

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps([asdict(row) for row in self.rows], indent=1, ensure_ascii=False) + "\n"
        )


def summed(found: Iterable[bool | None]) -> str:
    """Say how many targets were met and missed. `found`: `ok` of each row."""
    counts = Counter(found)
    return f"{counts[True]} targets met, {counts[False]} missed"


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.3f}"


def p50(samples: Sequence[float]) -> float:
    return statistics.median(samples)


def p99(samples: Sequence[float]) -> float:
    """Of fewer than a hundred samples the greatest."""
    return sorted(samples)[min(len(samples) - 1, math.floor(len(samples) * 0.99))]


def elapsed_us(action: Callable[[], object]) -> float:
    start = time.perf_counter()
    action()
    return (time.perf_counter() - start) * 1e6


def in_turns(
    rounds: int, calls: Mapping[str, Callable[[], float]], chunk: int = 25
) -> dict[str, list[float]]:
    """Samples of several calls, taken in turns of a few, so that what the machine does to one it
    does to all."""
    samples: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():  # warm
        for _ in range(10):
            call()
    while any(len(found) < rounds for found in samples.values()):
        for name, call in calls.items():
            samples[name] += [call() for _ in range(chunk)]
    return samples


def pause(seconds: float) -> None:
    threading.Event().wait(seconds)


# -- clients
class Peer(WireClient):
    """One connection that speaks the wire by hand. Raises RuntimeError with the daemon's words for
    a refusal."""

    def __init__(
        self, endpoint: str, name: str = "peer", context: "zmq.Context[Any] | None" = None
    ) -> None:
        super().__init__(endpoint, context=context or zmq.Context.instance())
        self.name = name

    def reply(self, request_id: int | None, timeout_s: float = ANSWER_TIMEOUT_S) -> dict[str, Any]:
        reply = super().reply(request_id, timeout_s)
        if not reply["ok"]:
            raise RuntimeError(f"{self.name}: {reply['error']['message']}")
        return reply

    def greet(self) -> int:
        """Say hello without waiting for the welcome; the request's id."""
        instance = f"{self.name}-{os.getpid()}-{id(self)}"
        return self.send("hello", name=self.name, instance=instance)

    def greeted(self) -> Self:
        """Say hello, and wait for the welcome."""
        self.reply(self.greet())
        return self

    def want(self, size: int = SLIVER, **spec: Any) -> int:
        """Send an acquire of `size` bytes without waiting for its answer; the request's id."""
        wanted = {
            "consumer": self.name,
            "model_id": "bench",
            "footprint": {"load_peak_bytes": size, "steady_bytes": size, "residue_bytes": 0},
            "mode": "shared",
            "min_residency_s": 0.0,
            "ttl_s": 600.0,
            **spec,
        }
        return self.send("acquire", nonce=f"{self.name}-{id(self)}-{self._id}", spec=wanted)

    def lease(self, size: int = SLIVER, **spec: Any) -> dict[str, Any]:
        """A lease that has been granted."""
        reply = self.reply(self.want(size, **spec))
        lease: dict[str, Any] = (
            reply["lease"] if reply["state"] == "loading" else self.push("granted")["lease"]
        )
        return lease

    def ready(self, lease: Mapping[str, Any]) -> None:
        self.ask("ready", lease_id=lease["lease_id"], token=lease["token"])

    def letting_go(self, lease: Mapping[str, Any]) -> int:
        return self.send("release", lease_id=lease["lease_id"], token=lease["token"])

    def release(self, lease: Mapping[str, Any]) -> None:
        self.reply(self.letting_go(lease))

    def settle(self) -> None:
        """Until nobody has a lease and nothing is measured any more: the next acquire finds a quiet
        GPU, and cores awake."""
        while self.ask("status")["leases"]:
            pass


# -- servers
@contextmanager
def arbiter(config: str = WIDE, gpu: str = "fake:8GiB") -> Iterator[ArbiterProcess]:
    """A daemon of the run's own with journal, identity checks and measurement as in production. It
    must outlive its use."""
    daemon = ArbiterProcess(gpu, config=config)
    try:
        daemon.start()
        yield daemon
        if daemon.process is not None and daemon.process.poll() is not None:
            raise RuntimeError(f"the daemon ended with {daemon.process.wait()}:\n{daemon.log}")
    finally:
        daemon.close()


def environ() -> dict[str, str]:
    """For processes of ours: they import what this one imports."""
    return os.environ | {"PYTHONPATH": f"{HERE.parents[1]}/src:{HERE.parents[1]}"}


def spawn(script: str, *arguments: str) -> "subprocess.Popen[str]":
    """A script of this folder, once it has said its first line (that it is up)."""
    command = [sys.executable, str(HERE / script), *arguments]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environ()
    )
    assert process.stdout is not None
    if not process.stdout.readline():
        raise RuntimeError(f"{script} ended with {process.wait()}")
    return process


def end(process: "subprocess.Popen[str]") -> None:
    """Close its standard input, which ends our scripts, and insist after a while."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()


@contextmanager
def helper(script: str, *arguments: str) -> Iterator[None]:
    process = spawn(script, *arguments)
    try:
        yield
    finally:
        end(process)


@contextmanager
def floor() -> Iterator[Callable[[], float]]:
    """A blocking ROUTER that validates and answers, and nothing else; yields a call that takes one
    round trip's microseconds."""
    with (
        tempfile.TemporaryDirectory(prefix="vb") as folder,
        helper("echo_server.py", f"ipc://{folder}/e"),
    ):
        peer = Peer(f"ipc://{folder}/e", "floor")
        pad = "x" * 160
        try:
            yield lambda: elapsed_us(lambda: peer.ask("why", consumer=pad[:128]))
        finally:
            peer.close()
