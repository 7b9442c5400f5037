"""`vram-reasoner serve`: tasks in sequence, from a queue that any client may fill."""

import logging

from vram_arbiter.reasoner.results import nothing_done
from vram_arbiter.reasoner.task_queue import TaskQueue
from vram_arbiter.reasoner.workplace import Workplace
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

log = logging.getLogger(__name__)


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
