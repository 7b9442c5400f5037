"""Queues and workers of the rules.

Each rule has a queue and workers of its own, so a slow rule delays no other. A full queue drops its
oldest event and counts it; the next delivery of the rule carries the count.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from vram_arbiter.clients.hooks.events import Delivery, matched
from vram_arbiter.clients.hooks.state import Saved
from vram_arbiter.schemas.config.hooks import Hook
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonMap

log = logging.getLogger(__name__)

SAVE_EVERY_S: Final = 0.2
STOP_S: Final = 5.0
"""How long running deliveries may go on at a stop; they are repeated at the next start."""

type Act = Callable[[Hook, Delivery], Awaitable[None]]


@dataclass(slots=True)
class Counts:
    """Deliveries of a rule since the start."""

    done: int = 0
    failed: int = 0
    dropped: int = 0

    def __str__(self) -> str:
        return f"{self.done} done, {self.failed} failed, {self.dropped} dropped"


@dataclass(slots=True)
class Line:
    """One rule, what waits for it, and what runs."""

    hook: Hook
    waiting: deque[Delivery] = field(default_factory=deque)
    running: list[Delivery] = field(default_factory=list)
    counts: Counts = field(default_factory=Counts)
    lost: int = 0  # dropped since the last delivery began
    arrived: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, delivery: Delivery) -> None:
        self.waiting.append(delivery)
        while len(self.waiting) > self.hook.queue_max:
            self.lost += 1 + self.waiting.popleft().dropped
            self.counts.dropped += 1
            if self.lost == 1:
                log.warning("%s: its queue is full, the oldest events are dropped", self.hook.name)
        self.arrived.set()

    async def take(self) -> Delivery:
        while not self.waiting:
            self.arrived.clear()
            await self.arrived.wait()
        first = self.waiting.popleft()
        delivery = replace(first, dropped=first.dropped + self.lost)
        self.lost = 0
        self.running.append(delivery)
        return delivery


class Runner:
    """Delivers events to rules. `act` performs one delivery, and raises VramError if it failed."""

    def __init__(self, hooks: Sequence[Hook], act: Act, pending: Sequence[Delivery] = ()) -> None:
        self.lines = {hook.name: Line(hook) for hook in hooks}
        self._act = act
        self._changed = asyncio.Event()
        self._busy: set[asyncio.Task[None]] = set()
        self._stopping = False
        for delivery in pending:
            if line := self.lines.get(delivery.rule):
                line.put(delivery)
            else:
                log.warning("%s: unknown hook, its delivery is dropped", delivery.rule)

    def put(self, events: Sequence[JsonMap], numbering: str) -> None:
        """Queue events for every rule that they match."""
        for event in events:
            for line in self.lines.values():
                if on := matched(line.hook, event):
                    key = f"{numbering}-{event['seq']}-{line.hook.name}"
                    line.put(Delivery(line.hook.name, on, event, key))
        self._changed.set()

    @property
    def pending(self) -> tuple[Delivery, ...]:
        """What did not end: running deliveries first, in the order of the events."""
        return tuple(one for line in self.lines.values() for one in (*line.running, *line.waiting))

    async def run(self) -> None:
        """Work until canceled; then give running deliveries `STOP_S` to end."""
        workers = [
            asyncio.create_task(self._work(line), name=line.hook.name)
            for line in self.lines.values()
            for _ in range(line.hook.concurrency)
        ]
        try:
            ended, _ = await asyncio.wait(workers, return_when=asyncio.FIRST_EXCEPTION)
            for worker in ended:
                worker.result()  # a defect in one ends them all
        finally:
            self._stopping = True
            for worker in workers:
                if worker not in self._busy:
                    worker.cancel()
            if self._busy:
                await asyncio.wait(self._busy, timeout=STOP_S)
            for worker in workers:
                worker.cancel()
            await asyncio.gather(*workers, return_exceptions=True)

    async def _work(self, line: Line) -> None:
        this = asyncio.current_task()
        assert this is not None
        while not self._stopping:
            delivery = await line.take()
            self._busy.add(this)
            await self._deliver(line, delivery)
            self._busy.discard(this)

    async def _deliver(self, line: Line, delivery: Delivery) -> None:
        what = f"{delivery.rule}: event {delivery.event['seq']} ({delivery.on})"
        try:
            await self._act(line.hook, delivery)
        except VramError as error:
            line.counts.failed += 1
            log.warning("%s: %s", what, error)
        else:
            line.counts.done += 1
            log.info("%s: done", what)
        line.running.remove(delivery)  # not if canceled: then it is repeated
        self._changed.set()

    async def keep(self, save: Callable[[Saved], None], read: Callable[[], Saved]) -> None:
        """Save what changed, at most every `SAVE_EVERY_S`, until canceled."""
        failing, saved = "", None
        while True:
            await self._changed.wait()
            self._changed.clear()
            now = read()
            try:
                if now != saved:
                    save(now)
                failing, saved = "", now
            except OSError as error:
                if str(error) != failing:
                    failing = str(error)
                    log.error("what was delivered cannot be saved: %s", error)
                self._changed.set()
            await asyncio.sleep(SAVE_EVERY_S)
