"""What one step of an event tells the next ones.

A turn begins and ends with its event; nothing of it is state.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.schemas.ids import GpuId, ProcessKey, Token

if TYPE_CHECKING:
    from vram_arbiter.arbiter.core.model.state import Gpu


@dataclass(slots=True)
class Turn:
    """Scratch of the event that is handled now."""

    effects: list[Effect] = field(default_factory=list)
    """To be performed, in this order."""
    dirty: dict[int, "Gpu"] = field(default_factory=dict)
    """GPUs by index whose queue must be served."""
    touched: dict[int, "Gpu"] = field(default_factory=dict)
    """GPUs by index whose records may have changed: their next reading is planned, their invariants
    are checked.
    """
    suspects: set[ProcessKey] = field(default_factory=set)
    """Processes that began to use or to wait: they may be in a circle (`scheduling.deadlock`)."""
    unanswered: list[Lease] = field(default_factory=list)
    """Leases of this event's acquire; one that is not granted at once is answered `queued`."""
    granted: list[tuple[Token, GpuId]] = field(default_factory=list)
    """Grants, for the invariants."""

    def touch(self, gpu: "Gpu") -> None:
        """Look at a GPU again before the turn ends."""
        self.touched[gpu.info.index] = gpu

    def next_dirty(self, after: "Gpu | None") -> "Gpu | None":
        """Take the first dirty GPU behind another, or the first of all; None: none is dirty."""
        if not self.dirty:
            return None
        behind = -1 if after is None else after.info.index
        index = min((index for index in self.dirty if index > behind), default=min(self.dirty))
        return self.dirty.pop(index)
