"""Bytes given up outside any verification that the driver may not have returned yet.

A load's peak and the bytes of a stowaway leave the GPU as slowly as any others. If they counted as
unattributed bytes, the next verdict would allow for bytes that are gone by then.
"""

from collections.abc import Callable, Collection

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.schemas.ids import ProcessKey


class PendingFree:
    """What each process gave up lately on one GPU."""

    def __init__(self) -> None:
        self._parts: dict[ProcessKey, tuple[float, int]] = {}  # (when last, bytes)

    def give_up(self, process: ProcessKey, count: int, now: float) -> None:
        """Add `count` bytes; a negative count takes the same memory again."""
        at, before = self._parts.get(process, (now, 0))
        if before + count > 0:
            self._parts[process] = (now if count > 0 else at, before + count)
        else:
            self._parts.pop(process, None)

    def watch(
        self,
        before: MemorySampled | None,
        reading: MemorySampled,
        leaving: Collection[ProcessKey],
        booked_bytes: Callable[[ProcessKey], int],
    ) -> None:
        """Compare two consecutive readings. Processes in `leaving` are under verification anyway.

        A process that is no longer listed may still hold its charge. The first reading of a daemon
        is compared with the charges: a holder may have freed bytes before the restart.
        """
        if not reading.lists_processes:
            return
        if before is None:
            for use in reading.listed:
                freed_bytes = booked_bytes(use.process) - use.held_bytes
                if use.used_bytes is not None and freed_bytes > 0:
                    self.give_up(use.process, freed_bytes, reading.taken_at)
            return
        now = {use.process: use.held_bytes for use in reading.listed}
        for use in before.listed:
            if use.process not in leaving:
                held = now[use.process] if use.process in now else booked_bytes(use.process)
                self.give_up(use.process, use.held_bytes - held, reading.taken_at)

    def since(self, at: float) -> int:
        """Return the most that may be pending of what was given up after `at`; forget the rest."""
        self._parts = {process: part for process, part in self._parts.items() if part[0] > at}
        return sum(count for _, count in self._parts.values())
