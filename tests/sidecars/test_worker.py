"""The thread that touches the model."""

import asyncio
import threading
import weakref

import pytest

from vram_arbiter.schemas.errors import ModelError, VramError, WaitTimeout
from vram_arbiter.sidecars.worker import Worker


class Weights:
    """Stands for a gigabyte on the GPU."""


@pytest.mark.parametrize("typed", [False, True])
def test_a_failed_load_keeps_none_of_what_it_loaded(typed: bool) -> None:
    """The sidecar remembers its last error, and an error's traceback keeps the locals of every
    frame: the memory would not come back."""
    held: list[weakref.ref[Weights]] = []

    def load() -> None:
        half = Weights()
        held.append(weakref.ref(half))
        try:
            raise ValueError("half of the file is missing")
        except ValueError as error:
            if typed:
                raise ModelError("incomplete") from error
            raise

    async def fail() -> VramError:
        worker = Worker()
        try:
            await worker.run(load)
        except VramError as error:
            return error
        finally:
            worker.close()
        raise AssertionError("it did not fail")

    error = asyncio.run(fail())
    assert isinstance(error, ModelError)
    assert held[0]() is None


def test_work_that_could_not_begin_in_time_never_does_and_stuck_work_is_told() -> None:
    """Regression: a request behind one that hung in a decoder kept its use of the lease
    for ever."""
    let_go, done = threading.Event(), []

    async def story() -> None:
        worker = Worker()
        try:
            begun = asyncio.Event()
            loop = asyncio.get_running_loop()

            def hang() -> None:
                loop.call_soon_threadsafe(begun.set)
                assert let_go.wait(60)

            hanging = asyncio.create_task(worker.run_for(hang, begin_s=60, end_s=0.2))
            await begun.wait()
            with pytest.raises(WaitTimeout, match="busy"):
                await worker.run_for(lambda: done.append("late"), begin_s=0.05, end_s=60)
            canceled = asyncio.create_task(
                worker.run_for(lambda: done.append("x"), begin_s=60, end_s=60)
            )
            await asyncio.sleep(0)
            canceled.cancel()
            with pytest.raises(asyncio.CancelledError):
                await canceled
            with pytest.raises(ModelError, match="has not answered within"):
                await hanging
            assert worker.stuck.is_set()
            let_go.set()
            await worker.run_for(lambda: done.append("next"), begin_s=60, end_s=60)
            with pytest.raises(ModelError, match="ZeroDivisionError"):
                await worker.run_for(lambda: 1 / 0, begin_s=60, end_s=60)
        finally:
            let_go.set()
            worker.close()

    asyncio.run(story())
    assert done == ["next"]
