"""`vramctl run` where the arbiter answers late or not as hoped: the program has begun, and is
neither cut off from its signals nor left alone."""

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from tests.support.grants_at_once import GrantsAtOnce
from tests.support.running import Running, running
from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.errors import LeaseLost

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

PROGRAM = (
    "import signal, sys; signal.signal(15, lambda *_: sys.exit(5)); print('up', flush=True); "
    "signal.pause()"
)


@asynccontextmanager
async def vramctl_run(endpoint: str) -> AsyncIterator[Running]:
    """A program that ends with 5 on SIGTERM, once it is up."""
    words = ("run", "--vram", "1GiB", "--name", "job", "--", sys.executable, "-c", PROGRAM)
    with running("vramctl", words, {**os.environ, "VRAM_ARBITER_ENDPOINT": endpoint}) as run:
        assert await asyncio.to_thread(run.line) == "up"
        yield run


async def test_a_signal_reaches_the_program_although_the_arbiter_has_not_heard_that_it_runs() -> (
    None
):
    """Regression: until `ready` was answered nobody listened for signals. vramctl ended, its
    program stayed without a lease."""
    arbiter = GrantsAtOnce(ready=None)
    async with (
        asyncio.timeout(PATIENCE_S),
        arbiter.serving() as endpoint,
        vramctl_run(endpoint) as run,
    ):
        assert await asyncio.to_thread(run.ended, signal.SIGTERM) == 5
    assert arbiter.heard[-2:] == ["release", "bye"]


async def test_a_program_whose_lease_is_gone_when_it_has_started_is_waited_for() -> None:
    """Regression: vramctl ended with the error, and its program went on with nobody to pass signals
    to it."""
    arbiter = GrantsAtOnce(ready=LeaseLost("L1-1 expired"))
    async with (
        asyncio.timeout(PATIENCE_S),
        arbiter.serving() as endpoint,
        vramctl_run(endpoint) as run,
    ):
        await arbiter.refused.wait()
        assert await asyncio.to_thread(run.ended, signal.SIGTERM) == 5
