"""Events are numbered for ever, found in memory or on disk, and bounded by number and age."""

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import pytest

from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.arbiter.host import history as module
from vram_arbiter.arbiter.host.history import (
    CLEAN_END,
    QUESTIONS_MAX,
    RING_EVENTS,
    SKIPPED_AFTER_CRASH,
    History,
)
from vram_arbiter.schemas.wire.replies import HistoryReply


def with_history(
    folder: Path,
    test: Callable[[History], Awaitable[None]],
    max_events: int = 100_000,
    days: float = 7.0,
) -> None:
    async def run() -> None:
        history = History.open(folder, max_events, days)
        history.start(asyncio.get_running_loop())
        try:
            async with asyncio.timeout(PATIENCE_S):
                await test(history)
        finally:
            history.close()

    asyncio.run(run())


async def page(
    history: History,
    after: int = 0,
    limit: int = 500,
    kinds: tuple[str, ...] = (),
    before: int | None = None,
) -> HistoryReply:
    answer: asyncio.Future[HistoryReply] = asyncio.get_running_loop().create_future()
    history.read(after, limit, kinds, answer.set_result, before)
    return await answer


def test_a_numbering_has_a_name_as_long_as_its_file(tmp_path: Path) -> None:
    """A reader that goes on at a number could not tell that the numbers had begun again."""
    names: list[str] = []

    async def test(history: History) -> None:
        names.append((await page(history)).numbering)

    with_history(tmp_path, test)
    with_history(tmp_path, test)
    for path in tmp_path.glob("history.sqlite*"):
        path.unlink()
    with_history(tmp_path, test)
    first, again, other = names
    assert first == again != other
    assert all(names)


def test_events_are_numbered_and_read_back(tmp_path: Path) -> None:
    async def test(history: History) -> None:
        event = history.append("granted", {"lease_id": "L1-1"})
        assert event["seq"] == 1
        assert abs(event["at_wall_s"] - time.time()) < PATIENCE_S
        history.append("ready", {})
        history.append("granted", {"lease_id": "L1-2"})
        assert [e["seq"] for e in (await page(history)).events] == [1, 2, 3]
        assert [e["seq"] for e in (await page(history, after=1)).events] == [2, 3]
        assert [e["seq"] for e in (await page(history, limit=1)).events] == [1]
        assert [e["lease_id"] for e in (await page(history, kinds=("granted",))).events] == [
            "L1-1",
            "L1-2",
        ]
        beyond = await page(history, after=99)
        assert (beyond.events, beyond.last_seq, beyond.problem) == ((), 3, "")

    with_history(tmp_path, test)


def test_numbering_goes_on_after_an_orderly_stop(tmp_path: Path) -> None:
    async def first(history: History) -> None:
        history.append("granted", {"lease_id": "L1-1"})
        history.append(CLEAN_END, {})

    async def second(history: History) -> None:
        assert history.append("ready", {})["seq"] == 3
        events = (await page(history)).events
        assert [(e["seq"], e["kind"]) for e in events] == [
            (1, "granted"),
            (2, CLEAN_END),
            (3, "ready"),
        ]
        assert events[0]["lease_id"] == "L1-1"
        assert [e["seq"] for e in (await page(history, kinds=("granted", "nonsense"))).events] == [
            1
        ]

    with_history(tmp_path, first)
    with_history(tmp_path, second)


def test_after_a_crash_no_number_is_given_twice(tmp_path: Path) -> None:
    async def crash(history: History) -> None:
        history.append("granted", {})

    async def after(history: History) -> None:
        assert history.append("ready", {})["seq"] == 2 + SKIPPED_AFTER_CRASH

    with_history(tmp_path, crash)
    with_history(tmp_path, after)


