"""Discrete-event simulation: consumers, one GPU with late returns, and a scheduler.

The scheduler is the engine, or rules of other programs. Everything that takes time is an entry in
one heap; the same scenario and scheduler give the same outcome. No clock, no threads, no randomness
(that is in the scenario).
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Protocol

from tests.bench.policies.actors import START_S, Actor
from tests.bench.policies.outcome import Outcome
from tests.bench.policies.scenarios import Scenario, plans_of
from vram_arbiter.arbiter.core.effects import Effect, Push, Refuse, Reply, Sample
from vram_arbiter.arbiter.core.events import Event, MemorySampled, ProcessUse, Tick
from vram_arbiter.schemas.ids import ClientId, ProcessKey, RequestId
from vram_arbiter.schemas.sizes import parse_bytes

READING_S = 0.001
"""Duration of a reading."""
EVENTS_MAX = 5_000_000
"""Most steps of a run; one that needs more does not end."""
STOWAWAYS_PID = 900_000


class Scheduler(Protocol):
    """Interface of a scheduler: the engine, or a port of another program's rules."""

    def handle(self, event: Event, now: float) -> Sequence[Effect]: ...

    def next_deadline(self) -> float | None: ...


class Circling(Exception):
    """The simulation does not end."""


@dataclass(slots=True)
class SimulatedGpu:
    """Bytes on the GPU.

    Bytes that are given up show until the lag is over; an allocation that does not fit is refused.
    """

    scenario: Scenario
    held: dict[ProcessKey, int] = field(default_factory=dict)
    names: dict[ProcessKey, str] = field(default_factory=dict)
    peak_bytes: int = 0
    _late: list[tuple[float, ProcessKey, int]] = field(default_factory=list)

    def set(self, process: ProcessKey, count: int, now: float) -> bool:
        """Set the bytes of a process. Returns False, without a change, if the GPU lacks them."""
        before, total = self.held.get(process, 0), self.scenario.gpu.capacity_bytes
        if count > before and self.used(now) + count - before > total:
            return False
        if count < before and self.scenario.release_lag_s:
            self._late.append((now + self.scenario.release_lag_s, process, before - count))
        self.held[process] = count
        self.peak_bytes = max(self.peak_bytes, self.used(now))
        return True

    def used(self, now: float) -> int:
        """Return all bytes in use, the driver's and the stowaways' included."""
        return sum(self._shown(now).values()) + parse_bytes(self.scenario.overhead)

    def read(self, now: float) -> MemorySampled:
        """Return a reading that begins now."""
        shown = sorted((process, count) for process, count in self._shown(now).items() if count)
        uses = tuple(ProcessUse(process, self.names[process], count) for process, count in shown)
        gpu = self.scenario.gpu
        used = min(gpu.capacity_bytes, self.used(now))
        return MemorySampled(gpu.id, now, used, gpu.capacity_bytes, uses)

    def _shown(self, now: float) -> dict[ProcessKey, int]:
        self._late = [item for item in self._late if item[0] > now]
        seen = dict(self.held)
        for _, process, count in self._late:
            seen[process] = seen.get(process, 0) + count
        for number, one in enumerate(self.scenario.stowaways):
            if one.from_s <= now - START_S < (one.to_s or self.scenario.seconds):
                process = ProcessKey(STOWAWAYS_PID + number, 1)
                self.names[process] = one.name
                seen[process] = parse_bytes(one.size)
        return seen


class World:
    """Time, the GPU and the consumers of one run."""

    def __init__(
        self, scenario: Scenario, scheduler: Scheduler, policy: str, *, holders_exit: bool
    ) -> None:
        self.scheduler = scheduler
        self.holders_exit = holders_exit
        self.outcome = Outcome(policy, scenario.seconds)
        self.now = START_S
        self.gpu = SimulatedGpu(scenario)
        self.actors: dict[ClientId, Actor] = {}
        self._end = START_S + scenario.seconds
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._requests = 0
        self._reading = False
        self._posting: deque[Event] = deque()
        self._busy = False
        plans = plans_of(scenario)
        for number, plan in enumerate(plans):
            actor = Actor(self, plan, number, self.outcome.of(plan.consumer))
            self.actors[actor.client] = actor
        by_name = {actor.consumer: actor for actor in self.actors.values()}
        for plan in plans:
            followers = [(by_name[follower.consumer], jobs) for follower, jobs in plan.followers]
            by_name[plan.consumer].followers = followers

    # -- time
    def at(self, when: float, call: Callable[[], None]) -> None:
        """Plan a call."""
        self._count += 1
        heappush(self._heap, (when, self._count, call))

    def run(self) -> Outcome:
        """Run to the end. Raises Circling for a run without one."""
        self.post(Tick())
        for actor in self.actors.values():
            actor.begin()
        for _ in range(EVENTS_MAX):
            planned = self._heap[0][0] if self._heap else None
            deadline = self.scheduler.next_deadline()
            if deadline is not None and (planned is None or deadline < planned):
                if deadline > self._end:
                    break
                self.now = max(self.now, deadline)
                self.post(Tick())
                continue
            if planned is None or planned > self._end:
                break
            self.now = max(self.now, planned)
            heappop(self._heap)[2]()
        else:
            raise Circling(f"more than {EVENTS_MAX} steps within {self.outcome.seconds:g} s")
        self.now = self._end
        for actor in self.actors.values():
            actor.finish()
        self.outcome.peak_bytes = self.gpu.peak_bytes
        return self.outcome

    # -- the scheduler
    def post(self, event: Event) -> None:
        """Pass an event to the scheduler; what follows from its effects comes after it."""
        self._posting.append(event)
        if self._busy:
            return
        self._busy = True
        while self._posting:
            effects = self.scheduler.handle(self._posting.popleft(), self.now)
            self.outcome.watch(self.now - START_S, effects)
            for effect in effects:
                self._perform(effect)
        self._busy = False

    def _perform(self, effect: Effect) -> None:
        match effect:
            case Reply(client, request, body):
                self.actors[client].answered(request, getattr(body, "lease", None))
            case Refuse(client, request):
                self.actors[client].refused(request)
            case Push(client, body):
                self.actors[client].told(body)
            case Sample() if not self._reading:
                self._reading = True
                sample = self.gpu.read(self.now)
                self.at(self.now + READING_S, lambda: self._read(sample))
            case _:
                pass

    def _read(self, sample: MemorySampled) -> None:
        self._reading = False
        self.post(sample)

    def next_request(self) -> RequestId:
        """Return the id of the next request."""
        self._requests += 1
        return RequestId(self._requests)
