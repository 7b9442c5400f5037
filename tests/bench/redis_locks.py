"""Redis locks to compare with: SET NX PX to take one, a Lua compare-and-delete that wakes the
longest waiter to give it back.

They are crash-safe by TTL. Waiters block in BLPOP, which is the fastest way that Redis has;
redis-py's own lock polls. Redis appends to its log before it answers and leaves the disk's cache
alone, as the arbiter's journal does. Two clients: redis-py, which the targets were set by and
people use, and RESP spoken by hand, which shows what the server itself takes.
"""

import importlib.util
import os
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

LOCK_TTL_MS = b"10000"
START_S = 10.0
_RELEASE = b"""
if redis.call('get', KEYS[1]) == ARGV[1] then
  redis.call('del', KEYS[1])
  redis.call('rpush', KEYS[2], '1')
  redis.call('ltrim', KEYS[2], 0, 0)
  return 1
end
return 0
"""


class RedisLocks:
    """One connection that takes locks and gives them back. Blocking; speaks RESP by hand."""

    def __init__(self, path: str, owner: str) -> None:
        self._connect(path)
        self._owner = owner.encode()
        script = self.ask(b"SCRIPT", b"LOAD", _RELEASE)
        assert script is not None
        self._script = script

    def _connect(self, path: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket.connect(path)
        self._file = self.socket.makefile("rb")

    def send(self, *words: bytes) -> None:
        parts = [b"*%d\r\n" % len(words), *(b"$%d\r\n%s\r\n" % (len(word), word) for word in words)]
        self.socket.sendall(b"".join(parts))

    def answer(self) -> bytes | None:
        """One reply; of an array its last element. Raises RuntimeError with Redis's words."""
        line = self._file.readline()
        kind, rest = line[:1], line[1:-2]
        if kind == b"-":
            raise RuntimeError(rest.decode())
        if kind == b"$":
            size = int(rest)
            return None if size < 0 else self._file.read(size + 2)[:-2]
        if kind == b"*":
            found = None
            for _ in range(int(rest)):
                found = self.answer()
            return found
        return rest

    def ask(self, *words: bytes) -> bytes | None:
        self.send(*words)
        return self.answer()

    def taking(self, lock: bytes) -> None:
        self.send(b"SET", lock, self._owner, b"NX", b"PX", LOCK_TTL_MS)

    def take(self, lock: bytes) -> bool:
        self.taking(lock)
        return self.answer() is not None

    def waiting(self, lock: bytes) -> None:
        self.send(b"BLPOP", lock + b":free", b"0")

    def giving_back(self, lock: bytes) -> None:
        self.send(b"EVALSHA", self._script, b"2", lock, lock + b":free", self._owner)

    def give_back(self, lock: bytes) -> None:
        self.giving_back(lock)
        if self.answer() != b"1":
            raise RuntimeError("the lock was not ours")

    def cycle(self, lock: bytes) -> None:
        self.take(lock)
        self.give_back(lock)

    def close(self) -> None:
        self._file.close()
        self.socket.close()


class UsualRedisLocks(RedisLocks):
    """The same through redis-py's connection."""

    def _connect(self, path: str) -> None:
        from redis.connection import UnixDomainSocketConnection

        self._connection = UnixDomainSocketConnection(path=path)
        self._connection.connect()

    def send(self, *words: bytes) -> None:
        self._connection.send_command(*words)

    def answer(self) -> bytes | None:
        found = self._connection.read_response()
        if isinstance(found, list):
            found = found[-1]
        return str(found).encode() if isinstance(found, int) else found

    def fileno(self) -> int:
        sock: socket.socket = self._connection._sock
        return sock.fileno()

    def close(self) -> None:
        self._connection.disconnect()


def usual_cycle(path: str) -> Callable[[], object]:
    """redis-py's own lock, taken and given back."""
    from redis import Redis
    from redis.lock import Lock

    lock = Lock(Redis(unix_socket_path=path), "usual", timeout=10, blocking=False)
    return lambda: (lock.acquire(), lock.release())


def missing() -> str:
    """Why there is nothing to compare with; "" if there is."""
    if shutil.which("redis-server") is None:
        return "redis-server is not installed"
    return "" if importlib.util.find_spec("redis") else "redis-py is not installed"


@contextmanager
def redis() -> Iterator[str]:
    """A Redis of the run's own on a unix socket; yields its path."""
    with tempfile.TemporaryDirectory(prefix="vb") as folder:
        path = f"{folder}/redis.sock"
        options = {"port": "0", "unixsocket": path, "dir": folder, "save": "", "appendonly": "yes"}
        options |= {"appendfsync": "no", "logfile": f"{folder}/log", "maxclients": "20000"}
        command = [
            "redis-server",
            *(word for key, value in options.items() for word in (f"--{key}", value)),
        ]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            deadline = time.monotonic() + START_S
            while not os.path.exists(path):
                if process.poll() is not None or time.monotonic() > deadline:
                    log = Path(folder, "log")
                    raise RuntimeError(
                        f"redis did not start: {log.read_text() if log.exists() else ''}"
                    )
                threading.Event().wait(0.01)
            yield path
        finally:
            process.terminate()
            process.wait(10)
