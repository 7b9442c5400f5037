"""Background writer: a thread that writes what the event loop hands over, in order, within bounds.

`put` costs the loop an append; batches reach the thread every FLUSH_S. A `Sink` knows what is
written, and where.
"""

import asyncio
import contextlib
import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

FLUSH_S = 0.2
CLOSE_S = 5.0
"""How long `close` waits for the last write."""


class DiskFailed(Exception):
    """A write or a question failed; the message is the disk's own."""


class DiskBehind(DiskFailed):
    """The disk has not taken as many items, or answered as many questions, as may wait for it."""


class Sink[Item](Protocol):
    """Where items go. Used by the writer's thread alone, from the first write on."""

    def write(self, items: Sequence[Item]) -> None:
        """Write a batch. Whatever it raises is told as DiskFailed."""

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class _Question:
    find: Callable[[], Any]
    done: Callable[[Any], None]


class DiskWriter[Item]:
    """`start` inside the loop, `put` from the loop's thread, `close` at the end (writes the rest).

    `told` is called on the loop: with each failure, and with None once writing works again.
    At most `items_max` items are with the thread and as many wait for it; beyond that `put` drops
    the oldest one that waits.
    """

    def __init__(
        self,
        name: str,
        sink: Sink[Item],
        told: Callable[[DiskFailed | None], None],
        *,
        items_max: int,
        questions_max: int = 0,
    ) -> None:
        self._name = name
        self._sink = sink
        self._told = told
        self._items_max = items_max
        self._questions_max = questions_max
        self._waiting: deque[Item] = deque(maxlen=items_max)
        self._work: queue.SimpleQueue[Sequence[Item] | _Question | None] = queue.SimpleQueue()
        # Each counter has one writer: the loop counts `_handed` and `_asked`, the thread the rest.
        self._handed = self._taken = self._written = 0
        self._asked = self._answered = 0
        self._report_success = False  # after a failure; both sides set it, the thread resets it
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._thread: threading.Thread | None = None

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread is not None

    @property
    def behind(self) -> int:
        """Items with the thread that are neither written nor given up yet."""
        return self._handed - self._written

    def put(self, item: Item) -> bool:
        """Accept an item for the next batch. Return False if the oldest was dropped for it."""
        room = len(self._waiting) < self._items_max
        self._waiting.append(item)
        if self._timer is None:
            self._arm()
        return room

    def clear(self) -> None:
        """Drop the items that the thread does not have yet."""
        self._waiting.clear()

    def confirm(self) -> None:
        """Tell None after the next batch that is written, as after a failure."""
        self._report_success = True

    def flush(self) -> None:
        """Hand over the batch now. Tells DiskBehind, and tries again, while the thread hangs."""
        self._disarm()
        if not self._waiting or not self.running:
            return
        if self._handed - self._taken + len(self._waiting) > self._items_max:
            self._report_success = True
            self._told(DiskBehind("the disk does not answer"))
            self._arm()
        else:
            self._hand_over()

    def ask[Answer](
        self, find: Callable[[], Answer], done: Callable[[Answer | DiskFailed], None]
    ) -> None:
        """Run `find` on the thread, after all that was put before; `done` gets the answer.

        Raises DiskBehind if `questions_max` questions wait.
        """
        self.flush()
        if self._asked - self._answered >= self._questions_max:
            raise DiskBehind("the disk does not answer")
        self._asked += 1
        self._work.put(_Question(find, done))

    def close(self) -> None:
        """Write what is left and end the thread; give up on a disk that hangs after CLOSE_S."""
        self._disarm()
        if self._thread is not None:
            self._hand_over()
            self._work.put(None)
            self._thread.join(CLOSE_S)
            self._thread = None
        self._loop = None

    # -- on the loop -------------------------------------------------------------------------------
    def _arm(self) -> None:
        if self._timer is None and self._loop is not None:
            self._timer = self._loop.call_later(FLUSH_S, self.flush)

    def _disarm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _hand_over(self) -> None:
        if self._waiting:
            self._handed += len(self._waiting)
            self._work.put(tuple(self._waiting))
            self._waiting.clear()

    # -- the thread --------------------------------------------------------------------------------
    def _run(self) -> None:
        while (work := self._work.get()) is not None:
            if isinstance(work, _Question):
                self._answer(work)
            else:
                self._write(work)
        self._sink.close()

    def _write(self, items: Sequence[Item]) -> None:
        self._taken += len(items)
        try:
            self._sink.write(items)
        except Exception as error:  # noqa: BLE001 - whatever the sink raises is told
            failure = DiskFailed(f"{type(error).__name__}: {error}")
            failure.__cause__ = error
            self._report_success = True
            self._on_loop(partial(self._told, failure))
        else:
            if self._report_success:
                self._report_success = False
                self._on_loop(partial(self._told, None))
        finally:
            self._written += len(items)

    def _answer(self, question: _Question) -> None:
        answer: Any
        try:
            answer = question.find()
        except Exception as error:  # noqa: BLE001 - the asker gets it
            answer = DiskFailed(str(error))
        self._answered += 1
        self._on_loop(partial(question.done, answer))

    def _on_loop(self, call: Callable[[], None]) -> None:
        if (loop := self._loop) is not None:
            with contextlib.suppress(RuntimeError):  # the loop closed meanwhile
                loop.call_soon_threadsafe(call)
