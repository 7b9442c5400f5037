"""Cycles a second of 16 clients that all want the same, and how evenly 128 of them are served. The
same load on a Redis lock."""

import json
from contextlib import ExitStack

from tests.bench import redis_locks
from tests.bench.harness import Suite, arbiter, end, pause, spawn

PROCESSES = 4
REFERENCE = "Redis: cycles a second, 16 clients on one lock"


def run(suite: Suite) -> None:
    seconds = suite.size(4, 1)
    with ExitStack() as stack:
        daemon = stack.enter_context(arbiter())
        path = "" if redis_locks.missing() else stack.enter_context(redis_locks.redis())
        per_s = sum(load("arbiter", daemon.endpoint, 16, seconds)) / seconds
        redis_per_s = sum(load("redis", path, 16, seconds)) / seconds if path else 0.0
        ours = load("arbiter", daemon.endpoint, 128, seconds)
        theirs = load("redis", path, 128, seconds) if path else []
    suite.figure("cycles a second, 16 clients on one loading slot", per_s, "1/s")
    if path:
        suite.figure(REFERENCE, redis_per_s, "1/s")
        suite.figure("throughput of 16 clients, of Redis's", per_s / redis_per_s, "x", at_least=0.5)
    else:
        suite.skipped("throughput of 16 clients, of Redis's", redis_locks.missing())
    suite.figure(
        "fairness, 128 clients: least / greatest share", fairness(ours), "x", at_least=0.95
    )
    if path:
        suite.figure("Redis: fairness, 128 clients", fairness(theirs), "x")


def fairness(counts: list[int]) -> float:
    return min(counts) / max(counts) if max(counts) else 0.0


def load(kind: str, address: str, clients: int, seconds: float) -> list[int]:
    """Cycles of every client within so many seconds: several processes with several connections
    each."""
    workers = [
        spawn("contender.py", kind, address, str(clients // PROCESSES)) for _ in range(PROCESSES)
    ]
    try:
        for word in ("go", "stop"):
            for worker in workers:
                assert worker.stdin is not None
                worker.stdin.write(f"{word}\n")
                worker.stdin.flush()
            if word == "go":
                pause(seconds)
        counts: list[int] = []
        for worker in workers:
            assert worker.stdout is not None
            counts += json.loads(worker.stdout.readline())
    finally:
        for worker in workers:
            end(worker)
    return counts
