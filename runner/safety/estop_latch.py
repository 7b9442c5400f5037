"""Latch of the emergency stop: any thread sets it, nothing but a new process clears it.

Must not know the loop, the robot or a socket: the stop has to act even when all of them hang.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vram_arbiter.schemas.errors import EstopRequested


class EstopLatch:
    """The latched stop, if any. The first reason stays.

    `on_estop(reason)` runs on the thread that asks for the stop, before the control loop obeys:
    the safety gate uses it to pass nothing from that moment on.
    """

    def __init__(self, on_estop: Callable[[str], None] | None = None) -> None:
        self.error: EstopRequested | None = None
        self.since_ns = 0  # monotonic time of the stop; 0: not latched
        self._on_estop = on_estop
        self._setting = threading.Lock()  # two threads may stop at once

    def request(self, reason: str) -> None:
        """Latch the stop on request of a person or program. Any thread."""
        self._set(
            EstopRequested(
                f"emergency stop: {reason}",
                hint="look at the robot, then start the runner again",
                details={"reason": reason},
            )
        )
        if self._on_estop is not None:
            self._on_estop(reason)

    def report(self, error: EstopRequested) -> None:
        """Latch a stop that the hardware itself reported."""
        if self.error is None and self._on_estop is not None:
            self._on_estop(error.message)
        self._set(error)

    def amend(self, error: EstopRequested) -> None:
        """Replace the error by one that also says what became of the motors."""
        self.error = error

    def _set(self, error: EstopRequested) -> None:
        with self._setting:
            if self.error is None:
                self.since_ns = time.monotonic_ns()
                self.error = error
