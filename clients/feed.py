"""Events of the arbiter's history, each once, across restarts of the arbiter and of the reader.

What is read is the history, after the last number that was read. The subscription only says when to
read, so an event that it lost, or that came before a reconnect, is found as well.
"""

import asyncio
import contextlib
import logging
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from typing import Final, Protocol

from vram_arbiter.schemas.errors import ArbiterUnreachable, TransientError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.replies import HistoryReply

log = logging.getLogger(__name__)

PAGE: Final = 500
NUMBERINGS_MAX: Final = 8
TICK_S: Final = 5.0
"""The history is read at least so often: after a reconnect no event may come for hours."""
PAUSE_S: Final = 0.02
"""Between two readings: a burst of events is one reading."""


class Cursor:
    """The last number that was read, for each numbering of the history.

    Where the numbers begin again (the history was deleted, or its disk failed), every event of the
    new numbering is new; one that returns goes on where it was left.
    """

    def __init__(self, read: Mapping[str, int]) -> None:
        self.read = dict(read)
        self.numbering = next(reversed(self.read), "")

    @property
    def after(self) -> int:
        return self.read.get(self.numbering, 0)

    def take(self, reply: HistoryReply) -> Sequence[JsonMap] | None:
        """Return the new events of an answer to `history` after `after`; None: ask again, the
        numbering is another one."""
        if reply.numbering != self.numbering or not self.read:
            # at the very first start: the events from now on
            known = self.read.pop(reply.numbering, 0) if self.read else reply.last_seq
            self.read[reply.numbering] = known
            self.numbering = reply.numbering
            while len(self.read) > NUMBERINGS_MAX:
                del self.read[next(iter(self.read))]
            return None
        events = [event for event in reply.events if event["seq"] > self.after]
        if events:
            self.read[self.numbering] = events[-1]["seq"]
        return events


class Source(Protocol):
    """The part of `AsyncClient` that a feed needs."""

    async def history(
        self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()
    ) -> HistoryReply: ...

    def subscribe(self) -> AsyncIterator[JsonMap]: ...


async def follow(source: Source, cursor: Cursor) -> AsyncGenerator[Sequence[JsonMap]]:
    """Yield what each reading of the history found, until closed: new events, or none.

    Events that happen after the first batch are never missed. Raises what ends the subscription.
    """
    happened = asyncio.Event()

    async def listen() -> None:
        async for _ in source.subscribe():
            happened.set()

    listening = asyncio.create_task(listen())
    silent = ""
    try:
        while True:
            happened.clear()
            events: Sequence[JsonMap] | None = ()
            try:
                reply = await source.history(cursor.after, PAGE)
                events, problem = cursor.take(reply), reply.problem
            except ArbiterUnreachable:
                problem = ""  # the client says so itself, and reconnects
            except TransientError as error:
                problem = str(error)
            if problem != silent:
                silent = problem
                if problem:
                    log.warning("the history cannot be read: %s", problem)
            yield events or ()
            if events is not None and not events:
                waiting = asyncio.create_task(happened.wait())
                try:
                    await asyncio.wait(
                        (waiting, listening), timeout=TICK_S, return_when=asyncio.FIRST_COMPLETED
                    )
                finally:
                    waiting.cancel()
                if listening.done():
                    listening.result()
            await asyncio.sleep(PAUSE_S)
    finally:
        listening.cancel()
        with contextlib.suppress(asyncio.CancelledError, Exception):
            await listening
