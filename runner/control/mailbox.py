"""Mailbox of the control thread: work that other threads want done between two ticks."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from vram_arbiter.schemas.errors import InternalError

MAILBOX_MAX = 256


class Mailbox:
    """Callables for the control thread, in order. A closed mailbox fails what is posted at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._posted: deque[
            tuple[Callable[[], Any], Callable[[Any, BaseException | None], None]]
        ] = deque()
        self._closed = False

    def post(
        self, work: Callable[[], Any], deliver: Callable[[Any, BaseException | None], None]
    ) -> None:
        """Queue `work`, from any thread; `deliver(result, error)` runs on the control thread.

        Raises InternalError when the control thread has ended or the mailbox is full.
        """
        with self._lock:
            if self._closed or len(self._posted) >= MAILBOX_MAX:
                raise InternalError(
                    "the control thread does not take work", hint="see the runner's log; restart it"
                )
            self._posted.append((work, deliver))

    def run_pending(self) -> None:
        """Run everything that is posted now. Control thread only."""
        for _ in range(len(self._posted)):
            with self._lock:
                work, deliver = self._posted.popleft()
            try:
                result = work()
            except Exception as error:  # noqa: BLE001 — belongs to the poster, not to the loop
                deliver(None, error)
            else:
                deliver(result, None)

    def close(self) -> None:
        """Refuse further work and fail what still waits."""
        with self._lock:
            self._closed = True
            left = list(self._posted)
            self._posted.clear()
        for _, deliver in left:
            deliver(None, InternalError("the control thread has ended", hint="restart the runner"))
