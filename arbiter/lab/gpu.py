"""GPU of a simulation, with late returns."""

from dataclasses import dataclass, field

from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.lab.workload import GpuPlan
from vram_arbiter.schemas.ids import ProcessKey

START_S = 1000.0
"""The engine's clock at the beginning."""
STOWAWAYS_PID = 900_000


@dataclass(slots=True)
class SimulatedGpu:
    """Bytes on one GPU.

    Bytes that are given up show until the lag is over; an allocation that does not fit is refused.
    """

    plan: GpuPlan
    held: dict[ProcessKey, int] = field(default_factory=dict)
    names: dict[ProcessKey, str] = field(default_factory=dict)
    peak_bytes: int = 0
    _late: list[tuple[float, ProcessKey, int]] = field(default_factory=list)

    def set(self, process: ProcessKey, count: int, now: float) -> bool:
        """Set the bytes of a process. Returns False, without a change, if the GPU lacks them."""
        before = self.held.get(process, 0)
        if count > before and self.used(now) + count - before > self.plan.total_bytes:
            return False
        if count < before and self.plan.release_lag_s:
            self._late.append((now + self.plan.release_lag_s, process, before - count))
        if count:
            self.held[process] = count
        else:
            self.held.pop(process, None)
        self.peak_bytes = max(self.peak_bytes, self.used(now))
        return True

    def others(self, now: float) -> list[tuple[str, int]]:
        """Return the processes without a lease, by their newest entry."""
        newest = {name: count for since, name, count in self.plan.others if since <= now - START_S}
        return [(name, count) for name, count in newest.items() if count]

    def shown(self, now: float) -> dict[ProcessKey, int]:
        self._late = [item for item in self._late if item[0] > now]
        seen = dict(self.held)
        for _, process, count in self._late:
            seen[process] = seen.get(process, 0) + count
        return seen

    def used(self, now: float) -> int:
        others = sum(count for _, count in self.others(now))
        return sum(self.shown(now).values()) + others + self.plan.overhead_bytes

    def read(self, now: float) -> MemorySampled:
        seen = [
            ProcessUse(process, self.names[process], count)
            for process, count in sorted(self.shown(now).items())
        ]
        seen += [
            ProcessUse(ProcessKey(STOWAWAYS_PID + number, 1), name, count)
            for number, (name, count) in enumerate(self.others(now))
        ]
        used = min(self.plan.total_bytes, self.used(now))
        return MemorySampled(self.plan.info.id, now, used, self.plan.total_bytes, tuple(seen))
