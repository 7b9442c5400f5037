"""The last minute of one camera, for a model that judges progress: pictures with their times.

Kept only where a reward model is configured. A camera without pictures leaves a gap, and a gap
stays a gap.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from vram_arbiter.schemas.errors import FrameStale, RunnerUnreachable, VramError
from vram_arbiter.schemas.goals import FrameReply
from vram_arbiter.schemas.tools import PROGRESS_WINDOW_MAX_S

log = logging.getLogger(__name__)

RATE_HZ = 2.0  # where the reward model's manifest is not installed
RATE_MAX_HZ = 5.0  # the runner renders and encodes each one
KEPT_MAX = 512
# to the model at once, as other clients do; the oldest and the newest are always among them
SHOWN_MAX = 8


@dataclass(frozen=True, slots=True)
class Taken:
    """A PNG picture and when it was taken, on this process' monotonic clock."""

    at_s: float
    image: bytes

    @property
    def age_s(self) -> float:
        return _now_s() - self.at_s


class Past:
    """`look` returns the camera's newest picture, or raises.

    `run` looks at `rate_hz` until canceled; `add` takes a picture that was fetched elsewhere.
    """

    def __init__(
        self, look: Callable[[], Awaitable[FrameReply]], *, rate_hz: float = RATE_HZ
    ) -> None:
        self._look = look
        self._period_s = 1.0 / min(rate_hz, RATE_MAX_HZ)
        self._kept: deque[Taken] = deque(maxlen=KEPT_MAX)
        self._silent = False

    async def run(self) -> None:
        """Never raises for what the runner does."""
        while True:
            try:
                await self.look()
                self._silent = False
            except VramError as error:
                if not self._silent and not isinstance(error, FrameStale | RunnerUnreachable):
                    log.warning("no pictures for judging progress: %s", error)
                self._silent = True
            await asyncio.sleep(self._period_s)

    async def look(self) -> Taken:
        """Fetch and keep the newest picture. Raises FrameStale and what else the runner raises."""
        frame = await self._look()
        taken = Taken(_now_s() - frame["age_ms"] / 1e3, frame["data"])
        self.add(taken)
        return taken

    def add(self, taken: Taken) -> None:
        """Pictures come in order: one that is not newer than the last is the last again."""
        if not self._kept or taken.at_s > self._kept[-1].at_s:
            self._kept.append(taken)
        while self._kept[0].at_s < taken.at_s - PROGRESS_WINDOW_MAX_S:
            self._kept.popleft()

    def since(self, start_s: float) -> list[Taken]:
        """Return the pictures since then, oldest first, thinned out evenly to `SHOWN_MAX`."""
        return spread([taken for taken in self._kept if taken.at_s >= start_s], SHOWN_MAX)


def spread[T](items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` items, two at least, evenly; the first and the last stay."""
    if len(items) <= most:
        return list(items)
    return [items[round(index * (len(items) - 1) / (most - 1))] for index in range(most)]


def _now_s() -> float:
    return asyncio.get_running_loop().time()
