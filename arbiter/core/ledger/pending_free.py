"""Bytes that were given up outside any verification, and that the card may still show as nobody's: a load's peak, what a stowaway held.

A driver takes its time with these as with any others. Were such a rest taken for somebody's (a stowaway's that nobody can list, the
driver's own), the verdict on the next release would allow for bytes that are gone by then, and so for as many of the lease's own.
"""

from collections.abc import Callable, Collection

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.schemas.ids import ProcessKey


class PendingFree:
    """What processes gave up on one card lately."""

    def __init__(self) -> None:
        self._parts: dict[ProcessKey, tuple[float, int]] = {}  # when last, how much

    def give_up(self, process: ProcessKey, count: int, now: float) -> None:
        """`count` bytes less than before; a negative one is taken from the same memory again."""
        at, before = self._parts.get(process, (now, 0))
        if before + count > 0:
            self._parts[process] = (now if count > 0 else at, before + count)
        else:
            self._parts.pop(process, None)

    def watch(
        self,
        before: MemorySampled | None,
        sample: MemorySampled,
        leaving: Collection[ProcessKey],
        booked_bytes: Callable[[ProcessKey], int],
    ) -> None:
        """Compare two readings in a row. What is leaving is measured away anyhow, and what is no longer listed explains its charge.

        The first reading of a daemon is compared with the charges of the journal: a holder may have freed its bytes before the restart.
        """
        if sample.processes is None:
            return
        if before is None:
            for use in sample.processes:
                freed_bytes = booked_bytes(use.process) - (use.used_bytes or 0)
                if use.used_bytes is not None and freed_bytes > 0:
                    self.give_up(use.process, freed_bytes, sample.taken_at)
            return
        if before.processes is None:
            return
        now = {use.process: use.used_bytes or 0 for use in sample.processes}
        for use in before.processes:
            if use.process in leaving:
                continue
            held = now[use.process] if use.process in now else booked_bytes(use.process)
            self.give_up(use.process, (use.used_bytes or 0) - held, sample.taken_at)

    def since(self, at: float) -> int:
        """The most that may be on its way, of what was given up after that moment; the rest is forgotten."""
        self._parts = {process: part for process, part in self._parts.items() if part[0] > at}
        return sum(count for _, count in self._parts.values())
