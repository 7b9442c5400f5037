"""The arbiter as `vramctl top` sees it: status, events, and an operator's orders.

What it costs the daemon: one status every HEARTBEAT_S, at most one every LEAST_S while events come,
and never more than a fifth of the time. An order opens a connection of its own as operator, as
`vramctl evict` does; the view itself is an observer.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from vram_arbiter.clients.cli import text
from vram_arbiter.clients.cli.top.gpus import Samples
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.errors import NotPermitted, VramError
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import REQUESTS, Ping, Request

HEARTBEAT_S = 2.0
"""Between two readings of the status while nothing happens."""
LEAST_S = 0.25
"""Between two readings of the status while events come."""
SHARE = 4.0
"""A status that took a second is asked for again after so many seconds at the earliest."""
SILENT_S = 1.5
"""A status that takes longer counts as no answer until it comes."""
AGAIN_S = 10.0
"""Between two attempts to subscribe after a refusal."""
EVENTS_KEPT = 50
EARLIER = 20
"""Events from before its start."""
DATE_CHARS = len("2026-01-31 ")
"""Of an event's line: the date of a live view is no news."""


@dataclass(frozen=True, slots=True)
class Order:
    """An operator's action, as `vramctl ACTION` sends it. `target`: a lease; "" for drain and
    resume."""

    action: str
    target: str = ""
    reason: str = ""


@dataclass(slots=True)
class Feed:
    """What is known of the arbiter now. `changed` is called after each change."""

    client: AsyncClient
    changed: Callable[[], None] = lambda: None
    status: StatusReply | None = None
    samples: dict[str, Samples] = field(default_factory=dict)
    events: deque[str] = field(default_factory=lambda: deque(maxlen=EVENTS_KEPT))
    answered_at: float = field(default_factory=time.monotonic)  # newest sign of life
    refusal: str | None = None
    """Why this user is not an operator, as the arbiter says it; "": an operator; None: unknown."""
    _happened: asyncio.Event = field(default_factory=asyncio.Event)
    _asked_at: float | None = None  # of the status that is under way

    @property
    def lost_s(self) -> float | None:
        """Seconds without the arbiter; None while it answers."""
        now = time.monotonic()
        silent = self._asked_at is not None and now - self._asked_at > SILENT_S
        return now - self.answered_at if silent or not self.client.connected else None

    async def run(self) -> None:
        """Follow the arbiter, across its restarts, until canceled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow())
            tasks.create_task(self._poll())

    async def _follow(self) -> None:
        with contextlib.suppress(VramError):  # an older arbiter, or one that is away
            newest = (await self.client.history(limit=1)).last_seq
            earlier = await self.client.history(after=max(0, newest - EARLIER))
            self._tell(*earlier.events)
        while True:
            try:
                async for event in self.client.subscribe():
                    self._tell(event)
                    self._happened.set()
            except VramError as error:  # too many subscribers: the status goes on without events
                self.events.append(f"no events: {_said(error.to_wire())}")
                await asyncio.sleep(AGAIN_S)

    def _tell(self, *events: JsonMap) -> None:
        self.events.extend(_line(event) for event in events if not text.is_quiet(event))

    async def _poll(self) -> None:
        while True:
            self._happened.clear()
            took_s = await self._look() if self.client.connected else 0.0
            self.changed()
            await asyncio.sleep(max(LEAST_S, SHARE * min(took_s, HEARTBEAT_S)))
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._happened.wait(), HEARTBEAT_S - LEAST_S)

    async def _look(self) -> float:
        """Take a status, and return how long that took. Where contact is lost meanwhile, what was
        known stays."""
        if self.refusal is None:
            await self._learn_role()
        began = self._asked_at = time.monotonic()
        try:
            status = await self.client.status(details=True)
        except VramError:
            self.refusal = None  # the next arbiter may name another group
            return 0.0
        finally:
            self._asked_at = None
        self.status, self.answered_at = status, time.monotonic()
        for gpu in status.gpus:
            known = self.samples.setdefault(gpu.gpu, Samples())
            known.add(self.answered_at, gpu.measured_used_bytes)
        return self.answered_at - began

    # -- orders
    async def _learn_role(self) -> None:
        """Ask whether this user may operate: the hello as operator is answered by that."""
        with contextlib.suppress(VramError):
            reply = await self._ask(Ping())
            if reply.get("ok"):
                self.refusal = ""
            elif reply["error"]["code"] == NotPermitted.code:
                self.refusal = _said(reply["error"])

    async def order(self, order: Order) -> tuple[bool, str]:
        """Have the arbiter follow an order. Returns whether it did, and what it says."""
        target = (order.target,) if order.target else ()
        try:
            reply = await self._ask(REQUESTS[order.action](order.reason, *target))
        except VramError as error:
            return False, str(error)
        self._happened.set()
        if not reply.get("ok"):
            return False, _said(reply["error"])
        return True, " ".join(text.by_hand_lines(order.action, reply))

    async def _ask(self, request: Request[Any]) -> Message:
        question = partial(ask, request, self.client.endpoint, role="operator")
        return await asyncio.to_thread(question)


def _line(event: JsonMap) -> str:
    return text.event_line(event)[DATE_CHARS:]


def _said(error: JsonMap) -> str:
    """Return an error of the arbiter with its hint."""
    return text.error_line(error).removeprefix("vramctl: ")
