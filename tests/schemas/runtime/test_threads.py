"""Blocking work beside an event loop."""

import asyncio
import threading

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.errors import NoGpu, ProbeFailed
from vram_arbiter.schemas.runtime.threads import answered_within


def test_work_that_may_hang_has_a_limit() -> None:
    """The program ends all the same: the thread is a daemon's."""
    release = threading.Event()

    async def run() -> None:
        assert await answered_within(PATIENCE_S, lambda: 7, "it") == 7
        with pytest.raises(NoGpu):
            await answered_within(PATIENCE_S, fail, "it")
        with pytest.raises(ProbeFailed, match=r"^it gave no answer within 0\.05 s"):
            await answered_within(0.05, lambda: release.wait(PATIENCE_S), "it")
        assert {one.daemon for one in threading.enumerate() if one.name == "it"} == {True}

    def fail() -> None:
        raise NoGpu("none")

    asyncio.run(run())
    release.set()
