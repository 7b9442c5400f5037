"""Simulated time: one heap of what is due, one event loop per simulated process, one trace.

A `ProcessLoop` is an asyncio loop whose process can be frozen (SIGSTOP: what is due waits) or
killed (what is due never happens). Two runs with the same seed do the same things in the same
order; the trace's hash proves it. Knows nothing of arbiters.
"""

import asyncio
import contextvars
import hashlib
import random
from collections import deque
from collections.abc import Callable, Coroutine, Generator
from heapq import heappop, heappush
from typing import Any

STEPS_MAX = 2_000_000
"""More than any sane run needs: beyond it, something is busy without end."""
TRACE_LINES = 400

Callback = Callable[[], object]


class Trace:
    """What happened: the last lines for people, a hash over all of them for comparing runs."""

    def __init__(self, lines_max: int | None = TRACE_LINES) -> None:
        self._hash = hashlib.blake2b(digest_size=16)
        self.lines: deque[str] = deque(maxlen=lines_max)
        self.count = 0

    def add(self, now: float, what: str) -> None:
        line = f"{now:.6f} {what}"
        self._hash.update(line.encode())
        self.lines.append(line)
        self.count += 1

    def digest(self) -> str:
        return self._hash.hexdigest()


class Clock:
    """The scheduler. `random` is the only source of chance in a simulation."""

    def __init__(self, seed: int, lines_max: int | None = TRACE_LINES) -> None:
        self.random = random.Random(seed)
        self.now = 1000.0
        self.trace = Trace(lines_max)
        self.after_step: Callback | None = None
        self.steps = 0
        self._heap: list[tuple[float, int, Callback]] = []
        self._count = 0
        self._ids = 0

    def new_id(self, prefix: str) -> str:
        self._ids += 1
        return f"{prefix}{self._ids}"

    def at(self, when: float, callback: Callback) -> None:
        self._count += 1
        heappush(self._heap, (max(when, self.now), self._count, callback))

    def after(self, delay_s: float, callback: Callback) -> None:
        self.at(self.now + delay_s, callback)

    def chance(self, probability: float) -> bool:
        return self.random.random() < probability

    def say(self, what: str) -> None:
        self.trace.add(self.now, what)

    def run_until(self, when: float, done: Callable[[], bool] | None = None) -> bool:
        """Let time pass. With `done`: stop as soon as it holds; returns whether it did."""
        while self._heap and self._heap[0][0] <= when:
            if done is not None and done():
                return True
            due, _, callback = heappop(self._heap)
            self.now = max(self.now, due)
            self.steps += 1
            if self.steps > STEPS_MAX:
                raise AssertionError(f"{STEPS_MAX} steps: somebody is busy without end")
            callback()
            if self.after_step is not None:
                self.after_step()
        if done is not None and done():
            return True
        self.now = max(self.now, when)
        return False


class ProcessLoop(asyncio.AbstractEventLoop):
    """The loop of one simulated process. What asyncio's interface has beyond this (files, sockets,
    signals) raises NotImplementedError."""

    def __init__(self, clock: Clock, name: str) -> None:
        self.clock = clock
        self.name = name
        self.dead = False
        self.frozen = False
        self.on_failure: Callable[[BaseException], None] | None = None
        self._deferred: list[Callback] = []
        # kept alive: a task of a killed process just never goes on
        self._tasks: list[asyncio.Task[Any]] = []

    # -- the process
    def freeze(self) -> None:
        self.frozen = True

    def thaw(self) -> None:
        """SIGCONT: everything that came meanwhile is there at once, and handled in one go."""
        self.frozen = False
        deferred, self._deferred = self._deferred, []

        def catch_up() -> None:
            for callback in deferred:
                callback()

        self.clock.at(self.clock.now, catch_up)

    def kill(self) -> None:
        self.dead = True
        self._deferred.clear()

    def enter(self, callback: Callback) -> None:
        """Do something as this process, now or when it is thawed; never if it is dead."""
        if self.dead:
            return
        if self.frozen:
            self._deferred.append(lambda: self.enter(callback))
            return
        asyncio._set_running_loop(self)
        try:
            callback()
        finally:
            asyncio._set_running_loop(None)

    # -- asyncio's side
    def time(self) -> float:
        return self.clock.now

    def get_debug(self) -> bool:
        return False

    def is_running(self) -> bool:
        return not self.dead

    def is_closed(self) -> bool:
        return False

    def call_soon(  # type: ignore[override]
        self,
        callback: Callable[..., object],
        *args: Any,
        context: contextvars.Context | None = None,
    ) -> asyncio.Handle:
        handle = asyncio.Handle(callback, args, self, context)
        self.clock.at(self.clock.now, lambda: self._run(handle))
        return handle

    def call_later(  # type: ignore[override]
        self,
        delay: float,
        callback: Callable[..., object],
        *args: Any,
        context: contextvars.Context | None = None,
    ) -> asyncio.TimerHandle:
        return self.call_at(self.clock.now + delay, callback, *args, context=context)

    def call_at(  # type: ignore[override]
        self,
        when: float,
        callback: Callable[..., object],
        *args: Any,
        context: contextvars.Context | None = None,
    ) -> asyncio.TimerHandle:
        handle = asyncio.TimerHandle(when, callback, args, self, context)
        self.clock.at(when, lambda: self._run(handle))
        return handle

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        """Asyncio's word that a timer is off; it is skipped when it comes up."""

    def _run(self, handle: asyncio.Handle) -> None:
        if not handle.cancelled():
            self.enter(lambda: None if handle.cancelled() else handle._run())

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)

    def create_task[T](
        self,
        coro: Coroutine[Any, Any, T] | Generator[Any, Any, T],
        *,
        name: str | None = None,
        context: contextvars.Context | None = None,
    ) -> asyncio.Task[T]:
        assert isinstance(coro, Coroutine)
        task = asyncio.Task(coro, loop=self, name=name, context=context)
        self._tasks.append(task)
        return task

    def get_task_factory(self) -> None:
        """None: tasks are asyncio's own."""

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if not self.dead and error is not None and self.on_failure is not None:
            self.on_failure(error)


def new_loop(clock: Clock, name: str) -> ProcessLoop:
    """Return the loop of a new process."""
    return ProcessLoop(clock, name)  # type: ignore[abstract]  # only stub methods are
