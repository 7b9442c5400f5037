"""Live events of the open pages: a snapshot for each new page, then what changed, to all of them.

While a page is open, one task compares the leases with what the pages have. It runs soon after an
event, at most every GAP_S, and then looks at the leases that the event is about; every BEAT_S it
looks at all of them, a page of the status at a time, so that other work of the loop goes in
between. Each page hears of every beat and so knows that the daemon lives. Without a page there is
no task, no timer and no state.
"""

import asyncio
import json
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from heapq import nsmallest
from typing import Protocol, Self

from vram_arbiter.arbiter.http.messages import Change, Usage, Waits
from vram_arbiter.schemas.codec import encoders, to_map
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.wire.explained import Explanation, WhyReply
from vram_arbiter.schemas.wire.notes import DAEMON_KINDS, NOTES
from vram_arbiter.schemas.wire.replies import HistoryReply, StatusReply
from vram_arbiter.schemas.wire.views import LeaseView

log = logging.getLogger(__name__)

GAP_S = 0.06
BEAT_S = 1.0
FEW_LEASES = 100
"""So many are all looked at each time."""
READ_EVERY_BEATS = 5
"""The GPUs are read so often while a page is open, if nothing else reads them."""
PAGES_MAX = 10
"""Pages of the status: leases beyond are counted and not listed."""
WAITS_MAX = 12
"""Requests that are explained: each costs a search for victims."""
EVENTS_MAX = 200
"""Events of the history in one message."""
RECENT_EVENTS, USES_MAX = 2000, 50
"""A new page gets its events from these many, which memory holds; of uses fewer."""
USE_KINDS = ("use_began", "use_ended")
_TOLD_KINDS = tuple(kind for kind in (*NOTES, *DAEMON_KINDS) if kind not in USE_KINDS)

type PageKey = tuple[int, float, int]

_RUNNING = ("since_s", "waited_s", "granted_s", "ttl_left_s")
"""Fields of a lease that change with time alone: the page counts on by itself."""


