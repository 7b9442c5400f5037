"""The simulated GPU as physics has it, and the probe through which the daemon sees it.

`Device` knows who really holds what; the arbiter never reads it. `SimProber` has the contract of
`arbiter.host.prober.Prober` and can fail, hang, lag and lie.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from tests.support.simulation.clock import Clock, ProcessLoop
from vram_arbiter.arbiter.core.events import Event, MemorySampled, ProbeFailed, ProcessUse
from vram_arbiter.schemas.ids import GpuId, ProcessKey

PROBE_DEADLINE_S = 2.0
HISTORY_S = 2.0  # how far back a lagging probe can look


class SimOutOfMemory(Exception):
    """The GPU is full."""


@dataclass(slots=True)
class Block:
    """Bytes of one process for one purpose (`tag`: a lease id, `context`, `excess`, `leak`,
    `stranger`)."""

    process: ProcessKey
    tag: str
    count: int


class Device:
    """One GPU. What is freed is shown, and cannot be used by anyone, until `lag_s` later."""

    def __init__(self, clock: Clock, gpu: GpuId, total_bytes: int, overhead_bytes: int) -> None:
        self.clock = clock
        self.gpu = gpu
        self.total_bytes = total_bytes
        self.overhead_bytes = overhead_bytes
        self.lag_s = 0.0
        self.names: dict[ProcessKey, str] = {}
        self.dead: set[ProcessKey] = set()
        self.held: dict[tuple[ProcessKey, str], int] = {}
        self.late: list[tuple[float, ProcessKey, str, int]] = []
        self.peak_bytes = 0
        self._past: list[tuple[float, dict[ProcessKey, int]]] = []

    def allocate(self, process: ProcessKey, tag: str, count: int) -> None:
        """Raises SimOutOfMemory where the GPU has not so many bytes left."""
        free = self.total_bytes - self.used_bytes()
        if count > free:
            raise SimOutOfMemory(f"{count} wanted, {free} of {self.total_bytes} free on {self.gpu}")
        key = (process, tag)
        self.held[key] = self.held.get(key, 0) + count
        self.peak_bytes = max(self.peak_bytes, self.used_bytes())
        self._changed(f"{process} +{count} {tag}")

    def free(self, process: ProcessKey, tag: str, count: int | None = None) -> None:
        """Give back (None: all of it). Nothing there is fine."""
        key = (process, tag)
        before = self.held.get(key, 0)
        gone = before if count is None else min(count, before)
        if not gone:
            return
        if before == gone:
            del self.held[key]
        else:
            self.held[key] = before - gone
        if self.lag_s:
            lag = self.lag_s * self.clock.random.uniform(0.5, 1.0)
            self.late.append((self.clock.now + lag, process, tag, gone))
        self._changed(f"{process} -{gone} {tag}")

    def rename(self, process: ProcessKey, tag: str, to: str, count: int) -> None:
        """So many of the bytes are now there for another reason."""
        if count:
            self.held[process, tag] -= count
            if not self.held[process, tag]:
                del self.held[process, tag]
            self.held[process, to] = self.held.get((process, to), 0) + count

    def bury(self, process: ProcessKey) -> None:
        """The process is dead: the driver takes everything back, in its own time."""
        self.dead.add(process)
        for owner, tag in list(self.held):
            if owner == process:
                self.free(process, tag)

    def blocks(self) -> list[Block]:
        """Everything that occupies the GPU now, also what was freed and is not back yet."""
        found: dict[tuple[ProcessKey, str], int] = dict(self.held)
        for _, process, tag, count in self._lagging():
            found[process, tag] = found.get((process, tag), 0) + count
        return [Block(process, tag, count) for (process, tag), count in found.items()]

    def used_bytes(self) -> int:
        return (
            self.overhead_bytes + sum(self.held.values()) + sum(item[3] for item in self._lagging())
        )

    def by_process(self) -> dict[ProcessKey, int]:
        found: dict[ProcessKey, int] = {}
        for block in self.blocks():
            found[block.process] = found.get(block.process, 0) + block.count
        return found

    def by_process_at(self, when: float) -> dict[ProcessKey, int]:
        """As it was at some earlier time (no further back than `HISTORY_S`)."""
        before = [state for at, state in self._past if at <= when]
        return dict(before[-1]) if before else self.by_process()

    def _lagging(self) -> list[tuple[float, ProcessKey, str, int]]:
        if self.late and any(item[0] <= self.clock.now for item in self.late):
            self.late = [item for item in self.late if item[0] > self.clock.now]
        return self.late

    def _changed(self, what: str) -> None:
        self.clock.say(f"GPU {self.gpu}: {what}, {self.used_bytes()} used")
        now = self.clock.now
        self._past.append((now, self.by_process()))
        while len(self._past) > 1 and self._past[1][0] < now - HISTORY_S:
            del self._past[0]


@dataclass(slots=True)
class ProbeFaults:
    """How a GPU's readings go wrong. All off: honest, within a few milliseconds."""

    failing: str = ""
    hanging: bool = False
    behind_s: float = 0.0  # shows the GPU as it was
    unlisted: bool = False  # no process list
    unnamed_bytes: bool = False  # a list without bytes
    factor: float = 1.0  # > 1: says that more is used than is; < 1: less
    forgets_the_dead: bool = False  # the list leaves a dying process out before its bytes are back
    # processes that the list leaves out, the total does not
    blind_to: set[ProcessKey] = field(default_factory=set)


