"""What the arbiter costs while nothing happens, and how fast it and `vramctl status` start."""

import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

from tests.bench.harness import SHIPPED, Peer, Suite, arbiter, elapsed_us, environ, in_turns, pause
from tests.support.processes import rss_bytes
from vram_arbiter.testing.daemon import ArbiterProcess

QUIET_AFTER_S = 11.0
"""The GPU is read in the background until 10 s after the last client."""
STATUS = (
    "import sys; sys.argv[1:] = ['status']; from vram_arbiter.clients.cli.main import main; main()"
)

LIBRARIES = "import asyncio, ctypes, msgpack, pydantic, sqlite3; pydantic.BaseModel"
"""What each daemon imports that is not ours."""


def run(suite: Suite) -> None:
    with arbiter(SHIPPED) as daemon:
        if not suite.quick:
            pause(QUIET_AFTER_S)
        share = busy_percent(daemon.pid, suite.size(10, 2))
        suite.figure(
            "memory of the daemon at rest", rss_bytes(daemon.pid) / 2**20, "MB", at_most=55.0
        )
        suite.figure("CPU of the daemon at rest", share, "% of a core", at_most=0.3)
        peer = Peer(daemon.endpoint, "resident").greeted()
        peer.ready(peer.lease())
        share = busy_percent(daemon.pid, suite.size(10, 2))
        suite.figure("CPU with a resident model, read once a second", share, "% of a core")
        environment = environ() | {"VRAM_ARBITER_ENDPOINT": daemon.endpoint}

        def start(code: str) -> float:
            command = [sys.executable, "-c", code]
            return elapsed_us(
                lambda: subprocess.run(
                    command, env=environment, check=True, stdout=subprocess.DEVNULL
                )
            )

        calls = {"bare": lambda: start("pass"), "status": lambda: start(STATUS)}
        found = in_turns(suite.size(60, 5), calls, chunk=5)
        peer.close()
        calls = {"libraries": lambda: start(LIBRARIES), "daemon": until_ready}
        found |= in_turns(suite.size(20, 5), calls, chunk=5)
    suite.time("bare Python's start", found["bare"])
    suite.compare(
        "start of vramctl status, answered", found["status"], found["bare"], "bare Python", 8.0
    )
    suite.compare(
        "start of a daemon, ready", found["daemon"], found["libraries"], "its libraries", 3.0
    )
    suite.limit(
        "fixture arbiter of a test", found["daemon"], p50_max_us=500_000.0, p99_max_us=1_000_000.0
    )


def until_ready() -> float:
    """Start a daemon as `vram_arbiter.testing` does; return the microseconds until READY."""
    with closing(ArbiterProcess(config=SHIPPED)) as daemon:
        return elapsed_us(daemon.start)


def busy_percent(pid: int, seconds: float) -> float:
    before, began = cpu_s(pid), time.monotonic()
    pause(seconds)
    return (cpu_s(pid) - before) / (time.monotonic() - began) * 100


def cpu_s(pid: int) -> float:
    """Time on a core of all threads, by the scheduler's own count (nanoseconds)."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9
