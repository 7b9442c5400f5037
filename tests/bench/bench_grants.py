"""A grant, and acquire + release, of a client that is alone: against a bare round trip and against
Redis.

Before each one the GPU is quiet: what the release before has left to be measured is no part of the
next grant. `bench_throughput` has what that costs when there is no pause.
"""

from contextlib import ExitStack

from tests.bench import redis_locks
from tests.bench.harness import FLOOR, Peer, Suite, arbiter, elapsed_us, floor, in_turns, p99


def run(suite: Suite) -> None:
    rounds = suite.size(1000, 100)
    with ExitStack() as stack:
        daemon = stack.enter_context(arbiter())
        bare = stack.enter_context(floor())
        peer = Peer(daemon.endpoint, "grants").greeted()
        stack.callback(peer.close)

        def grant() -> float:
            peer.settle()
            lease: list[dict[str, object]] = []
            took = elapsed_us(lambda: lease.append(peer.lease()))
            peer.release(lease[0])
            return took

        def cycle() -> float:
            peer.settle()
            return elapsed_us(lambda: peer.release(peer.lease()))

        calls = {
            FLOOR: bare,
            "ping": lambda: elapsed_us(lambda: peer.ask("ping")),
            "grant": grant,
            "cycle": cycle,
        }
        if not redis_locks.missing():
            path = stack.enter_context(redis_locks.redis())
            usual = redis_locks.usual_cycle(path)
            locks = redis_locks.RedisLocks(path, "one")
            stack.callback(locks.close)
            calls["usual"] = lambda: elapsed_us(usual)
            calls["redis"] = lambda: elapsed_us(lambda: locks.cycle(b"alone"))
        found = in_turns(rounds, calls)
    suite.time(FLOOR, found[FLOOR], "200 bytes each way, validated")
    suite.compare("ping", found["ping"], found[FLOOR], "F", None)
    suite.compare("grant: acquire on a free GPU", found["grant"], found[FLOOR], "F", 1.5)
    suite.compare(
        "grant: acquire on a free GPU, by p99", found["grant"], found[FLOOR], "F's p99", 2.0, of=p99
    )
    if "redis" in found:
        suite.time(
            "Redis: take + give back, alone", found["usual"], "redis-py's lock; appended to its log"
        )
        suite.time("Redis: the same, spoken by hand", found["redis"])
        suite.compare("acquire + release, alone", found["cycle"], found["usual"], "Redis", 1.6)
    else:
        suite.time("acquire + release, alone", found["cycle"], redis_locks.missing())
