"""One goal at the runner: sent, waited for, canceled.

A goal does not outlive its waiter: when the wait is canceled, or the goal makes no progress for as
long as the call allows, it is canceled at the runner.
"""

import asyncio
import contextlib
import logging
import math
import uuid
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Any

from vram_arbiter.clients.runner import Goal, RunnerClient
from vram_arbiter.reasoner.hints import Hints
from vram_arbiter.reasoner.outcomes import how_it_went, of_result
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.schemas.errors import BadRequest, BadState, RunnerUnreachable, VramError
from vram_arbiter.schemas.goals import CancelGoal, GetResult, ResultPush
from vram_arbiter.schemas.tools import ExecuteRskill

log = logging.getLogger(__name__)

# beyond the goal's own deadline: loading the skill's model is not part of the motion
GOAL_GRACE_S = 60.0
GOAL_MAX_S = 600.0  # when the manifest sets the deadline, and sets none that is longer
START_S = 90.0  # what the runner adds to a manifest's time of motion, to get there
# for feedback that came while this process was stopped; without it a live goal would be canceled
HEARD_LATE_S = 0.5
CANCEL_S = 10.0  # for a canceled goal to end: it gives the robot back and finishes its use
ASK_AGAIN_S = 0.2  # whether a goal has ended whose result has no listener
# waiting for the GPU is not a lack of progress
BEFORE_MOTION = frozenset({"acquiring", "starting"})


@dataclass(frozen=True, slots=True)
class Execution:
    """`await execution(call)`: one goal, from its sending to its end."""

    runner: RunnerClient
    palette: Palette | None
    hints: Hints | None
    session: str = ""
    goal_grace_s: float = GOAL_GRACE_S

    async def __call__(self, call: ExecuteRskill) -> Outcome:
        """Run the goal. Raises BadRequest and what its sending raises; else an outcome."""
        goal = await self._send(call)
        limit_s = waits_s(call, self.palette, self.goal_grace_s)
        waiting = asyncio.create_task(goal.result(timeout_s=limit_s))
        stuck = asyncio.create_task(_stands_still(goal, call))
        hint = asyncio.create_task(self._hint(call.next_rskill_id))
        try:
            await asyncio.wait({waiting, stuck}, return_when=asyncio.FIRST_COMPLETED)
            if waiting.done() or not stuck.result():
                return of_result(await waiting)
            result = await _called_off(goal)
            if result is not None and result["success"]:
                return of_result(result)
            why = f"no progress for {call.patience_s:g} s; {how_it_went(result)}"
            return Outcome("failed", why, "no_progress")
        except TimeoutError:
            how = how_it_went(await _called_off(goal))
            return Outcome("failed", f"no result within {limit_s:.0f} s; {how}", "wait_timeout")
        except BadRequest:
            raise  # the runner knows no such goal (any more)
        except VramError as error:  # it is gone, or cannot say how the goal goes
            how = how_it_went(await _called_off(goal))
            return Outcome("failed", f"{error.message}; {how}", error.code)
        except asyncio.CancelledError:
            await _called_off(goal)
            raise
        finally:
            for task in (waiting, stuck, hint):
                task.cancel()
                task.add_done_callback(_retrieve)

    async def _hint(self, follower: str) -> None:
        if follower and self.hints is not None:
            await self.hints.follows(follower)

    async def _send(self, call: ExecuteRskill) -> Goal:
        """Cancel a goal by its name if its acceptance was lost: it may run."""
        goal_id = f"goal-{uuid.uuid4().hex[:12]}"
        try:
            return await self.runner.send_goal(
                call.rskill_id,
                prompt=call.prompt,
                goal_params=call.goal_params,
                deadline_s=call.deadline_s,
                goal_id=goal_id,
                session=self.session,
            )
        except (asyncio.CancelledError, RunnerUnreachable):
            await _ended(goal_id, self._cancel_unheard(goal_id))
            raise

    async def _cancel_unheard(self, goal_id: str) -> None:
        """Cancel a goal that may have been accepted, and wait for its end."""
        ask = self.runner.ask_about
        with contextlib.suppress(BadRequest):  # it never was accepted
            await ask(CancelGoal(goal_id=goal_id))
            while True:
                try:
                    await ask(GetResult(goal_id=goal_id))
                except BadState:  # it runs
                    await asyncio.sleep(ASK_AGAIN_S)
                else:
                    return


def waits_s(call: ExecuteRskill, palette: Palette | None, grace_s: float) -> float:
    """Return how long to wait for a goal's result.

    Its own deadline and `grace_s`, or what its manifest allows, and never less than `GOAL_MAX_S`
    then.
    """
    if call.deadline_s:
        return call.deadline_s + grace_s
    known = palette.executable.get(call.rskill_id) if palette is not None else None
    return max(GOAL_MAX_S, known.longest_s + START_S + grace_s if known is not None else 0.0)


async def _stands_still(goal: Goal, call: ExecuteRskill) -> bool:
    """Return True once the goal's progress has not grown for `patience_s`, False when its feedback
    ends.

    Preparation before the motion does not count.
    """
    patience_s = math.inf if call.patience_s is None else call.patience_s
    best, deadline_s, over = -math.inf, math.inf, False
    time_s = asyncio.get_running_loop().time
    feedback = aiter(goal.feedback())
    coming = asyncio.ensure_future(anext(feedback))
    try:
        while True:
            left_s = max(0.0, deadline_s - time_s())
            if not (await asyncio.wait({coming}, timeout=left_s))[0]:
                if over:
                    return True
                over, deadline_s = True, time_s() + HEARD_LATE_S
                continue
            item = coming.result()
            coming = asyncio.ensure_future(anext(feedback))
            grown = item["progress"] > best + (call.progress_tolerance or 0.0)
            if item["state"] not in BEFORE_MOTION and grown:
                best, deadline_s, over = item["progress"], time_s() + patience_s, False
    except StopAsyncIteration:
        return False
    finally:
        coming.cancel()
        coming.add_done_callback(_retrieve)


async def _called_off(goal: Goal) -> ResultPush | None:
    """Cancel a goal and wait for its end; None if the runner does not report it."""

    async def end() -> ResultPush:
        if not goal.done:
            await goal.cancel()
        return await goal.result()

    return await _ended(goal.goal_id, end())


async def _ended[T](goal_id: str, end: Coroutine[Any, Any, T]) -> T | None:
    """Wait for the end of a canceled goal, within `CANCEL_S`; None if that fails.

    A cancellation of this task does not cut the wait short.
    """

    async def within_limit() -> T | None:
        try:
            async with asyncio.timeout(CANCEL_S):
                return await end
        except (TimeoutError, VramError) as error:
            why = str(error) or "the runner did not say that it ended"
            log.error("goal %s may still run: %s", goal_id, why)
            return None

    return await asyncio.shield(asyncio.create_task(within_limit()))


def _retrieve(task: "asyncio.Task[Any]") -> None:
    if not task.cancelled():
        task.exception()
