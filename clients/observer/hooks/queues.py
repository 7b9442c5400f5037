"""A queue and workers for each rule, and the file of what is not delivered yet."""

import asyncio
import json
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Final

from vram_arbiter.clients.cli.files import replace as replace_file
from vram_arbiter.clients.observer.hooks.events import Delivery, matched
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.codec import CodecError, from_map, to_map
from vram_arbiter.schemas.config.observer import Hook
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder

log = logging.getLogger(__name__)

FILE_MAX_CHARS: Final = 1 << 27
SAVE_EVERY_S: Final = 0.2
SAVE_AGAIN_S: Final = 10.0
"""After an attempt that failed, such as on a full disk."""

type Act = Callable[[Hook, Delivery], Awaitable[None]]


@dataclass(frozen=True, slots=True)
class Saved:
    """`read`: number of the last event that was read, by numbering; the newest numbering is last.
    `pending`: deliveries that did not end."""

    WHOLE: ClassVar = True

    read: Mapping[str, int] = field(default_factory=dict)
    pending: Sequence[Delivery] = ()


class StateFile:
    """`load` and `save`, in a folder of this user's own; one program at a time has it."""

    def __init__(self, path: Path) -> None:
        """Make the folder and lock the file. Raises ConfigError, AlreadyRunning."""
        self._path = path
        path.parent.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        private_folder(path.parent)
        self._lock = LockFile(path.with_name(f"{path.name}.lock"), str(path), "vram-observer")
        self._lock.acquire()

    def load(self) -> Saved:
        """Return what was saved last; nothing at the first start. Raises ConfigError."""
        try:
            text = self._path.read_text()
            return from_map(Saved, strictjson.loads(text, max_chars=FILE_MAX_CHARS), strict=True)
        except FileNotFoundError:
            return Saved()
        except (OSError, ValueError, CodecError) as error:
            raise ConfigError(
                f"{self._path} cannot be read: {error}",
                hint="remove it; hooks then begin with new events",
            ) from error

    def save(self, saved: Saved) -> None:
        """Replace the file. Raises OSError."""
        replace_file(self._path, json.dumps(to_map(saved)), 0o600)


@dataclass(slots=True)
class Line:
    """One rule, what waits for it, and what runs."""

    hook: Hook
    waiting: deque[Delivery] = field(default_factory=deque)
    running: list[Delivery] = field(default_factory=list)
    lost: int = 0  # dropped since the last delivery began
    arrived: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, delivery: Delivery) -> None:
        self.waiting.append(delivery)
        while len(self.waiting) > self.hook.queue_max:
            self.lost += 1 + self.waiting.popleft().dropped
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
        """Work until canceled. What is cut short then is pending, and repeated at the next
        start."""
        async with asyncio.TaskGroup() as group:
            for line in self.lines.values():
                for _ in range(line.hook.concurrency):
                    group.create_task(self._work(line), name=line.hook.name)

    async def _work(self, line: Line) -> None:
        while True:
            await self._deliver(line, await line.take())

    async def _deliver(self, line: Line, delivery: Delivery) -> None:
        what = f"{delivery.rule}: event {delivery.event['seq']} ({delivery.on})"
        try:
            await self._act(line.hook, delivery)
        except VramError as error:
            log.warning("%s: %s", what, error)
        else:
            log.info("%s: done", what)
        line.running.remove(delivery)  # not if canceled: then it is repeated
        self._changed.set()

    async def keep(self, save: Callable[[Saved], None], read: Callable[[], Saved]) -> None:
        """Save what changed, at most every `SAVE_EVERY_S`, until canceled."""
        saved = None
        while True:
            await self._changed.wait()
            self._changed.clear()
            if (now := read()) != saved:
                try:
                    save(now)
                    saved = now
                except OSError as error:
                    log.error("what was delivered cannot be saved: %s", error)
                    await asyncio.sleep(SAVE_AGAIN_S)
                    self._changed.set()
            await asyncio.sleep(SAVE_EVERY_S)
