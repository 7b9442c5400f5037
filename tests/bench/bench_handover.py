"""From one client's release to the next one's grant, with 2 to 10,000 in the queue.

The subject is the queue, as with any lock: leases of 4 KiB that wait for the GPU's one loading
slot, so nothing has to be measured gone before the next grant. What a handover of real bytes takes
is in `bench_eviction`.
"""

from collections import deque
from contextlib import ExitStack
from typing import Any

from tests.bench import redis_locks
from tests.bench.harness import Peer, Suite, arbiter, elapsed_us, in_turns

CONNECTIONS_MAX = 64


class Line:
    """Clients of one daemon that take turns in a fixed order: one holds, the others wait."""

    def __init__(self, endpoint: str, clients: int) -> None:
        self.peers = [
            Peer(endpoint, f"w{index}").greeted() for index in range(min(clients, CONNECTIONS_MAX))
        ]
        self.queue: deque[Peer] = deque()
        self.holder, self.lease = self.peers[0], self.peers[0].lease()
        for number in range(1, clients):
            self.join(self.peers[number % len(self.peers)])

    def join(self, peer: Peer) -> None:
        assert peer.reply(peer.want())["state"] == "queued"
        self.queue.append(peer)

    def hand_over(self) -> float:
        """Microseconds from the release to the grant; then whoever gave queues up again."""
        giver, taker = self.holder, self.queue.popleft()
        pending: list[int] = []
        granted: list[dict[str, Any]] = []

        def act() -> None:
            pending.append(giver.letting_go(self.lease))
            granted.append(taker.push("granted")["lease"])

        took = elapsed_us(act)
        giver.reply(pending[0])
        self.holder, self.lease = taker, granted[0]
        self.join(giver)
        return took

    def close(self) -> None:
        for peer in self.peers:
            peer.close()


class RedisLine:
    """The same with a Redis lock: BLPOP serves the longest waiter first."""

    def __init__(self, path: str, clients: int, make: type[redis_locks.RedisLocks]) -> None:
        self.lock = f"{make.__name__}{clients}".encode()
        self.clients = [make(path, f"w{index}") for index in range(clients)]
        self.holder, self.queue = self.clients[0], deque(self.clients[1:])
        assert self.holder.take(self.lock)
        for client in self.queue:
            client.waiting(self.lock)

    def hand_over(self) -> float:
        giver, taker = self.holder, self.queue.popleft()

        def act() -> None:
            giver.giving_back(self.lock)
            taker.answer()
            assert taker.take(self.lock)

        took = elapsed_us(act)
        assert giver.answer() == b"1"
        giver.waiting(self.lock)
        self.queue.append(giver)
        self.holder = taker
        return took

    def close(self) -> None:
        for client in self.clients:
            client.close()


def run(suite: Suite) -> None:
    rounds = suite.size(1000, 100)
    many = suite.size(10_000, 1000)
    with ExitStack() as stack:
        calls = {}
        for clients in (2, 8, 64, 256, many):
            daemon = stack.enter_context(arbiter())
            line = Line(daemon.endpoint, clients)
            stack.callback(line.close)
            calls[f"{clients}"] = line.hand_over
        if not redis_locks.missing():
            path = stack.enter_context(redis_locks.redis())
            for clients in (2, 64, 256):
                for kind in (redis_locks.UsualRedisLocks, redis_locks.RedisLocks):
                    line_of_redis = RedisLine(path, clients, kind)
                    stack.callback(line_of_redis.close)
                    calls[f"{kind.__name__} {clients}"] = line_of_redis.hand_over
        found = in_turns(rounds, calls)
    for clients, target in ((2, 1.2), (64, None), (256, 0.8)):
        name, rival = f"handover, {clients} clients", found.get(f"UsualRedisLocks {clients}")
        if rival is None:
            suite.time(name, found[f"{clients}"], redis_locks.missing())
            continue
        suite.time(f"Redis: handover, {clients} clients", rival, "redis-py, BLPOP")
        suite.time(f"Redis: the same, {clients}, spoken by hand", found[f"RedisLocks {clients}"])
        suite.compare(name, found[f"{clients}"], rival, "Redis", target)
    suite.time("handover, 8 clients", found["8"])
    suite.compare(f"handover, {many} clients", found[f"{many}"], found["8"], "8 clients", 1.3)
