"""A thread that waits in DDS, so that an event loop does not have to."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Collection
from typing import Any, Final

log = logging.getLogger(__name__)

WAIT_S: Final = 1.0  # the longest that the thread sleeps in DDS; data wakes it
STOP_S: Final = 2.0


class DdsThread:
    """Calls `woken` on a thread of its own when a reader has data or an entity's status changed.

    An error of DDS or of `woken` ends the thread; `failed` hears of it there.
    """

    def __init__(
        self,
        name: str,
        participant: Any,
        readers: Collection[Any],
        entities: Collection[Any],
        woken: Callable[[], None],
        failed: Callable[[str], None],
    ) -> None:
        from cyclonedds.core import (
            GuardCondition,
            InstanceState,
            ReadCondition,
            SampleState,
            ViewState,
            WaitSet,
        )

        self._woken, self._failed = woken, failed
        self._guard: Any = GuardCondition(participant)
        self._waitset = WaitSet(participant)
        state = SampleState.Any | ViewState.Any | InstanceState.Any
        unread = [ReadCondition(reader, state) for reader in readers]
        for entity in (self._guard, *entities, *unread):
            self._waitset.attach(entity)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def close(self) -> None:
        """End the thread. Blocks for `STOP_S` at most."""
        self._guard.set(True)
        self._thread.join(STOP_S)

    async def stop(self) -> None:
        """End the thread; the event loop goes on meanwhile."""
        await asyncio.to_thread(self.close)

    def _run(self) -> None:
        from cyclonedds.util import duration

        try:
            while not self._guard.read():
                self._waitset.wait(duration(seconds=WAIT_S))
                self._woken()
        except Exception as error:
            log.exception("%s ends", self._thread.name)
            self._failed(f"{type(error).__name__}: {error}")
