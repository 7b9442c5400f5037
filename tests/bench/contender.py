"""Some of the clients that fight for one lock: each takes it, gives it back, and queues up again,
until a line says stop.

Says a line when connected, waits for a line to begin, and prints how many cycles each of its
clients made.
"""

import json
import os
import selectors
import sys
from typing import Any

import msgpack
import zmq

from tests.bench import redis_locks
from tests.bench.harness import Peer

LOCK = b"contended"


class Contender:
    """A client of the arbiter."""

    def __init__(self, endpoint: str, name: str) -> None:
        self.peer = Peer(endpoint, name).greeted()
        self.source: Any = self.peer.socket.fileno()
        self.cycles = 0

    def begin(self) -> None:
        self.peer.want()

    def go_on(self) -> None:
        """What has come: a grant is given back at once, a release that is confirmed is followed by
        the next acquire."""
        while int(self.peer.socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            message: dict[str, Any] = msgpack.unpackb(self.peer.socket.recv())
            if message.get("push") == "granted" or message.get("state") == "loading":
                self.peer.letting_go(message["lease"])
            elif message.get("state") in ("verifying", "released"):
                self.cycles += 1
                self.begin()
            elif message.get("state") != "queued":
                raise RuntimeError(f"not expected: {message}")


class RedisContender:
    """The same with a Redis lock: try, else wait to be woken, then try again."""

    def __init__(self, path: str, name: str) -> None:
        self.locks = redis_locks.UsualRedisLocks(path, name)
        self.source: Any = self.locks.fileno()
        self.cycles = 0
        self._doing = ""

    def begin(self) -> None:
        self._doing = "taking"
        self.locks.taking(LOCK)

    def go_on(self) -> None:
        answer = self.locks.answer()
        if self._doing == "taking" and answer is None:
            self._doing = "waiting"
            self.locks.waiting(LOCK)
        elif self._doing == "taking":
            self._doing = "giving"
            self.locks.giving_back(LOCK)
        else:
            self.cycles += self._doing == "giving"
            self.begin()


def main(kind: str, address: str, count: int) -> None:
    make = Contender if kind == "arbiter" else RedisContender
    contenders = [make(address, f"{kind}{os.getpid()}-{number}") for number in range(count)]
    selector = selectors.DefaultSelector()
    for contender in contenders:
        selector.register(contender.source, selectors.EVENT_READ, contender)
    print("up", flush=True)
    sys.stdin.readline()
    selector.register(sys.stdin, selectors.EVENT_READ, None)
    for contender in contenders:
        contender.begin()
        if isinstance(contender, Contender):  # an edge may be gone with the sending
            contender.go_on()
    while True:
        ready = [key.data for key, _ in selector.select(1.0)]
        if None in ready:
            break
        for contender in ready:
            contender.go_on()
    print(json.dumps([contender.cycles for contender in contenders]), flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