class SimProber:
    """Readings of all GPUs, one at a time each: idle → reading → idle, or reading → stuck."""

    def __init__(
        self,
        clock: Clock,
        loop: ProcessLoop,
        devices: dict[GpuId, Device],
        faults: dict[GpuId, ProbeFaults],
        post: Callable[[Event], None],
    ) -> None:
        self._readers = {
            gpu: _Reader(clock, loop, device, faults[gpu], post) for gpu, device in devices.items()
        }

    def sample(self, gpu: GpuId) -> None:
        self._readers[gpu].request()


class _Reader:
    def __init__(
        self,
        clock: Clock,
        loop: ProcessLoop,
        device: Device,
        faults: ProbeFaults,
        post: Callable[[Event], None],
    ) -> None:
        self._clock, self._loop, self._device, self._faults, self._post = (
            clock,
            loop,
            device,
            faults,
            post,
        )
        self._state = "idle"
        self._again = False
        self._complaining = False

    def request(self) -> None:
        if self._state == "idle":
            self._begin()
            return
        self._again = True
        if self._state == "stuck" and not self._complaining:
            self._complaining = True
            self._loop.call_later(PROBE_DEADLINE_S, self._still_stuck)

    def _begin(self) -> None:
        self._state, self._again = "reading", False
        taken_at = self._clock.now
        if self._faults.hanging:
            self._loop.call_later(PROBE_DEADLINE_S, self._expired)
            return
        took_s = self._clock.random.uniform(0.0003, 0.004)
        looks_at = taken_at + self._clock.random.random() * took_s

        def look() -> None:
            outcome = self._look(taken_at)
            self._clock.at(taken_at + took_s, lambda: self._loop.enter(lambda: self._done(outcome)))

        self._clock.at(looks_at, look)  # the reading thread does not stop with the loop

    def _look(self, taken_at: float) -> Event:
        faults, device = self._faults, self._device
        if faults.failing:
            return ProbeFailed(device.gpu, self._clock.now, faults.failing)
        seen = (
            device.by_process_at(self._clock.now - faults.behind_s)
            if faults.behind_s
            else device.by_process()
        )
        used = min(
            device.total_bytes, int((device.overhead_bytes + sum(seen.values())) * faults.factor)
        )
        processes = None
        if not faults.unlisted:
            processes = tuple(
                ProcessUse(
                    process,
                    device.names.get(process, f"p{process.pid}"),
                    None if faults.unnamed_bytes else count,
                )
                for process, count in sorted(seen.items())
                if process not in faults.blind_to
                and not (faults.forgets_the_dead and process in device.dead)
            )
        return MemorySampled(device.gpu, taken_at, used, device.total_bytes, processes)

    def _done(self, outcome: Event) -> None:
        self._state = "idle"
        self._post(outcome)
        if self._again and self._state == "idle":
            self._begin()

    def _expired(self) -> None:
        self._state = "stuck"
        self._post(ProbeFailed(self._device.gpu, self._clock.now, "no answer in time"))
        self._wait_for_return()

    def _wait_for_return(self) -> None:
        if self._faults.hanging:
            self._loop.call_later(0.2, self._wait_for_return)
            return
        self._state = "idle"
        self._begin()

    def _still_stuck(self) -> None:
        self._complaining = False
        if self._state == "stuck":
            self._post(ProbeFailed(self._device.gpu, self._clock.now, "the reading still hangs"))
