"""Background writer: order, bounds, and failures that are told. Real threads, a scripted sink."""

import asyncio
import threading
from collections.abc import Awaitable, Callable, Sequence

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.arbiter.host.disk_writer import DiskBehind, DiskFailed, DiskWriter

ITEMS_MAX = 10


class Scripted:
    """A sink that hangs or fails as the test says."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []
        self.entered, self.goes_on = threading.Event(), threading.Event()
        self.goes_on.set()
        self.error: Exception | None = None
        self.closed = False

    def write(self, items: Sequence[int]) -> None:
        self.entered.set()
        assert self.goes_on.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error
        self.batches.append(list(items))

    def close(self) -> None:
        self.closed = True


class Scene:
    """A running writer, and what it told."""

    def __init__(self) -> None:
        self.sink = Scripted()
        self.told: list[DiskFailed | None] = []
        self.heard = asyncio.Event()
        self.writer: DiskWriter[int] = DiskWriter(
            "test", self.sink, self._told, items_max=ITEMS_MAX, questions_max=2
        )
        self.writer.start(asyncio.get_running_loop())

    def _told(self, failure: DiskFailed | None) -> None:
        self.told.append(failure)
        self.heard.set()

    async def hear(self) -> DiskFailed | None:
        """Wait until something is told, and return the last of it."""
        await self.heard.wait()
        self.heard.clear()
        return self.told[-1]

    async def hang(self) -> None:
        """The thread hangs in the write of item 0."""
        self.sink.goes_on.clear()
        self.writer.put(0)
        self.writer.flush()
        assert await asyncio.to_thread(self.sink.entered.wait, PATIENCE_S)


def run_scene(test: Callable[[Scene], Awaitable[None]]) -> Scene:
    async def scene() -> Scene:
        made = Scene()
        try:
            async with asyncio.timeout(PATIENCE_S):
                await test(made)
        finally:
            made.sink.goes_on.set()
            made.writer.close()
        return made

    return asyncio.run(scene())


def test_close_writes_the_rest_in_order() -> None:
    async def test(scene: Scene) -> None:
        for number in range(5):
            scene.writer.put(number)

    scene = run_scene(test)
    assert scene.sink.batches == [[0, 1, 2, 3, 4]]
    assert scene.sink.closed
    assert scene.told == []


def test_a_batch_is_written_without_being_asked_for() -> None:
    async def test(scene: Scene) -> None:
        scene.writer.confirm()
        scene.writer.put(1)
        assert await scene.hear() is None

    assert run_scene(test).sink.batches == [[1]]


def test_each_failure_is_told_and_then_that_it_works_again() -> None:
    async def test(scene: Scene) -> None:
        scene.sink.error = OSError(28, "No space left on device")
        for number in (1, 2):
            scene.writer.put(number)
            scene.writer.flush()
            failure = await scene.hear()
            assert isinstance(failure, DiskFailed)
            assert "No space left on device" in str(failure)
            assert isinstance(failure.__cause__, OSError)
        scene.sink.error = None
        for number in (3, 4):
            scene.writer.put(number)
            scene.writer.flush()
        assert await scene.hear() is None

    scene = run_scene(test)
    assert scene.told[2:] == [None], "once"
    assert scene.sink.batches == [[3], [4]]


def test_a_disk_that_hangs_holds_a_bounded_number_and_the_oldest_are_dropped() -> None:
    async def test(scene: Scene) -> None:
        await scene.hang()
        for number in range(1, ITEMS_MAX + 1):
            assert scene.writer.put(number)
        scene.writer.flush()
        assert scene.writer.behind == ITEMS_MAX + 1
        room = [scene.writer.put(number) for number in range(100, 100 + ITEMS_MAX + 3)]
        assert room == [True] * ITEMS_MAX + [False] * 3
        scene.writer.flush()
        assert isinstance(scene.told[-1], DiskBehind)
        scene.heard.clear()
        scene.sink.goes_on.set()
        assert await scene.hear() is None

    newest = list(range(103, 100 + ITEMS_MAX + 3))
    written = [number for batch in run_scene(test).sink.batches for number in batch]
    assert written == [*range(ITEMS_MAX + 1), *newest]


def test_an_answer_comes_after_what_was_put_before_it() -> None:
    async def test(scene: Scene) -> None:
        answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
        scene.writer.put(7)
        scene.writer.ask(lambda: list(scene.sink.batches), answer.set_result)
        assert await answer == [[7]]

    run_scene(test)


def test_a_question_that_fails_is_answered_with_its_failure() -> None:
    def find() -> int:
        raise ValueError("damaged")

    async def test(scene: Scene) -> None:
        answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
        scene.writer.ask(find, answer.set_result)
        failure = await answer
        assert isinstance(failure, DiskFailed)
        assert str(failure) == "damaged"

    assert run_scene(test).told == []


def test_questions_to_a_disk_that_hangs_are_bounded() -> None:
    async def test(scene: Scene) -> None:
        await scene.hang()
        for _ in range(2):
            scene.writer.ask(int, print)
        with pytest.raises(DiskBehind):
            scene.writer.ask(int, print)

    run_scene(test)