class Reader(Protocol):
    """An open page."""

    def send(self, data: bytes) -> bool:
        """Send events. False: it is gone."""
        ...

    def abort(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Sources:
    """What the feed reads of the daemon, in words already."""

    status: Callable[[PageKey | None], StatusReply]
    leases: Callable[[Iterable[LeaseId]], StatusReply]
    why: Callable[[str], WhyReply]
    when_read: Callable[[Callable[[], None]], None]
    usage: Callable[[int], Usage]
    usage_number: Callable[[], int]
    history: Callable[[int, int, tuple[str, ...], Callable[[HistoryReply], None]], None]
    last_seq: Callable[[], int]


@dataclass(slots=True)
class _Difference:
    """Leases that the pages have otherwise."""

    rows: dict[str, JsonObject] = field(default_factory=dict)  # all that were looked at
    leases: list[LeaseView] = field(default_factory=list)
    moved: dict[str, int] = field(default_factory=dict)
    gone: tuple[str, ...] = ()

    def add(self, more: Self) -> None:
        self.rows.update(more.rows)
        self.leases += more.leases
        self.moved.update(more.moved)


class Feed:
    """`join` and `leave` of pages; `changed` after each event of the engine that said something."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources
        self._readers: dict[Reader, bool] = {}  # True: it has its snapshot
        self._task: asyncio.Task[None] | None = None
        self._dirty = asyncio.Event()
        # what the pages have
        self._rows: dict[str, JsonObject] = {}
        self._touched: set[LeaseId] = set()  # by events since the last look
        self._looked_at = float("-inf")  # when all leases were looked at
        self._usage_number = 0
        self._seq = 0
        encoders(StatusReply, Change, Waits, Usage, HistoryReply)

    def join(self, reader: Reader) -> None:
        self._readers[reader] = False
        self._sources.when_read(self.changed)
        self._dirty.set()
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._serve())

    def leave(self, reader: Reader) -> None:
        if self._readers.pop(reader, None) is not None and not self._readers:
            self._end()

    @property
    def read(self) -> bool:
        """Whether a page is open."""
        return self._task is not None

    def changed(self, leases: Iterable[LeaseId] = ()) -> None:
        """Something changed, of these leases among others."""
        if self._task is not None:
            self._touched.update(leases)
            self._dirty.set()

    def close(self) -> None:
        """Send nothing more."""
        self._readers.clear()
        self._end()

    def _end(self) -> None:
        if self._task is not None:
            self._task.cancel()
        self._task, self._rows = None, {}
        self._touched.clear()

    async def _serve(self) -> None:
        beats = 0
        try:
            while True:
                self._dirty.clear()
                await self._publish()
                await asyncio.sleep(GAP_S)
                try:
                    async with asyncio.timeout(BEAT_S - GAP_S):
                        await self._dirty.wait()
                except TimeoutError:
                    beats += 1
                    if beats % READ_EVERY_BEATS == 0:
                        self._sources.when_read(self.changed)
        except Exception:  # a defect of the page ends its pages, never the daemon
            log.exception("http: the page's events cannot be made")
            self._task = None
            for reader in list(self._readers):
                reader.abort()

    async def _publish(self) -> None:
        """Compare with what the pages have; send a snapshot to the new ones, changes to others."""
        joining = [reader for reader, told in self._readers.items() if not told]
        others = [reader for reader, told in self._readers.items() if told]
        for reader in joining:
            self._readers[reader] = True
        now, touched = time.monotonic(), list(self._touched)
        self._touched.clear()
        few = len(self._rows) <= FEW_LEASES or len(touched) > FEW_LEASES
        due_s = 2 * BEAT_S if touched else BEAT_S  # an event is told first
        whole = bool(joining) or few or now - self._looked_at >= due_s
        snapshot: list[bytes] = []
        if whole:
            self._looked_at = now
            status, change = await self._look_at_all(snapshot if joining else None)
        else:
            status = self._sources.leases(touched)
            change = self._difference(status.leases)
            change.gone = tuple(set(touched) - {lease.lease_id for lease in status.leases})
            self._rows.update(change.rows)
            for lease_id in change.gone:
                self._rows.pop(lease_id, None)
        waits = _event("waits", Waits(await self._waits(status)))
        seq, number = self._seq, self._usage_number
        self._seq, self._usage_number = self._sources.last_seq(), self._sources.usage_number()
        if joining:  # what comes meanwhile it gets twice, and drops by its number
            self._tell(joining, b"".join([*snapshot, waits, *await self._past()]))
        if not others:
            return
        parts: list[bytes] = []
        for start in range(0, max(1, len(change.leases)), FEW_LEASES):
            some = change.leases[start : start + FEW_LEASES]
            shown = replace(status, leases=tuple(some), next=None)
            told = Change(shown) if start else Change(shown, change.gone, change.moved)
            parts.append(_event("change", told))
            await asyncio.sleep(0)
        parts.append(waits)
        if number != self._usage_number:
            parts.append(_event("usage", self._sources.usage(number)))
        if seq != self._seq:
            events = await self._events(max(seq, self._seq - EVENTS_MAX))
            parts.append(_event("history", events))
        self._tell(others, b"".join(parts))

    async def _look_at_all(self, snapshot: list[bytes] | None) -> tuple[StatusReply, "_Difference"]:
        """Return the first page of the status, and what changed in all of them; add the pages'
        events to `snapshot`."""
        found, first = _Difference(), None
        async for page in self._pages():
            if snapshot is not None:
                snapshot.append(_event("snapshot" if first is None else "page", page))
                await asyncio.sleep(0)
            first = first or page
            found.add(self._difference(page.leases))
        assert first is not None
        found.gone = tuple(self._rows.keys() - found.rows.keys())
        self._rows = found.rows
        return first, found

    def _difference(self, leases: Iterable[LeaseView]) -> "_Difference":
        """Compare some leases with what the pages have."""
        found = _Difference()
        for lease in leases:
            row = found.rows[lease.lease_id] = _steady(lease)
            old, position = self._rows.get(lease.lease_id), lease.position
            if old == row:
                continue
            if old and position is not None and {**old, "position": position} == row:
                found.moved[lease.lease_id] = position
            else:
                found.leases.append(lease)
        return found

    async def _pages(self) -> AsyncIterator[StatusReply]:
        after: PageKey | None = None
        for _ in range(PAGES_MAX):
            page = self._sources.status(after)
            yield page
            after = page.next
            if after is None:
                return
            await asyncio.sleep(0)

    async def _waits(self, status: StatusReply) -> tuple[Explanation, ...]:
        """Explain the first requests, one in each turn of the loop."""
        if not status.totals.waiting:
            return ()
        places = (
            (row.get("position", 0), lease_id)
            for lease_id, row in self._rows.items()
            if row["state"] == "queued"
        )
        found: list[Explanation] = []
        for _, lease_id in nsmallest(WAITS_MAX, places):
            found += self._sources.why(lease_id).leases
            await asyncio.sleep(0)
        return tuple(found)

    async def _past(self) -> Sequence[bytes]:
        """Return what a new page learns of the minutes before."""
        usage = _event("usage", self._sources.usage(0))
        await asyncio.sleep(0)
        last_seq = self._sources.last_seq()
        told = await self._events(max(0, last_seq - RECENT_EVENTS), RECENT_EVENTS, _TOLD_KINDS)
        uses = await self._events(max(0, last_seq - USES_MAX), USES_MAX, USE_KINDS)
        return usage, _event("history", told), _event("history", uses)

    async def _events(
        self, after: int, limit: int = EVENTS_MAX, kinds: tuple[str, ...] = ()
    ) -> HistoryReply:
        found: asyncio.Future[HistoryReply] = asyncio.get_running_loop().create_future()

        def done(reply: HistoryReply) -> None:
            if not found.done():
                found.set_result(reply)

        self._sources.history(after, limit, kinds, done)
        reply = await found
        return replace(reply, events=reply.events[-EVENTS_MAX:])

    def _tell(self, readers: Sequence[Reader], data: bytes) -> None:
        for reader in readers:
            if reader in self._readers and not reader.send(data):
                self._readers.pop(reader, None)
        if not self._readers:
            self._end()


def _steady(lease: LeaseView) -> JsonObject:
    """Return what a page knows of a lease, but for what changes with time alone."""
    row = to_map(lease)
    for name in _RUNNING:
        row.pop(name, None)
    return row


def _event(name: str, message: object) -> bytes:
    """One server-sent event: JSON has no line ends of its own."""
    text = json.dumps(to_map(message), separators=(",", ":"), default=str)
    return f"event: {name}\ndata: {text}\n\n".encode()
