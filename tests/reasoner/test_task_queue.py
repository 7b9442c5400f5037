"""Tasks one after the other: what a client may do with them, and what ends them."""

import asyncio

import pytest

from vram_arbiter.reasoner.inbox import Cancel, Said
from vram_arbiter.reasoner.results import nothing_done
from vram_arbiter.reasoner.task_queue import HISTORY_MAX, QUEUED_MAX, Task, TaskQueue
from vram_arbiter.schemas.errors import BadRequest, BadState, LimitExceeded
from vram_arbiter.schemas.reasoner import Result

pytestmark = pytest.mark.anyio


def success(task: Task) -> Result:
    return nothing_done(task.text, "done") | {"status": "success"}


def states(queue: TaskQueue) -> list[tuple[int, str]]:
    return [(task.number, task.state) for task in queue.tasks]


async def test_tasks_begin_in_their_order_and_a_waiter_hears_of_the_next() -> None:
    queue = TaskQueue()
    waiting = asyncio.create_task(queue.next())
    await asyncio.sleep(0)
    first, second = queue.submit("a"), queue.submit("b")
    assert (queue.ahead_of(first), queue.ahead_of(second)) == (0, 1)
    assert await waiting is first
    queue.end(success(first))
    assert await queue.next() is second
    assert states(queue) == [(1, "success"), (2, "running")]
    queue.stop("by SIGTERM")
    queue.end(nothing_done("b", "canceled: by SIGTERM"))
    assert await queue.next() is None
    found = states(queue)
    assert found == [(1, "success"), (2, "canceled")]


async def test_a_cancel_meets_the_task_that_it_names() -> None:
    over: list[int] = []
    queue = TaskQueue(ended=lambda task: over.append(task.number))
    for text in ("a", "b", "c"):
        queue.submit(text)
    with pytest.raises(BadState, match="no task runs"):
        queue.cancel(None, "lunch")
    with pytest.raises(BadState, match="no task runs"):
        queue.say("hello")
    running = await queue.next()
    assert running is not None
    queue.cancel(2, "lunch")
    queue.say("hello")
    assert running.inbox.take() == [Said("hello")]
    queue.cancel(None, "lunch")
    assert running.inbox.take() == [Cancel("lunch")]
    queue.end(success(running))  # it was faster
    assert states(queue) == [(1, "success"), (2, "canceled"), (3, "queued")]
    assert queue.find(2).view()["reason"] == "canceled: lunch"
    assert over == [2, 1]
    with pytest.raises(BadState, match="task 2 is over: canceled"):
        queue.cancel(2, "again")
    with pytest.raises(BadRequest, match="unknown task 9"):
        queue.cancel(9, "lunch")


async def test_an_emergency_stop_clears_the_queue() -> None:
    """The next task must not move the robot as soon as the stop is reset."""

    queue = TaskQueue()
    queue.submit("a")
    queue.submit("b")
    await queue.next()
    queue.end(nothing_done("a", "stopped: emergency stop: by hand") | {"stopped": True})
    assert "task 1 was stopped: emergency stop" in queue.find(2).view()["reason"]
    found = states(queue)
    assert found == [(1, "failure"), (2, "canceled")]


async def test_a_planner_that_says_stopped_clears_no_queue() -> None:
    """Regression: a language model that ended its task with "stopped: …" canceled those that
    waited, as an emergency stop does."""

    queue = TaskQueue()
    queue.submit("a")
    queue.submit("b")
    await queue.next()
    queue.end(nothing_done("a", "stopped: the shelf is empty"))
    found = states(queue)
    assert found == [(1, "failure"), (2, "queued")]


async def test_queue_and_history_have_limits_and_a_task_is_checked_first() -> None:
    def no_songs(text: str) -> None:
        if text == "sing":
            raise BadRequest("it cannot sing")

    queue = TaskQueue(no_songs)
    with pytest.raises(BadRequest, match="cannot sing"):
        queue.submit("sing")
    for _ in range(HISTORY_MAX + 2):
        queue.submit("a")
        task = await queue.next()
        assert task is not None
        queue.end(success(task))
    assert len(queue.tasks) == HISTORY_MAX
    with pytest.raises(BadRequest, match="the last 64"):
        queue.find(1)
    for _ in range(QUEUED_MAX):
        queue.submit("a")
    with pytest.raises(LimitExceeded):
        queue.submit("a")


async def test_a_reasoner_with_one_task_takes_no_other() -> None:
    queue = TaskQueue.of_one("a")
    with pytest.raises(BadState, match="runs one task"):
        queue.submit("b")
    assert states(queue) == [(1, "running")]
