"""How a running program gives up its GPU memory, and takes it back.

Actions block, and are called in a worker thread, one at a time. Whether the memory came back is not
their matter: the arbiter measures it.
"""

import time
from collections.abc import Sequence
from typing import Final, Protocol

from vram_arbiter.schemas.errors import ActionFailed

POLL_S: Final = 0.2
"""Between two looks at a server that frees its memory in the background."""


class Action(Protocol):
    """What can be done to a running program. `pids`: its processes, parents first."""

    @property
    def name(self) -> str: ...

    @property
    def keeps_context(self) -> bool:
        """Whether the program keeps its CUDA context while it is away."""
        ...

    @property
    def parks(self) -> bool:
        """Whether the weights stay in host RAM while it is away."""
        ...

    @property
    def suspends(self) -> bool:
        """Whether the program stands still while it is away, and may not react to signals."""
        ...

    def check(self) -> None:
        """Look for what the action needs of this machine. Raises CheckpointUnsupported."""
        ...

    def busy(self) -> int | None:
        """Return the number of requests in progress; None where the program does not say."""
        ...

    def free(self, pids: Sequence[int]) -> None:
        """Free the GPU memory. Raises ActionFailed."""
        ...

    def restore(self, pids: Sequence[int]) -> None:
        """Take the GPU memory back. Raises ActionFailed."""
        ...


class Deadline:
    """The time that one action may take."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._end = time.monotonic() + limit_s

    def left_s(self, what: str, least_s: float = 0.0) -> float:
        """Return the seconds that are left. Raises ActionFailed, naming `what` is late."""
        left = self._end - time.monotonic()
        if left <= least_s:
            raise ActionFailed(
                f"{what}: not done within {self.limit_s:g} s", hint="allow more with --timeout"
            )
        return left

    def pause(self, what: str) -> None:
        """Wait a moment before the next look. Raises ActionFailed."""
        self.left_s(what, POLL_S)
        time.sleep(POLL_S)
