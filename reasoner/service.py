"""`vram-reasoner serve`: tasks in sequence, from a queue that any client may fill."""

import logging
from pathlib import Path
from typing import IO

from vram_arbiter.reasoner.loop import nothing_done
from vram_arbiter.reasoner.task_queue import Task, TaskQueue
from vram_arbiter.reasoner.workplace import Workplace
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.reasoner import HistoryLine
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

log = logging.getLogger(__name__)


class History:
    """Appends each ended task with its result to a file, as a line of JSON; without a path nothing
    is written.
    """

    def __init__(self, path: Path | None) -> None:
        self._file: IO[str] | None = None
        if path is not None:
            try:
                self._file = path.open("a", encoding="utf-8", errors="backslashreplace")
            except OSError as error:
                raise ConfigError(
                    f"--history {path} cannot be written: {error.strerror}",
                    hint="name a file in a folder of your own",
                ) from error

    def add(self, task: Task) -> None:
        if self._file is None or task.result is None:
            return
        line = HistoryLine(task=task.view(), result=task.result)
        try:
            self._file.write(line.model_dump_json() + "\n")
            self._file.flush()
        except OSError as error:  # a full disk stops no robot
            log.error("the history misses task %d: %s", task.number, error)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


async def serve(queue: TaskQueue, workplace: Workplace) -> None:
    """Perform tasks until the queue is stopped. A task that cannot begin has failed, and the next
    one is taken.
    """
    while (task := await queue.next()) is not None:
        log.info("task %d: %s", task.number, task.text)
        result = nothing_done(task.text, "canceled: broken off")
        try:
            with tracing.span(telemetry.SPAN_TASK):
                result = await workplace.perform(task.text, task.inbox)
        except VramError as error:
            result = nothing_done(task.text, str(error))
        finally:
            queue.end(result)
