"""Thread that owns a runner, its robot or simulator and its cameras; the event loop sends it work.

MuJoCo's rendering contexts belong to the thread that made them, and a control loop must not wait
behind sockets. So the event loop never touches the runner: it posts callables, which run between
two ticks, and awaits their results.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from vram_arbiter.runner.protocols import Goal, GoalData, InferenceRunner, SkillEnded
from vram_arbiter.schemas.errors import InternalError, VramError
from vram_arbiter.schemas.world import RunResult

log = logging.getLogger(__name__)


class ControlThread:
    """`async with ControlThread(runner)`: activate the runner in its own thread, run it, stop it.

    Raises what `activate` raised. `ended` resolves when the run is over, with its RunResult or
    error.
    """

    def __init__(self, runner: InferenceRunner, *, max_ticks: int | None = None) -> None:
        self.runner = runner
        self._max_ticks = max_ticks
        self._thread = threading.Thread(target=self._main, name="control", daemon=True)
        self._ready: Future[None] = _promised()
        self._ended: Future[RunResult] = _promised()
        self.ended: asyncio.Future[RunResult]

    async def __aenter__(self) -> ControlThread:
        self.ended = asyncio.wrap_future(self._ended)
        self._thread.start()
        try:
            await asyncio.wrap_future(self._ready)
        except BaseException:
            self.runner.request_stop()
            await asyncio.wait([self.ended])
            self.ended.exception()  # it says no more than what is raised here
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        self.runner.request_stop()
        await asyncio.wait([self.ended])
        await asyncio.to_thread(self._thread.join)
        if not self.ended.cancelled() and (error := self.ended.exception()) is not None:
            log.error("the control loop ended with %s: %s", type(error).__name__, error)

    def _main(self) -> None:
        try:
            self.runner.activate()
        except BaseException as error:  # noqa: BLE001 — delivered to the awaiter of the start
            self.runner.mailbox.close()
            self._deactivate()
            self._ready.set_exception(error)
            self._ended.set_exception(InternalError("the control loop never started"))
            return
        self._ready.set_result(None)
        failure: BaseException | None = None
        try:
            result = self.runner.run(self._max_ticks)
        except VramError as error:  # self-explanatory; logged when the thread is left
            failure = error
        except BaseException as error:
            log.exception("the control loop failed")
            failure = error
        self.runner.mailbox.close()
        stuck = self._deactivate()
        if (failure := failure or stuck) is not None:
            self._ended.set_exception(failure)
        else:
            self._ended.set_result(result)

    def _deactivate(self) -> BaseException | None:
        """Deactivate the runner. Returns the error, if any, for the awaiter of the end."""
        try:
            self.runner.deactivate()
        except BaseException as error:
            log.exception("the runner did not let go of everything")
            return error
        return None

    async def call[T](self, work: Callable[[], T]) -> T:
        """Run `work` on the control thread between two ticks.

        Raises what it raises, InternalError when the thread has ended.
        """
        return await asyncio.wrap_future(self.runner.mailbox.post(work))

    async def run_skill(
        self,
        skill: Any,
        goal: Goal,
        on_begun: Callable[[], None] = lambda: None,
        taken_back: Callable[[GoalData], None] = lambda data: None,
    ) -> SkillEnded:
        """Give the robot to a started skill until it succeeds or fails. Canceling takes it back.

        Args: `on_begun` is called (event loop) when the skill has the robot: until then the
        runner's progress is that of the goal before. `taken_back` gets the counts of a canceled
        goal.
        """
        end: Future[SkillEnded] = _promised()
        ended = asyncio.wrap_future(end)
        try:
            await self.call(lambda: self.runner.begin_skill(skill, goal, end.set_result))
            on_begun()
            futures: list[asyncio.Future[Any]] = [ended, self.ended]
            await asyncio.wait(futures, return_when=asyncio.FIRST_COMPLETED)
            if not ended.done():
                raise InternalError(
                    "the control loop ended during the goal", hint="see the runner's log"
                )
            return ended.result()
        finally:
            if (
                not ended.done()
            ):  # canceled, deadline, a loop that died: the mailbox keeps the order
                ended.cancel()
                try:
                    taken_back(await self.call(self.runner.end_skill))
                except VramError:
                    log.debug("the control thread ended before the skill did")


def _promised() -> Future[Any]:
    """Return a future that the control thread resolves, whether its awaiter was canceled or not."""
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future
