"""Live events of the open pages: the status as it is now, and what has happened since the last.

The program calls `publish` with each status that it reads: soon after an event, and every second
while a page is open, so that each page knows that the daemon lives. When the arbiter is lost the
pages end, and connect again. Without a page nothing is made.
"""

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from dataclasses import replace
from heapq import nsmallest
from typing import Protocol

from vram_arbiter.clients.observer.page.messages import WaitsMessage
from vram_arbiter.clients.observer.page.usage import UsageRecord
from vram_arbiter.clients.observer.present import ASK_S, Look
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.explained import Explanation, WhyReply
from vram_arbiter.schemas.wire.notes import DAEMON_KINDS, NOTES
from vram_arbiter.schemas.wire.replies import HistoryReply, StatusReply

FEW_LEASES = 100
"""In one message."""
WAITS_MAX = 12
"""Requests that are explained: each costs the arbiter a search for victims."""
EVENTS_MAX = 200
"""Events of the history in one message."""
RECENT_EVENTS, USES_MAX = 2000, 50
"""A new page gets its events from these many, which the daemon's memory holds; of uses fewer."""
UNREAD_MAX_BYTES = 2 * 1024 * 1024
"""Of events that a page has not taken: one that is slower is dropped, and connects again."""
USE_KINDS = ("use_began", "use_ended")
_TOLD_KINDS = tuple(kind for kind in (*NOTES, *DAEMON_KINDS) if kind not in USE_KINDS)


class PageSource(Protocol):
    """The part of `AsyncClient` that a feed needs."""

    def why(self, consumer: str) -> Awaitable[WhyReply]: ...

    def history(
        self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()
    ) -> Awaitable[HistoryReply]: ...


class PageReader:
    """An open page: events that it has not taken yet."""

    def __init__(self, abort: Callable[[], None], left: Callable[["PageReader"], None]) -> None:
        self._abort = abort
        self._left = left
        self._unread: deque[bytes] = deque()
        self._arrived = asyncio.Event()
        self._ended = False
        self.told = False
        """It has its snapshot."""

    def send(self, data: bytes) -> bool:
        """Queue events. False: the page has not taken what it was sent, and is dropped."""
        if len(data) + sum(map(len, self._unread)) > UNREAD_MAX_BYTES:
            self.end()
            self._abort()
            return False
        self._unread.append(data)
        self._arrived.set()
        return True

    def end(self) -> None:
        self._ended = True
        self._arrived.set()

    async def chunks(self) -> AsyncIterator[bytes]:
        try:
            while not self._ended:
                while self._unread:
                    yield self._unread.popleft()
                self._arrived.clear()
                if not self._ended:
                    await self._arrived.wait()
        finally:
            self._left(self)


class PageFeed:
    """`join` of pages; `happened` with new events, then `publish` with a status."""

    def __init__(self, arbiter: PageSource, record: UsageRecord, asked: Callable[[], None]) -> None:
        """`asked`: called when a page waits for its snapshot."""
        self._arbiter = arbiter
        self._record = record
        self._asked = asked
        self._readers: dict[PageReader, None] = {}
        self._events: deque[JsonMap] = deque(maxlen=EVENTS_MAX)  # since the last message
        self._usage_number = 0  # of the usage that the pages have
        self._epoch: int | None = None

    def join(self, abort: Callable[[], None]) -> PageReader:
        reader = PageReader(abort, lambda gone: self._readers.pop(gone, None))
        self._readers[reader] = None
        self._asked()
        return reader

    @property
    def read(self) -> bool:
        """Whether a page is open."""
        return bool(self._readers)

    def happened(self, events: Iterable[JsonMap]) -> None:
        if self._readers:
            self._events.extend(events)

    def lost(self) -> None:
        """End all pages: they connect again, and begin anew."""
        for reader in list(self._readers):
            reader.end()
        self._readers.clear()

    async def publish(self, look: Look) -> None:
        """Send the status to all pages, with the past to new ones. Where the arbiter does not
        answer in time all pages begin anew, as they missed something."""
        try:
            async with asyncio.timeout(ASK_S):
                await self._publish(look)
        except (VramError, TimeoutError):
            self.lost()

    async def _publish(self, look: Look) -> None:
        if look.status.epoch != self._epoch:  # the times of another start are none of its time
            self._epoch = look.status.epoch
            for reader in [reader for reader in self._readers if reader.told]:
                reader.end()
                self._readers.pop(reader, None)
        joining = [reader for reader in self._readers if not reader.told]
        others = [reader for reader in self._readers if reader.told]
        if not self._readers:
            return
        for reader in joining:
            reader.told = True
        events = list(self._events)
        self._events.clear()
        waits = _event("waits", WaitsMessage(await self._waits(look.status)))
        now = [*_pages(look.status), waits]
        number, self._usage_number = self._usage_number, self._record.number
        if joining:  # what comes meanwhile it gets twice, and drops by its number
            self._tell(joining, b"".join([*now, *await self._past(look)]))
        parts = list(now)
        if number != self._usage_number:
            parts.append(_event("usage", self._record.since(number, look.origin)))
        if events:
            reply = HistoryReply(tuple(events), events[-1]["seq"])
            parts.append(_event("history", reply))
        self._tell(others, b"".join(parts))

    async def _waits(self, status: StatusReply) -> tuple[Explanation, ...]:
        """Explain the first requests."""
        queued = [lease for lease in status.leases if lease.state == "queued"]
        first = nsmallest(WAITS_MAX, queued, key=lambda lease: (lease.position, lease.lease_id))
        replies = await asyncio.gather(*(self._arbiter.why(lease.lease_id) for lease in first))
        return tuple(one for reply in replies for one in reply.leases)

    async def _past(self, look: Look) -> Sequence[bytes]:
        """Return what a new page learns of the time before."""
        usage = _event("usage", self._record.since(0, look.origin))
        last_seq = (await self._arbiter.history(0, 1)).last_seq
        told = await self._recent(last_seq, RECENT_EVENTS, _TOLD_KINDS)
        uses = await self._recent(last_seq, USES_MAX, USE_KINDS)
        return usage, _event("history", told), _event("history", uses)

    async def _recent(self, last_seq: int, count: int, kinds: Sequence[str]) -> HistoryReply:
        reply = await self._arbiter.history(max(0, last_seq - count), count, kinds)
        return replace(reply, events=reply.events[-EVENTS_MAX:])

    def _tell(self, readers: Sequence[PageReader], data: bytes) -> None:
        for reader in readers:
            if reader in self._readers and not reader.send(data):
                self._readers.pop(reader, None)


def _pages(status: StatusReply) -> list[bytes]:
    """Return a whole status, some leases a message."""
    found = []
    for start in range(0, max(1, len(status.leases)), FEW_LEASES):
        leases, demands = status.leases[start : start + FEW_LEASES], () if start else status.demands
        some = replace(status, leases=leases, demands=demands, daemon=None)
        found.append(_event("page" if start else "snapshot", some))
    return found


def _event(name: str, message: object) -> bytes:
    """One server-sent event: JSON has no line ends of its own."""
    text = json.dumps(to_map(message), separators=(",", ":"), default=str)
    return f"event: {name}\ndata: {text}\n\n".encode()
