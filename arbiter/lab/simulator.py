"""Discrete-event simulation: consumers, GPUs with late returns, and a scheduler.

The scheduler is the engine, or rules of other programs. Everything that takes time is an entry in
one heap; the same workload and scheduler give the same outcome. No clock, no threads, no randomness
(that is in the workload).
"""

from collections import deque
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Protocol

from vram_arbiter.arbiter.core.effects import Effect, Push, Refuse, Reply, Sample
from vram_arbiter.arbiter.core.events import Event, MemorySampled, Tick
from vram_arbiter.arbiter.lab.actors import Actor
from vram_arbiter.arbiter.lab.gpu import START_S, SimulatedGpu
from vram_arbiter.arbiter.lab.outcome import Outcome
from vram_arbiter.arbiter.lab.workload import Workload
from vram_arbiter.schemas.ids import ClientId, GpuId, RequestId

READING_S = 0.001
"""Duration of a reading."""
EVENTS_MAX = 5_000_000
"""Most steps of a run; one that needs more does not end."""


class Scheduler(Protocol):
    """Interface of a scheduler: the engine, or a port of another program's rules."""

    def handle(self, event: Event, now: float) -> Sequence[Effect]: ...

    def next_deadline(self) -> float | None: ...


class Circling(Exception):
    """The simulation does not end."""


def simulate(
    workload: Workload, scheduler: Scheduler, policy: str, *, holders_exit: bool = False
) -> Outcome:
    """Run a simulation to its end. `holders_exit`: models are processes that end when they are
    unloaded, so nothing stays on the GPU. Raises Circling for one that has no end."""
    world = _World(workload, scheduler, Outcome(policy, workload.seconds), holders_exit)
    world.run()
    return world.outcome


class _World:
    """Time, GPUs and consumers of one run."""

    def __init__(
        self, workload: Workload, scheduler: Scheduler, outcome: Outcome, holders_exit: bool
    ) -> None:
        self.scheduler = scheduler
        self.holders_exit = holders_exit
        self.outcome = outcome
        self.now = START_S
        self.gpus = {plan.info.id: SimulatedGpu(plan) for plan in workload.gpus}
        self.actors: dict[ClientId, Actor] = {}
        self._end = START_S + workload.seconds
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._requests = 0
        self._reading: set[GpuId] = set()
        self._posting: deque[Event] = deque()
        self._busy = False
        by_plan: dict[int, Actor] = {}
        for number, plan in enumerate(workload.plans):
            actor = by_plan[id(plan)] = Actor(self, plan, number, outcome.of(plan.consumer))
            self.actors[actor.client] = actor
        for plan in workload.plans:
            followers = [(by_plan[id(follower.plan)], follower.jobs) for follower in plan.followers]
            by_plan[id(plan)].followers = followers

    # -- time
    def at(self, when: float, call: Callable[[], None]) -> None:
        self._count += 1
        heappush(self._heap, (when, self._count, call))

    def run(self) -> None:
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
        self.outcome.peak_bytes = max(gpu.peak_bytes for gpu in self.gpus.values())

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
            case Sample(gpu) if gpu not in self._reading:
                self._reading.add(gpu)
                sample = self.gpus[gpu].read(self.now)
                self.at(self.now + READING_S, lambda: self._read(sample))
            case _:
                pass

    def _read(self, sample: MemorySampled) -> None:
        self._reading.discard(sample.gpu)
        self.post(sample)

    def next_request(self) -> RequestId:
        self._requests += 1
        return RequestId(self._requests)
