"""A page that does not read its events, and what pages are told of leases."""

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.messages import IDLE_STATUS, lease_view
from vram_arbiter.clients.observer.page import feed as feed_module
from vram_arbiter.clients.observer.page.feed import UNREAD_MAX_BYTES, PageFeed, PageReader
from vram_arbiter.clients.observer.page.usage import UsageRecord
from vram_arbiter.clients.observer.present import Look
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import HistoryReply
from vram_arbiter.schemas.wire.views import DemandView

CHUNK = bytes(256 * 1024)


def test_a_page_that_does_not_read_is_dropped() -> None:
    """What it has not taken is kept up to UNREAD_MAX_BYTES; then its connection ends."""
    aborted, left = list[int](), list[PageReader]()

    async def drop() -> list[bytes]:
        reader = PageReader(lambda: aborted.append(1), left.append)
        sent = 0
        while reader.send(CHUNK):
            sent += len(CHUNK)
        assert sent == UNREAD_MAX_BYTES
        assert aborted == [1]
        return [chunk async for chunk in reader.chunks()]

    assert asyncio.run(drop()) == []
    assert len(left) == 1


class Arbiter:
    """Answers as a client does, from an engine."""

    def __init__(self, driver: CoreDriver) -> None:
        self.driver = driver

    async def why(self, consumer: str) -> WhyReply:
        return self.driver.arbiter.why(consumer, self.driver.now)

    async def history(self, *_: Any, **__: Any) -> HistoryReply:
        return HistoryReply((), 0)


def test_every_page_is_told_the_status_and_a_new_one_the_past(driver: CoreDriver) -> None:
    """A lease that is gone is not among the leases any more; the past is sent once."""

    async def story() -> list[tuple[str, Any]]:
        asked: list[int] = []
        feed = PageFeed(Arbiter(driver), UsageRecord(), lambda: asked.append(1))
        det = driver.consumer("det")
        lease = det.acquire(5 * GIB)
        det.load(lease)
        det.use_begin(lease)
        first = driver.consumer("first")
        waiter = first.acquire(5 * GIB)
        second = driver.consumer("second").acquire(5 * GIB)
        reader = feed.join(lambda: None)
        await feed.publish(look_of(driver))
        first.cancel(waiter)
        await feed.publish(look_of(driver))
        reader.end()
        told = []
        for chunk in list(reader._unread):
            for event in chunk.decode().split("\n\n")[:-1]:
                name, _, data = event.partition("\ndata: ")
                told.append((name.removeprefix("event: "), strictjson.loads(data)))
        assert asked == [1]
        before, after = (data["leases"] for name, data in told if name == "snapshot")
        assert {one["lease_id"] for one in before} == {lease, waiter, second}
        assert {one["lease_id"]: one.get("position") for one in after} == {lease: None, second: 1}
        return told

    names = [name for name, _ in asyncio.run(story())]
    assert names == ["snapshot", "waits", "usage", "history", "history", "snapshot", "waits"]
    assert replace(look_of(driver), at=1.0).origin == 1.0 - look_of(driver).status.uptime_s


def test_requests_at_consumers_are_in_the_first_part_alone() -> None:
    demands = (DemandView("llm", 3, 12, "gateway"),)
    status = replace(IDLE_STATUS, leases=(lease_view(),) * 101, demands=demands)
    told = [strictjson.loads(part.partition(b"data: ")[2]) for part in feed_module._pages(status)]
    assert [one.get("demands") for one in told] == [[to_map(demands[0])], None]


class Silent(Arbiter):
    """Does not answer."""

    async def history(self, *_: Any, **__: Any) -> HistoryReply:
        return await asyncio.get_running_loop().create_future()


def test_pages_begin_anew_where_the_arbiter_is_too_slow(
    driver: CoreDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Events that were taken for a message are in no later one."""
    monkeypatch.setattr(feed_module, "ASK_S", 0.05)

    async def story() -> list[bytes]:
        feed = PageFeed(Silent(driver), UsageRecord(), lambda: None)
        reader = feed.join(lambda: None)
        await feed.publish(look_of(driver))
        assert not feed.read
        return [chunk async for chunk in reader.chunks()]

    assert asyncio.run(story()) == []


def test_a_page_ends_with_the_start_of_the_daemon_that_it_was_told_of(driver: CoreDriver) -> None:
    """Times of a page count from the daemon's start: after a restart they were wrong by hours."""

    async def story() -> None:
        feed = PageFeed(Arbiter(driver), UsageRecord(), lambda: None)
        first = look_of(driver)
        told = feed.join(lambda: None)
        await feed.publish(first)
        assert told.told
        joining = feed.join(lambda: None)
        restarted = replace(first.status, epoch=first.status.epoch + 1)
        await feed.publish(replace(first, status=restarted))
        chunks = [chunk async for chunk in told.chunks()]
        assert len(chunks) <= 1, "nothing of the next start"
        assert feed.read
        assert joining.told

    asyncio.run(story())


def look_of(driver: CoreDriver) -> Look:
    return Look(driver.arbiter.status(driver.now), driver.now, 0.0)
