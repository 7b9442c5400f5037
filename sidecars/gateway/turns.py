"""Order of the requests of one server: which waits, which is next. Pure: time is an argument.

By priority of its key, which grows while a request waits, so that none starves; among equals the
key that used the server least lately; then the order of arrival.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from vram_arbiter.schemas.defaults import AGEING_S_PER_POINT
from vram_arbiter.schemas.errors import LimitExceeded

HALF_LIFE_S: Final = 600.0
"""Of what a key has used."""


@dataclass(eq=False, slots=True)
class Request:
    """One request of a key, since it came. `began`: when its turn came; None: it waits."""

    key: str
    priority: int
    since: float
    began: float | None = None


@dataclass(slots=True)
class _Use:
    """Seconds of requests in flight, halved each HALF_LIFE_S."""

    seconds: float = 0.0
    at: float = 0.0

    def until(self, now: float) -> float:
        return float(self.seconds * 0.5 ** ((now - self.at) / HALF_LIFE_S))

    def add(self, seconds: float, now: float) -> None:
        self.seconds, self.at = self.until(now) + seconds, now


class Turns:
    """At most `parallel` requests run and `waiting_max` wait. `reserved`: by key, how many of
    `parallel` are kept for it; together they are fewer than `parallel`."""

    def __init__(self, parallel: int, waiting_max: int, reserved: Mapping[str, int]) -> None:
        self._parallel, self._waiting_max = parallel, waiting_max
        self._reserved = reserved
        self._waiting: dict[str, dict[Request, None]] = {}  # by key, oldest first
        self._running: dict[str, int] = {}
        self._used: dict[str, _Use] = {}

    @property
    def waiting(self) -> int:
        return sum(map(len, self._waiting.values()))

    @property
    def running(self) -> int:
        return sum(self._running.values())

    def enter(self, request: Request) -> None:
        """Let a request wait. Raises LimitExceeded."""
        if self.waiting >= self._waiting_max:
            raise LimitExceeded(
                f"{self._waiting_max} requests wait already",
                hint="try again later",
                details={"limit": "queue_max"},
            )
        self._waiting.setdefault(request.key, {})[request] = None

    def next(self, now: float) -> Request | None:
        """Begin the turn of the request that is next; None: none waits, or none may run."""
        able = [requests for key, requests in self._waiting.items() if self._may_run(key)]
        if not able:
            return None
        first = min(
            (next(iter(requests)) for requests in able), key=lambda one: self._rank(one, now)
        )
        self._forget(first)
        first.began = now
        self._running[first.key] = self._running.get(first.key, 0) + 1
        return first

    def leave(self, request: Request, now: float) -> None:
        """End a request's turn, or its wait."""
        if request.began is None:
            self._forget(request)
            return
        self._running[request.key] -= 1
        if not self._running[request.key]:
            del self._running[request.key]
        self._used.setdefault(request.key, _Use()).add(now - request.began, now)
        request.began = None

    def put_back(self, request: Request, now: float) -> None:
        """Let a request wait again, before the others of its key: its turn came to nothing."""
        self.leave(request, now)
        self._waiting[request.key] = {request: None, **self._waiting.get(request.key, {})}

    def all_waiting(self) -> list[Request]:
        return [request for requests in self._waiting.values() for request in requests]

    def _may_run(self, key: str) -> bool:
        if self._running.get(key, 0) < self._reserved.get(key, 0):
            return self.running < self._parallel
        kept = sum(
            max(0, count - self._running.get(other, 0)) for other, count in self._reserved.items()
        )
        return self.running < self._parallel - kept

    def _rank(self, request: Request, now: float) -> tuple[int, float, float]:
        aged = request.priority + int((now - request.since) / AGEING_S_PER_POINT)
        used = self._used.get(request.key, _Use()).until(now)
        return -aged, used, request.since

    def _forget(self, request: Request) -> None:
        waiting = self._waiting.get(request.key, {})
        waiting.pop(request, None)
        if not waiting:
            self._waiting.pop(request.key, None)
