"""When a reader of the history may say that it misses nothing from then on."""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import aclosing

import pytest

from vram_arbiter.clients.feed import Cursor, follow
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.replies import HistoryReply


class Quiet:
    """An arbiter whose history has seven events, and where no more happens."""

    async def history(
        self, after: int = 0, limit: int = 500, kinds: Sequence[str] = ()
    ) -> HistoryReply:
        events: list[JsonMap] = [{"seq": seq} for seq in range(after + 1, 8)][:limit]
        return HistoryReply(tuple(events), last_seq=7, numbering="n")

    async def subscribe(self) -> AsyncGenerator[JsonMap]:
        await asyncio.Event().wait()
        yield {}


@pytest.mark.parametrize(
    ("read", "found"), [({}, []), ({"n": 7}, []), ({"n": 5}, [6, 7]), ({"older": 3}, [])]
)
def test_the_first_batch_says_that_the_place_is_known(
    read: dict[str, int], found: list[int]
) -> None:
    """Hooks said that they were ready before they knew it, and missed what happened just then."""

    async def first() -> tuple[Sequence[JsonMap], str]:
        cursor = Cursor(read)
        source: AsyncIterator[Sequence[JsonMap]]
        async with aclosing(follow(Quiet(), cursor)) as source, asyncio.timeout(60):
            return await anext(source), cursor.numbering

    events, numbering = asyncio.run(first())
    assert ([event["seq"] for event in events], numbering) == (found, "n")
