"""Tasks of a reasoner: one at a time, the others in the order they were submitted, the ended ones
as history. No sockets; one event loop.
"""

import asyncio
import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Self

from vram_arbiter.reasoner.inbox import Cancel, Inbox, Said
from vram_arbiter.reasoner.results import nothing_done
from vram_arbiter.schemas.errors import BadRequest, BadState, LimitExceeded
from vram_arbiter.schemas.reasoner import Result, TaskState, TaskView

log = logging.getLogger(__name__)

QUEUED_MAX = 32
HISTORY_MAX = 64  # results in memory; `--history` keeps all of them


@dataclass(slots=True)
class Task:
    """One task: `number` counts from 1 in this process."""

    number: int
    text: str
    submitted_at: str
    inbox: Inbox = field(default_factory=Inbox)
    state: TaskState = "queued"
    canceled: bool = False
    started_at: str | None = None
    ended_at: str | None = None
    result: Result | None = None

    def view(self) -> TaskView:
        return {
            "task": self.number,
            "text": self.text,
            "state": self.state,
            "reason": "" if self.result is None else self.result["reason"],
            "submitted_at": self.submitted_at,
            "started_at": self.started_at,
            "ended_at": self.ended_at,
        }


class TaskQueue:
    """`check` raises for a text that the planner could not work on; `ended` hears of each end.

    `TaskQueue.of_one` is the queue of a reasoner that runs one task and takes no other.
    """

    def __init__(
        self,
        check: Callable[[str], None] = lambda text: None,
        ended: Callable[[Task], None] = lambda task: None,
    ) -> None:
        self._check = check
        self._ended = ended
        self._numbers = itertools.count(1)
        self.tasks: list[Task] = []
        """All that are known, the oldest first."""
        self._changed = asyncio.Event()
        self._stopped = False
        self.serves = True

    @classmethod
    def of_one(cls, text: str) -> Self:
        queue = cls()
        queue.submit(text)
        queue._begin()
        queue.serves = False
        return queue

    @property
    def running(self) -> Task | None:
        return next(iter(self._in("running")), None)

    def _in(self, state: TaskState) -> list[Task]:
        return [task for task in self.tasks if task.state == state]

    # -- what a client may do
    def submit(self, text: str) -> Task:
        """Raises BadState for a reasoner that takes no tasks, LimitExceeded for a full queue."""
        if not self.serves or self._stopped:
            why = "ends" if self._stopped else "runs one task"
            raise BadState(f"this reasoner {why}", hint="start one by `vram-reasoner serve`")
        self._check(text)
        if len(self._in("queued")) >= QUEUED_MAX:
            raise LimitExceeded(
                f"{QUEUED_MAX} tasks wait already",
                hint="cancel one, or submit this one later",
                details={"limit": QUEUED_MAX},
            )
        task = Task(next(self._numbers), text, _now())
        self.tasks.append(task)
        self._changed.set()
        return task

    def ahead_of(self, task: Task) -> int:
        """Return how many tasks come before this one."""
        return self._in("queued").index(task) + (self.running is not None)

    def say(self, text: str) -> None:
        """Pass words to the running task's planner. Raises BadState when none runs."""
        if self.running is None:
            raise BadState("no task runs", hint="submit one first")
        self.running.inbox.put(Said(text))

    def cancel(self, number: int | None, reason: str) -> None:
        """End the running task, or the one with this number, also one that still waits.

        Raises BadState for one that is over, or when none runs, and BadRequest for an unknown one.
        """
        task = self.running if number is None else self.find(number)
        if task is None:
            raise BadState("no task runs", hint="name the task that waits by its number")
        if task.state == "running":
            task.canceled = True
            task.inbox.put(Cancel(reason))
        elif task.state == "queued":
            self._drop(task, f"canceled: {reason}")
        else:
            raise BadState(f"task {number} is over: {task.state}")

    def find(self, number: int) -> Task:
        """Raises BadRequest for a number that is not known, or not any more."""
        found = next((task for task in self.tasks if task.number == number), None)
        if found is None:
            raise BadRequest(
                f"unknown task {number}", hint=f"the last {HISTORY_MAX} that ended are kept"
            )
        return found

    # -- what the server of the queue does
    async def next(self) -> Task | None:
        """Wait for a task and begin it; None: the queue was stopped."""
        while not self._stopped:
            if self._in("queued"):
                return self._begin()
            self._changed.clear()
            await self._changed.wait()
        return None

    def _begin(self) -> Task:
        task = self._in("queued")[0]
        task.state, task.started_at = "running", _now()
        return task

    def end(self, result: Result) -> None:
        """End the running task.

        One that a danger ended takes those that wait with it: an operator has to submit them again.
        """
        task = self.running
        assert task is not None, "only a running task has a result"
        self._close(task, result, "canceled" if task.canceled else result["status"])
        if result["stopped"]:
            self._drop_all(f"canceled: task {task.number} was {result['reason']}")

    def stop(self, reason: str) -> None:
        """Take no more tasks; cancel the running one and those that wait."""
        self._stopped = True
        self._changed.set()
        self._drop_all(f"canceled: {reason}")
        if self.running is not None:
            self.cancel(None, reason)

    def _drop_all(self, reason: str) -> None:
        for task in self._in("queued"):
            self._drop(task, reason)

    def _drop(self, task: Task, reason: str) -> None:
        self._close(task, nothing_done(task.text, reason), "canceled")

    def _close(self, task: Task, result: Result, state: TaskState) -> None:
        if state != result["status"] and result["status"] == "success":
            state = "success"  # it was faster than the cancel
        task.state, task.ended_at, task.result = state, _now(), result
        log.info("task %d: %s: %s", task.number, state, result["reason"])
        over = [task for task in self.tasks if task.ended_at is not None]
        if len(over) > HISTORY_MAX:
            self.tasks.remove(min(over, key=lambda one: one.ended_at or ""))
        self._ended(task)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
