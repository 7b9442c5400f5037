"""What a GPU backend can do for the daemon: say which cards there are, and read one of them.

Calls block and may hang (a driver can): the host runs them in a thread of their own with a deadline. A probe never decides
anything, and none of them creates a CUDA context.
"""

from dataclasses import dataclass
from typing import Protocol

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.schemas.ids import GpuId


@dataclass(frozen=True, slots=True)
class Card:
    """One GPU as its backend names it. `reserved_bytes` the driver keeps for itself.

    A card whose memory others live in too asks for more: `margin_bytes` is its least reserve, `noise_bytes` its least tolerance.
    """

    id: GpuId
    index: int
    name: str
    total_bytes: int
    reserved_bytes: int = 0
    margin_bytes: int = 0
    noise_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of one card. `used_bytes` leaves the driver's own reserve out; `processes` None: cannot be listed."""

    used_bytes: int
    total_bytes: int
    processes: tuple[ProcessUse, ...] | None


class GpuProbe(Protocol):
    """A backend. Every method blocks.

    `cards` raises NoGpu where there is none. `sample` raises ProbeFailed when the reading fails (unknown, never free) and
    UnknownGpu for a card that `cards` does not list. `close` may be called from another thread and ends a hanging `sample`
    where the backend can.
    """

    def cards(self) -> tuple[Card, ...]: ...

    def sample(self, gpu: GpuId) -> Reading: ...

    def close(self) -> None: ...