def test_what_memory_no_longer_holds_is_found_on_disk(tmp_path: Path) -> None:
    async def test(history: History) -> None:
        for number in range(RING_EVENTS + 50):
            history.append("odd" if number % 2 else "even", {"number": number})
        old = (await page(history, after=10, limit=3)).events
        assert [e["seq"] for e in old] == [11, 12, 13]
        assert [e["number"] for e in (await page(history, kinds=("odd",), limit=2)).events] == [
            1,
            3,
        ]
        assert len((await page(history, limit=5000)).events) == RING_EVENTS + 50

    with_history(tmp_path, test)


def test_the_newest_below_a_number_are_found_in_memory_and_on_disk(tmp_path: Path) -> None:
    async def test(history: History) -> None:
        for number in range(1, RING_EVENTS + 51):
            history.append("odd" if number % 2 else "even", {})
        end = RING_EVENTS + 51

        async def numbers(before: int, limit: int, *kinds: str, after: int = 0) -> list[int]:
            found = await page(history, after, limit, kinds, before)
            return [event["seq"] for event in found.events]

        assert await numbers(1 << 62, 2) == [end - 2, end - 1]
        assert await numbers(end - 1, 2) == [end - 3, end - 2]
        assert await numbers(53, 4) == [49, 50, 51, 52]  # memory begins with 51
        assert await numbers(53, 3, "odd") == [47, 49, 51]
        assert await numbers(53, 9, after=47) == [48, 49, 50, 51, 52]
        assert await numbers(1, 9) == []
        assert await numbers(1 << 62, end) == list(range(1, end))

    with_history(tmp_path, test)


def test_number_and_age_are_bounded(tmp_path: Path) -> None:
    async def many(history: History) -> None:
        history.keep(100, 7.0)  # a reload, after a start with another number
        for _ in range(module.PRUNE_EVERY_EVENTS + 10):
            history.append("x", {})

    async def look(history: History) -> None:
        assert (await page(history)).events[0]["seq"] > module.PRUNE_EVERY_EVENTS - 200

    with_history(tmp_path, many)
    with_history(tmp_path, look)
    store = module._Store(tmp_path / "history.sqlite", 100, 1.0, time.time)
    store.last_seq()
    store.prune(time.time() + 2 * 86_400)
    assert store.find(0, 10, ()) == []
    store.close()


def test_a_clock_that_is_set_by_decades_does_not_empty_the_history_of_this_run(
    tmp_path: Path,
) -> None:
    """Regression: a robot boots in 1970 and hears the time from the network; its morning was pruned
    as older than a week."""
    store = module._Store(tmp_path / "history.sqlite", 100_000, 7.0, time.time)
    assert store.last_seq() == 0
    store.write(
        [{"seq": number, "at_wall_s": 60.0 * number, "kind": "x"} for number in range(1, 6)]
    )
    store.prune(1.8e9)
    assert [event["seq"] for event in store.find(0, 100, ())] == [1, 2, 3, 4, 5]
    store.close()
    later = module._Store(tmp_path / "history.sqlite", 100_000, 7.0, time.time)
    assert later.last_seq() == 5 + SKIPPED_AFTER_CRASH
    later.prune(1.8e9)
    assert later.find(0, 100, ()) == [], "the next run may"
    later.close()


def test_numbers_are_not_given_out_twice_after_a_crash_before_the_first_write(
    tmp_path: Path,
) -> None:
    """Regression: a daemon that was killed in its first moments began at 1 again, and a reader that
    had seen those numbers took none of the new events."""
    path = tmp_path / "history.sqlite"
    first = module._Store(path, 1000, 7.0, time.time)
    assert first.last_seq() == 0
    first.numbering()
    first.close()
    again = module._Store(path, 1000, 7.0, time.time)
    assert again.last_seq() == SKIPPED_AFTER_CRASH
    again.close()


def test_a_broken_database_is_put_aside(tmp_path: Path) -> None:
    (tmp_path / "history.sqlite").write_bytes(b"junk" * 1000)

    async def test(history: History) -> None:
        assert history.append("x", {})["seq"] == 1

    with_history(tmp_path, test)
    assert list(tmp_path.glob("history.sqlite.corrupt-*"))

    async def again(history: History) -> None:
        assert len((await page(history)).events) == 1

    with_history(tmp_path, again)


