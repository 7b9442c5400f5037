"""Mailbox of the control thread: work that other threads want done between two ticks."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from vram_arbiter.schemas.errors import InternalError

MAILBOX_MAX = 256


class Mailbox:
    """Callables for the control thread, in order. A closed mailbox fails what is posted at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._posted: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._closed = False

    def post[T](self, work: Callable[[], T]) -> Future[T]:
        """Queue `work`, from any thread; its future's callbacks run on the control thread.

        Work whose future is canceled before its turn is not done. Raises InternalError when the
        control thread has ended or the mailbox is full.
        """
        done: Future[T] = Future()
        with self._lock:
            if self._closed or len(self._posted) >= MAILBOX_MAX:
                raise InternalError(
                    "the control thread does not take work", hint="see the runner's log; restart it"
                )
            self._posted.append((work, done))
        return done

    def run_pending(self) -> None:
        """Run everything that is posted now. Control thread only."""
        for _ in range(len(self._posted)):
            with self._lock:
                work, done = self._posted.popleft()
            if not done.set_running_or_notify_cancel():
                continue
            try:
                result = work()
            except Exception as error:  # noqa: BLE001 — belongs to the poster, not to the loop
                done.set_exception(error)
            else:
                done.set_result(result)

    def close(self) -> None:
        """Refuse further work and fail what still waits."""
        with self._lock:
            self._closed = True
            left = list(self._posted)
            self._posted.clear()
        for _, done in left:
            if done.set_running_or_notify_cancel():
                error = InternalError("the control thread has ended", hint="restart the runner")
                done.set_exception(error)
