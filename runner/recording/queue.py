"""Queue between the control thread and the recorder's own: ticks are bounded, the rest is not."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from vram_arbiter.runner.protocols import GoalTick

QUEUE_TICKS = 90  # three seconds at 30 Hz
QUEUE_BYTES = 96 << 20


class TickQueue[T]:
    """`put_tick` refuses what does not fit; `put` takes anything else. One reader, `next`.

    `changed` guards it, and whatever its owner decides together with it.
    """

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self._items: deque[GoalTick | T] = deque()
        self._ticks = 0
        self._bytes = 0

    def fits(self, tick: GoalTick) -> bool:
        """Return whether there is room for a tick. Call it with `changed` held."""
        return self._ticks < QUEUE_TICKS and (
            self._bytes + _size(tick) <= QUEUE_BYTES or not self._ticks
        )

    def put_tick(self, tick: GoalTick) -> bool:
        """Append a tick if there is room."""
        with self.changed:
            if not self.fits(tick):
                return False
            self._items.append(tick)
            self._ticks += 1
            self._bytes += _size(tick)
            self.changed.notify_all()
            return True

    def put(self, item: T, *, first: bool = False) -> None:
        """Append an item, or put it before all others."""
        with self.changed:
            (self._items.appendleft if first else self._items.append)(item)
            self.changed.notify_all()

    def wait(self, so: Callable[[], bool], timeout_s: float) -> None:
        """Wait until `so`, which is evaluated after every change."""
        with self.changed:
            self.changed.wait_for(so, timeout_s)

    def next(self) -> GoalTick | T:
        """Wait for an item and remove it."""
        with self.changed:
            self.changed.wait_for(lambda: bool(self._items))
            item = self._items.popleft()
            if isinstance(item, GoalTick):
                self._ticks -= 1
                self._bytes -= _size(item)
                self.changed.notify_all()
            return item


def _size(tick: GoalTick) -> int:
    return sum(len(frame.data or b"") for frame in (tick.world.image_frames or {}).values())