def test_without_a_disk_it_lives_in_memory(tmp_path: Path) -> None:
    (tmp_path / "history.sqlite").mkdir()

    async def test(history: History) -> None:
        for _ in range(RING_EVENTS + 5):
            history.append("x", {})
        assert (await page(history)).events[0]["seq"] == 6

    with_history(tmp_path, test)


class HangingDisk:
    """A store whose first write hangs until it is let go; from then on it takes what it is
    given."""

    def __init__(self) -> None:
        self.hangs, self.goes_on = threading.Event(), threading.Event()
        self.written: list[int] = []

    def write(self, events: Sequence[Mapping[str, Any]]) -> None:
        self.hangs.set()
        assert self.goes_on.wait(PATIENCE_S)
        self.written += [event["seq"] for event in events]

    def find(self, after: int, *_: object) -> list[Mapping[str, Any]]:
        return [{"seq": after + 1}]

    def close(self) -> None:
        pass


def test_who_asks_a_disk_that_hangs_hears_so_beyond_the_bound() -> None:
    disk = HangingDisk()
    answers: list[HistoryReply] = []

    async def run() -> None:
        history = History(cast(Any, disk), 0)
        history.start(asyncio.get_running_loop())
        for _ in range(RING_EVENTS + 2):
            history.append("operator", {})
        assert await asyncio.to_thread(disk.hangs.wait, PATIENCE_S)
        for _ in range(QUESTIONS_MAX + 1):
            history.read(0, 1, (), answers.append)
        assert [answer.problem for answer in answers] == ["the disk of the history does not answer"]
        disk.goes_on.set()
        await eventually(lambda: len(answers) > QUESTIONS_MAX)
        assert all(answer.events == ({"seq": 1},) for answer in answers[1:])
        history.read(0, 1, (), answers.append)
        await eventually(lambda: len(answers) > QUESTIONS_MAX + 1)
        assert not answers[-1].problem, "there is room again"
        history.close()

    asyncio.run(run())


def spoiled(folder: Path, statement: str, *values: object) -> None:
    with_history(folder, nothing)
    with contextlib.closing(sqlite3.connect(folder / "history.sqlite")) as database, database:
        database.execute(statement, values)


async def nothing(history: History) -> None:
    history.append("first", {})


EVENT = "INSERT INTO events VALUES (?, 9e9, 'x', ?)"  # young enough to be kept


@pytest.mark.parametrize(
    "text",
    ["{", "[" * 100_000, "7", '{"seq": 1e999}', '{"n": ' + "9" * 5000 + "}",
    '{"n": ' + "9" * 30 + "}", b"\xff{}", '"\\ud800"'],
)  # fmt: skip
def test_an_event_that_cannot_be_read_does_not_hide_the_others(
    tmp_path: Path, text: str | bytes
) -> None:
    """Regression: one of them ended the thread that reads and writes the history, and no question
    was answered again."""
    spoiled(tmp_path, EVENT, 3, text)

    async def test(history: History) -> None:
        for _ in range(RING_EVENTS + 5):
            history.append("x", {})
        found = (await page(history, limit=3)).events
        assert [event["seq"] for event in found] == [1, 3, SKIPPED_AFTER_CRASH + 4]
        assert (found[1]["kind"], found[1]["at_wall_s"]) == ("unreadable", 9e9)

    with_history(tmp_path, test)


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO events VALUES (9223372036854775807, 1.0, 'x', '{}')",
        "ALTER TABLE events RENAME COLUMN seq TO other",
    ],
)
def test_a_history_that_cannot_be_continued_is_put_aside(tmp_path: Path, statement: str) -> None:
    """Regression: the next number did not fit in SQLite, which ended the thread that writes."""
    spoiled(tmp_path, statement)

    async def test(history: History) -> None:
        assert history.problem == ""
        assert history.append("x", {})["seq"] == 1

    with_history(tmp_path, test)
    assert list(tmp_path.glob("history.sqlite.corrupt-*"))
