"""The control thread: work between ticks, failures that reach who asked, an end that leaves nobody
waiting.
"""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest

from vram_arbiter.runner.control.mailbox import MAILBOX_MAX, Mailbox
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.protocols import Goal, Hold, SkillKey, StepOutcome
from vram_arbiter.runner.sim.robot import SimRunner
from vram_arbiter.schemas.errors import BadState, InternalError
from vram_arbiter.schemas.world import WorldState

pytestmark = pytest.mark.anyio

Make = Callable[..., SimRunner]


class Forever:
    manifest: Any = None
    key = SkillKey("test/skill")
    holds_gpu = False
    cameras: tuple[str, ...] = ()
    fraction = 0.0

    def wants_frames(self) -> bool:
        return False

    def step(self, world: WorldState) -> StepOutcome:
        return Hold("for ever")


async def test_work_runs_on_the_control_thread(make_runner: Make) -> None:
    runner = make_runner(rate_hz=500.0)
    async with ControlThread(runner) as control:
        name = await control.call(lambda: threading.current_thread().name)
        assert name == "control"
        with pytest.raises(BadState, match="no"):
            await control.call(_refuse)
    assert control.ended.result().n_ticks == runner.tick_idx


def _refuse() -> None:
    raise BadState("no")


async def test_a_runner_that_cannot_start_says_why(make_runner: Make, env: Any) -> None:
    def broken(stopping: object) -> None:
        raise FileNotFoundError("no scene")

    runner = make_runner()
    runner.robot.open = broken  # type: ignore[method-assign]
    control = ControlThread(runner)
    with pytest.raises(FileNotFoundError, match="no scene"):
        await control.__aenter__()
    with pytest.raises(InternalError, match="does not take work"):
        await control.call(lambda: None)
    assert control.ended.exception() is not None


async def test_a_loop_that_dies_fails_what_waits(make_runner: Make, env: Any) -> None:
    async with ControlThread(make_runner(rate_hz=500.0)) as control:
        running = asyncio.create_task(control.run_skill(Forever(), Goal("g", "r")))
        await control.call(lambda: None)
        await control.call(lambda: setattr(env, "step", None))  # the robot is gone
        outcome = (await asyncio.gather(running, return_exceptions=True))[0]
        assert isinstance(getattr(outcome, "error", outcome), InternalError)
        with pytest.raises(InternalError):
            await control.call(lambda: None)
    assert isinstance(control.ended.exception(), TypeError)
    assert env.closed == 1


@pytest.mark.parametrize("fails", ["at the start", "at the end"])
async def test_an_end_that_fails_leaves_nobody_waiting(
    make_runner: Make, env: Any, fails: str
) -> None:
    """Regression: the control thread died silently when disconnecting raised, and its waiters never
    heard."""

    def stuck() -> None:
        raise TypeError("the driver's defect")

    def broken() -> None:
        raise FileNotFoundError("no robot")

    runner = make_runner(rate_hz=500.0)
    runner.deactivate = stuck  # type: ignore[method-assign]
    if fails == "at the start":
        runner.activate = broken  # type: ignore[method-assign]
        with pytest.raises(FileNotFoundError, match="no robot"):
            await asyncio.wait_for(ControlThread(runner).__aenter__(), 60)
        return
    control = ControlThread(runner)
    await control.__aenter__()
    await asyncio.wait_for(control.__aexit__(), 60)
    assert isinstance(control.ended.exception(), TypeError)


async def test_cancelling_a_skill_takes_the_arm_back(make_runner: Make) -> None:
    runner = make_runner(rate_hz=500.0)
    async with ControlThread(runner) as control:
        for _ in range(3):
            running = asyncio.create_task(control.run_skill(Forever(), Goal("g", "r")))
            while await control.call(lambda: runner.progress.state) != "running":
                await asyncio.sleep(0)
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
            assert await control.call(lambda: runner.progress.state) == "idle"


def test_the_mailbox_is_bounded_and_fails_what_it_cannot_do() -> None:
    mailbox = Mailbox()
    done = mailbox.post(lambda: 1)
    mailbox.run_pending()
    assert done.result(0) == 1
    waiting = [mailbox.post(lambda: 2) for _ in range(MAILBOX_MAX)]
    with pytest.raises(InternalError):
        mailbox.post(lambda: 3)
    waiting.pop().cancel()
    mailbox.close()
    assert all(isinstance(one.exception(0), InternalError) for one in waiting)


def test_work_that_posts_work_does_not_hold_the_tick() -> None:
    mailbox, done = Mailbox(), []

    def again() -> None:
        done.append(1)
        mailbox.post(again)

    mailbox.post(again)
    mailbox.run_pending()
    assert done == [1]
